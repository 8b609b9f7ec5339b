"""One process that has the drawing library loaded and forks for each picture; loading it takes longer than drawing.

`python drawing_server.py SOCKET` serves; with further arguments it is what a test starts in place of the drawing
process: it hands its folder, environment and output to the server and ends as the forked process ends.
"""

import json
import os
import select
import signal
import socket
import sys


def request(path: str, arguments: list[str]) -> int:
    """Have a forked process draw, and return its exit code; that of a crash where it says none."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(path)
        job = json.dumps([os.getcwd(), dict(os.environ), arguments]).encode()
        socket.send_fds(connection, [len(job).to_bytes(4, "big")], [1, 2])
        connection.sendall(job)
        return int(connection.recv(8) or b"139")


def serve(path: str) -> None:
    """Fork for each request, until the process that started this one ends."""
    import pipeline.output.pictures.drawing_child  # noqa: F401 - what takes long

    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen()
        print("ready", flush=True)
        while sys.stdin not in select.select([listening, sys.stdin], [], [])[0]:
            connection, _ = listening.accept()
            if os.fork() == 0:
                draw(connection)
            connection.close()


def draw(connection: socket.socket) -> None:
    """Do what a request asks for as a process of its own would, and end."""
    import runpy
    import traceback

    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    size, outputs, _, _ = socket.recv_fds(connection, 4, 2)
    job = connection.makefile("rb").read(int.from_bytes(size, "big"))
    folder, environment, arguments = json.loads(job)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    for own, given in zip((1, 2), outputs, strict=True):
        os.dup2(given, own)
    sys.argv = ["drawing_child", *arguments]
    code: object = 0
    try:
        runpy.run_module("pipeline.output.pictures.drawing_child", run_name="__main__")
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    connection.sendall(str(code).encode())
    os._exit(0)


if __name__ == "__main__":
    if len(sys.argv) == 2:
        serve(sys.argv[1])
    sys.exit(request(sys.argv[1], sys.argv[2:]))
