"""The first moments of the program: what is imported cannot keep Ctrl-C to itself."""

import os
import signal
import subprocess
import sys

import pytest

from pipeline.cli import start

# In place of the command line, a module that takes long to import and catches whatever is raised meanwhile.
PROGRAM = """
import sys, time
from pipeline.cli import start

class Slow:
    def find_spec(self, name, path, target=None):
        if name == "pipeline.cli.main":
            print("importing", flush=True)
            try:
                time.sleep(300)
            except BaseException:
                print("caught")

sys.modules.pop("pipeline.cli.main", None)
sys.meta_path.insert(0, Slow())
sys.argv = ["colorphase", "--help"]
start.main()
"""


@pytest.mark.skipif(os.name != "posix", reason="a terminal's Ctrl-C is a signal")
def test_ctrl_c_ends_the_program_while_it_is_imported():
    arguments = [sys.executable, "-c", PROGRAM]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout.readline() == "importing\n"
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=60)
    assert (process.returncode, said) == (-signal.SIGINT, "")


def test_later_it_is_the_commands_own(monkeypatch):
    before, heard = signal.getsignal(signal.SIGINT), []
    monkeypatch.setattr("pipeline.cli.main.main", lambda: heard.append(signal.getsignal(signal.SIGINT)))
    start.main()
    assert heard == [before] and signal.getsignal(signal.SIGINT) == before


def test_linear_algebra_has_one_thread_unless_the_user_wants_more(monkeypatch):
    """NumPy reads these while it is imported; processes that the command starts inherit them."""
    monkeypatch.setattr("pipeline.cli.main.main", lambda: None)
    names = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
    for name in names:
        monkeypatch.setenv(name, "")  # restored afterwards
        monkeypatch.delenv(name)
    monkeypatch.setenv("MKL_NUM_THREADS", "3")
    start.main()
    assert [os.environ[name] for name in names] == ["1", "3", "1"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no disk that is always full")
@pytest.mark.parametrize("words", [["--version"], ["--help"], ["verify", "--help"], ["settings", "s.toml"]])
def test_a_result_that_cannot_be_written_is_one_line(tmp_path, words):
    program = f"import sys; from pipeline.cli.start import main; sys.argv = ['colorphase', *{words}]; main()"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", program],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tmp_path,
            env=environment,
        )
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("error: cannot write to standard output: ")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="this system has no disk that is always full")
def test_a_remark_that_cannot_be_written_ends_nothing():
    program = "from pipeline.cli.console import remark, say; remark('a'); say('b')"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=full, text=True)
    assert (done.returncode, done.stdout) == (0, "b\n")
