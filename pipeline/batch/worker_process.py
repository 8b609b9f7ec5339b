"""One of the processes that decode footage here: it takes chains of frames until its standard input ends.

What goes through the pipes is pickled by this package on both ends, and by nobody else.
"""

import os
import pickle
import signal
import sys
import traceback
from dataclasses import dataclass
from typing import Any

from pipeline.batch.worker import Worker


@dataclass(frozen=True)
class Failure:
    """Why a process ends: what it has raised, and where."""

    error: BaseException
    trace: str


class Done:
    """Sent when a process is ready, and after each task."""


def serve() -> None:
    """Decode what comes, and report every frame; end without a word when the other end is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that has started this one decides when to end
    tasks = sys.stdin.buffer
    reports = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever else is printed must not come between

    def report(message: Any) -> None:
        pickle.dump(message, reports)
        reports.flush()

    try:
        worker = Worker(pickle.load(tasks))
        report(Done())
        while True:
            worker.decode(pickle.load(tasks), report)
            report(Done())
    except EOFError:
        return
    except BrokenPipeError:
        os._exit(1)  # what is left to flush would complain
    except Exception as error:
        report(Failure(error, traceback.format_exc()))
