"""Many processes, also on other machines, by Dask: chains of frames are tasks, results are written in place."""

import asyncio
import logging
import secrets
import socket
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any
from urllib.parse import urlsplit

from pipeline.batch.executors import Executor, Report
from pipeline.batch.job import Job
from pipeline.batch.worker import Chain, Outcome, Worker
from pipeline.errors import ClusterError

# Time that a scheduler may take to answer: on a busy network it takes a few seconds.
_TIMEOUT_S = 20
# Time without any worker after which the run ends: a worker that is restarted is back sooner.
_ALONE_S = 60

# In a worker's process: all its kernels run in one thread, and one job's decoder and buffers serve all its tasks.
_kernels = ThreadPoolExecutor(1, "kernels")
_workers: dict[str, Worker] = {}
_stopped: set[str] = set()


@contextmanager
def cluster_executor(job: Job, address: str) -> Iterator[Executor]:
    """Give an executor whose tasks the workers of a cluster decode, each in the process that it is in.

    Parameters
    ----------
    job : Job
        The job; its store must exist.
    address : str
        Of the scheduler.

    Raises
    ------
    ClusterError
        There is no cluster, or workers die over the same frames again and again.
    """
    run = secrets.token_hex(8)
    with _client(address) as (distributed, client):
        executor = _ClusterExecutor(client, job, run)
        try:
            yield executor
        except CancelledError:
            raise ClusterError("the scheduler is gone: start it again, and run again to go on") from None
        except BaseException as error:
            executor.cancel()
            with suppress(Exception):  # they may be gone
                client.run(_stop, run, on_error="ignore")
            if isinstance(error, distributed.KilledWorker):
                raise ClusterError(
                    "workers died over the same frames again and again: look at their logs for memory or device errors"
                ) from None
            raise


class _ClusterExecutor:
    def __init__(self, client: Any, job: Job, run: str) -> None:
        self.n_workers = max(1, len(client.ncores()))
        # Other machines may have copies, whose times differ.
        self._client, self._job, self._run = client, replace(job, stamps=()), run
        self._pool = client.get_executor(pure=False)
        self._alone_since_s: float | None = None

    def submit(self, task: list[Chain], report: Report) -> "Future[Sequence[Outcome]]":
        future: Future[Sequence[Outcome]] = self._pool.submit(_decode_task, task, job=self._job, run=self._run)
        return future

    def look(self) -> None:
        if self._client.ncores():
            self._alone_since_s = None
        elif self._alone_since_s is None:
            self._alone_since_s = time.monotonic()
        elif time.monotonic() - self._alone_since_s >= _ALONE_S:
            raise ClusterError("no worker is left: start one, and run again to go on")

    def cancel(self) -> None:
        self._pool.shutdown(wait=False)


def _check_address(address: str) -> None:
    """Refuse an address that does not respond: Dask would try it for a minute, and Ctrl-C would not end that."""
    try:
        parts = urlsplit(address)
        there = bool(parts.hostname and parts.port)
    except ValueError:
        there = False
    if not there:
        raise ClusterError(f"no scheduler can be at {address}: give an address such as tcp://127.0.0.1:8786")
    if parts.scheme in ("tcp", "tls"):
        try:
            socket.create_connection((str(parts.hostname), int(parts.port or 0)), _TIMEOUT_S).close()
        except OSError as error:
            raise _no_answer(address, error) from None


async def _shake_hands(address: str) -> None:
    """See whether a scheduler is there: a client would wait for ever where something else listens."""
    from distributed.comm import connect
    from distributed.security import Security

    arguments = Security().get_connection_args("client")
    comm = await asyncio.wait_for(connect(address, timeout=_TIMEOUT_S, **arguments), _TIMEOUT_S)
    await comm.close()


def _no_answer(address: str, error: Exception) -> ClusterError:
    return ClusterError(f"no scheduler answers at {address} ({error}): start one with dask scheduler")


@contextmanager
def _client(address: str) -> Iterator[tuple[Any, Any]]:
    """Give Dask and a client of its scheduler at an address."""
    try:
        import distributed
    except ImportError:
        raise ClusterError("dask distributed is not installed: pip install 'colorphase[cluster]'") from None
    _check_address(address)
    with distributed.utils.silence_logging_cmgr(logging.CRITICAL):
        try:
            asyncio.run(_shake_hands(address))
        except (Exception, CancelledError):  # any error of Dask's on another protocol
            raise ClusterError(
                f"what listens at {address} is no Dask scheduler, or one that does not know us: give the scheduler's "
                "address, and for tls:// the certificates of docs/video.md"
            ) from None
        try:
            client: Any = distributed.Client(address, timeout=_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise _no_answer(address, error) from None
        with client:
            yield distributed, client


def _decode_task(chains: Sequence[Chain], job: Job, run: str) -> list[Outcome]:
    """Decode some chains, in a worker's process."""
    return _kernels.submit(_decode_here, chains, job, run).result()


def _decode_here(chains: Sequence[Chain], job: Job, run: str) -> list[Outcome]:
    if run in _stopped:
        raise CancelledError
    if run not in _workers:
        _workers.clear()
        _workers[run] = Worker(job)
    reports: list[Outcome] = []

    def note(report: Outcome) -> None:
        reports.append(report)
        if run in _stopped:
            raise CancelledError

    _workers[run].decode(chains, note)
    return reports


async def _stop(run: str) -> None:
    """End a run's task in this worker's process, which Dask cannot do; return when it has ended."""
    _stopped.add(run)
    await asyncio.wrap_future(_kernels.submit(lambda: None))
