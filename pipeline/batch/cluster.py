"""Many processes, here or on other machines, by Dask: chains of frames are tasks, results are written in place."""

import asyncio
import logging
import os
import secrets
import socket
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from typing import Any
from urllib.parse import urlsplit

from pipeline.batch.job import Job
from pipeline.batch.worker import Chain, Outcome, Worker
from pipeline.errors import ClusterError
from pipeline.processes import block_interrupts

# Tasks a worker: more even out the time that each takes, fewer let footage be read in one go.
_TASKS_A_WORKER = 8
# Time that a scheduler may take to answer: on a busy network it takes a few seconds.
_TIMEOUT_S = 20
# Time that processes here may take to start: each imports Dask and compiles nothing yet.
_START_S = 120
# Between two looks at whether the scheduler still has workers.
_LOOK_S = 5
# Time without any worker after which the run ends: a worker that is restarted is back sooner.
_ALONE_S = 60

# In a worker's process: all its kernels run in one thread, and one job's decoder and buffers serve all its tasks.
_kernels = ThreadPoolExecutor(1, "kernels")
_workers: dict[str, Worker] = {}
_stopped: set[str] = set()


def decode_on_cluster(job: Job, todo: Sequence[Chain], where: int | str, tell: Callable[[Outcome], None]) -> None:
    """Decode chains of frames by the workers of a cluster; see `Worker.decode`.

    Parameters
    ----------
    job : Job
        What to decode and how; its store must be there.
    todo : sequence of (range, frozenset)
        The chains: frames of which each is decoded with the one before, and which of them are to be stored.
    where : int or str
        The number of processes to start here, or the address of a scheduler.
    tell : callable
        Told of every stored and every bad frame, not in order.

    Raises
    ------
    ClusterError
        There is no cluster, or workers die over the same frames again and again.
    """
    with _client(where) as (distributed, client), client.as_current():
        n_workers = max(1, len(client.ncores()))
        size = -(-len(todo) // (_TASKS_A_WORKER * n_workers))
        tasks = [todo[first : first + size] for first in range(0, len(todo), size)]
        run = secrets.token_hex(8)
        futures = client.map(_decode_task, tasks, job=job, run=run, pure=False)
        pending, alone_s = set(futures), 0
        try:
            while pending:
                try:
                    finished, pending = distributed.wait(list(pending), _LOOK_S, "FIRST_COMPLETED")
                except TimeoutError:
                    alone_s = 0 if client.ncores() else alone_s + _LOOK_S
                    if alone_s >= _ALONE_S:
                        raise ClusterError("no worker is left: start one, and run again to go on") from None
                    continue
                for future in finished:
                    for report in future.result():
                        tell(report)
        except CancelledError:
            raise ClusterError("the scheduler is gone: start it again, and run again to go on") from None
        except BaseException as error:
            client.cancel(futures, force=True)
            with suppress(Exception):  # they may be gone
                client.run(_stop, run, on_error="ignore")
            if isinstance(error, distributed.KilledWorker):
                raise ClusterError(
                    "workers died over the same frames again and again: look at their logs for memory or device errors"
                ) from None
            raise


def _check_address(address: str) -> None:
    """Refuse an address where nobody is: Dask would look for it for a minute, and Ctrl-C would not end that."""
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
def _client(where: int | str) -> Iterator[tuple[Any, Any]]:
    """Give Dask and a client of it."""
    try:
        import distributed
    except ImportError:
        raise ClusterError("dask distributed is not installed: pip install 'colorphase[cluster]'") from None
    if isinstance(where, str):
        _check_address(where)
        with distributed.utils.silence_logging_cmgr(logging.CRITICAL):
            try:
                asyncio.run(_shake_hands(where))
            except (Exception, CancelledError):  # whatever Dask makes of another protocol
                raise ClusterError(
                    f"what listens at {where} is no Dask scheduler: give the scheduler's address"
                ) from None
            try:
                client: Any = distributed.Client(where, timeout=_TIMEOUT_S, set_as_default=False)
            except (OSError, ValueError) as error:
                raise _no_answer(where, error) from None
            with client:
                yield distributed, client
        return
    with local_cluster(where) as cluster, distributed.Client(cluster, set_as_default=False) as client:
        yield distributed, client


@contextmanager
def local_cluster(n_workers: int) -> Iterator[Any]:
    """Start processes here, among which the cores are shared out; on the loopback interface.

    Parameters
    ----------
    n_workers : int
        How many.

    Raises
    ------
    ClusterError
        They do not start.
    """
    import dask
    import distributed

    # Kernels share the cores; each worker's reading and writing comes on top.
    threads = str(max(1, (os.cpu_count() or 1) // n_workers))
    with (
        # Dask makes the C library give all memory back at once: asking for it anew took a fifth of a worker's time.
        dask.config.set({"distributed.nanny.pre-spawn-environ": {}}),
        block_interrupts() as unblock,
        distributed.LocalCluster(
            n_workers=0,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            # Its server for pages about itself is there in any case, on a port that another one may have.
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},
            memory_limit=0,
            silence_logs=logging.CRITICAL,
            env={"TI_CPU_MAX_NUM_THREADS": os.environ.get("TI_CPU_MAX_NUM_THREADS", threads)},
        ) as cluster,
    ):
        unblock()
        cluster.scale(n_workers)  # here, so that Ctrl-C meanwhile closes what has been started
        try:
            cluster.wait_for_workers(n_workers, _START_S)
        except TimeoutError:
            raise ClusterError(f"{n_workers} processes did not start within {_START_S} s: ask for fewer") from None
        yield cluster


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
