"""Processes that this one starts: every one by `start_python`, or inside `safe_start` where Python itself starts it.

They see the modules that this process sees, and none of the folder that it happens to be in: a foreign folder may hold
a ``pickle.py``. What goes through the pipes of a `Child` is pickled by this package on both ends only.
"""

import os
import pickle
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from threading import Thread
from typing import IO, Any, cast

_SAFE_PATH = "PYTHONSAFEPATH"
# Time that a child takes to end.
_END_S = 20.0
# Between two checks whether its parent is there.
_LOOK_S = 0.02


@contextmanager
def safe_start() -> Iterator[None]:
    """Have Python itself start processes in here that get no Ctrl-C, and take no modules from the working folder.

    It is for the main thread, whose environment is that of all others.
    """
    before = os.environ.get(_SAFE_PATH)
    os.environ[_SAFE_PATH] = "1"
    try:
        # Python starts its resource tracker with the first process, and then unblocks Ctrl-C: so it starts before.
        resource_tracker.ensure_running()
        with _interrupts_blocked():
            yield
    finally:
        if before is None:
            del os.environ[_SAFE_PATH]
        else:
            os.environ[_SAFE_PATH] = before


@contextmanager
def _interrupts_blocked() -> Iterator[None]:
    """Block Ctrl-C: processes inherit that from the thread that starts them, and keep it; this thread gets it later."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def start_python(
    arguments: Sequence[str], environment: Mapping[str, str] = os.environ, **options: Any
) -> "subprocess.Popen[bytes]":
    """Start Python with arguments, an environment, and what else `subprocess.Popen` takes."""
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path if entry)
    return subprocess.Popen(
        [sys.executable, "-P", *arguments], env={**environment, _SAFE_PATH: "1", "PYTHONPATH": path}, **options
    )


class ChildDied(Exception):
    """A child has ended, or was killed, without a word."""


@dataclass(frozen=True)
class _Failure:
    """An error that a child has raised, with its traceback."""

    error: BaseException
    trace: str


class Child:
    """A process that runs a function of ours, which calls `serve`; a terminal's Ctrl-C does not reach it.

    Parameters
    ----------
    program : str
        The Python that it runs.
    environment : mapping
        Its environment.

    Raises
    ------
    ChildDied
        The system starts none.
    """

    def __init__(self, program: str, environment: Mapping[str, str] = os.environ) -> None:
        try:
            with _interrupts_blocked():
                self._process = start_python(
                    ["-c", program], environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE
                )
        except OSError:
            raise ChildDied from None
        self.pid = self._process.pid
        self._asked_at_s: float | None = None

    def __enter__(self) -> "Child":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(in_peace=kind is None)

    def send(self, message: Any) -> None:
        """Send a message.

        Raises
        ------
        ChildDied
            The child is gone.
        """
        try:
            pickle.dump(message, cast(IO[bytes], self._process.stdin))
            cast(IO[bytes], self._process.stdin).flush()
        except OSError:
            raise ChildDied from None

    def receive(self) -> Any:
        """Return its next message, or raise what it has raised.

        Raises
        ------
        ChildDied
            It sends nothing more.
        """
        self._asked_at_s = time.monotonic()
        try:
            message = pickle.load(cast(IO[bytes], self._process.stdout))
        except (EOFError, OSError, pickle.UnpicklingError):
            raise ChildDied from None
        self._asked_at_s = None
        if isinstance(message, _Failure):
            raise message.error from RuntimeError(message.trace)  # whose words come before it
        return message

    def silent_for_s(self) -> float:
        """Return for how long something has been waited for."""
        asked_at_s = self._asked_at_s
        return 0.0 if asked_at_s is None else time.monotonic() - asked_at_s

    def kill(self) -> None:
        """End it at once; it may have ended."""
        self._process.kill()

    def close(self, *, in_peace: bool) -> None:
        """Wait until it has ended; in peace it ends by itself, since nothing more comes."""
        if not in_peace:
            self.kill()
        with suppress(OSError):
            cast(IO[bytes], self._process.stdin).close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.kill()
            self._process.wait()
        cast(IO[bytes], self._process.stdout).close()


def serve(work: Callable[[Callable[[], Any], Callable[[Any], None]], None]) -> None:
    """Work for the process that has started this one, as a `Child`; end without a word when that is gone.

    At once, even amid its work: the next run over the same files may begin.

    Parameters
    ----------
    work : callable
        Takes a function that returns the next message, and one that sends one. Its exception is sent.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the other end decides when to end
    Thread(target=_end_with, args=(os.getppid(),), name="parent", daemon=True).start()
    said = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever else is printed must not come between

    def say(message: Any) -> None:
        pickle.dump(message, said)
        said.flush()

    try:
        work(lambda: pickle.load(sys.stdin.buffer), say)
    except EOFError:
        return
    except BrokenPipeError:
        os._exit(1)  # what is left to flush would complain
    except Exception as error:
        say(_Failure(error, traceback.format_exc()))


def _end_with(parent: int) -> None:
    """End this process once its parent is gone; Windows keeps the number, and the next word breaks the pipe there."""
    while os.getppid() == parent:
        time.sleep(_LOOK_S)
    os._exit(1)
