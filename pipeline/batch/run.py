"""Decode footage into a store: what is missing of it, here or on a cluster."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.batch.job import Job, chains
from pipeline.batch.local_processes import decode_in_processes, usable_cores
from pipeline.batch.worker import Chain, Outcome, Worker
from pipeline.errors import DamageError, FootageError, OutputError, SettingsError
from pipeline.files import explain, make_folder
from pipeline.footage.source import BadFrame, Source
from pipeline.locking import locked
from pipeline.output.store import ResultStore, is_there
from tikernels import runtime

# A process starts in the time that it takes to decode about as many frames.
_FRAMES_A_START = 128


@dataclass
class DecodeSummary:
    """What a run has done."""

    n_frames: int  # asked for
    n_before: int  # of them were done already
    bad: list[BadFrame] = field(default_factory=list)
    warned: dict[int, tuple[str, ...]] = field(default_factory=dict)  # by number
    notes: tuple[str, ...] = ()  # of the footage as a whole
    damaged: dict[int, str] = field(default_factory=dict)  # frames that were done and not whole: decoded again


class Stopped(KeyboardInterrupt):
    """The user has stopped the run; the message says how to go on."""


def decode_footage(
    job: Job,
    start: int = 0,
    stop: int | None = None,
    *,
    strict: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    tell: Callable[[int, int], None] = lambda done, of: None,
) -> DecodeSummary:
    """Decode what is missing in the store.

    Parameters
    ----------
    job : Job
        What to decode, how, and where to.
    start, stop : int
        Which frames: from `start` on, in steps of `job.step`, below `stop`.
    strict : bool
        Whether a bad frame ends the run, instead of being left out.
    workers : int, optional
        In how many processes to decode here; 1: in this one. Left out, long footage is decoded in one for each core,
        but in this one where a GPU computes.
    cluster : str, optional
        Address of a Dask scheduler, ``tcp://...``, whose workers see footage and store under the same names.
    tell : callable
        Told how many frames are done, and of how many.

    Returns
    -------
    DecodeSummary
        Which frames are bad, and which come with a warning.

    Raises
    ------
    Stopped
        The user has pressed Ctrl-C; what is done stays.
    FootageError
        The footage cannot be read, or `strict` and a frame is bad.
    OutputError
        The store holds frames that were made otherwise, cannot be written, has lost frames, or is being written by
        another run.
    ClusterError
        There is no cluster, or its workers or the processes here die.
    """
    source = job.open()
    try:
        job = job.with_transfer_of(source)
        wanted = _wanted(source, start, stop, job.step)
        with _one_writer(job.store):
            return _decode_missing(job, source, wanted, tell, strict=strict, workers=workers, cluster=cluster)
    finally:
        source.close()


@contextmanager
def _one_writer(store: str) -> Iterator[None]:
    """Keep other runs from writing to a store; behind a URL nothing does."""
    if "://" in store:
        yield
        return
    try:
        make_folder(Path(store).parent)
    except OSError as error:
        raise OutputError(f"cannot write {store}: {explain(error)}") from error
    with locked(Path(store)):
        yield


def _decode_missing(
    job: Job,
    source: Source,
    wanted: range,
    tell: Callable[[int, int], None],
    *,
    strict: bool,
    workers: int | None,
    cluster: str | None,
) -> DecodeSummary:
    """Decode the frames that are missing, or damaged, in a store that nobody else writes to."""
    store, notes = _ready_store(job, source)
    there = store.done() & set(wanted)
    damaged = store.faults(there)
    store.unmark(damaged)
    missing = set(wanted) - (there - damaged.keys())
    summary = DecodeSummary(len(wanted), len(wanted) - len(missing), notes=notes, damaged=damaged)
    done, stored = summary.n_before, set[int]()

    def note(report: Outcome) -> None:
        nonlocal done
        if isinstance(report, BadFrame):
            if strict:
                raise FootageError(f"frame {report.number} of {source.name}: {report.reason}")
            summary.bad.append(report)
        else:
            stored.add(report.number)
            if report.warnings:
                summary.warned[report.number] = report.warnings
        done += 1
        tell(done, summary.n_frames)

    tell(done, summary.n_frames)
    todo: list[Chain] = list(chains(wanted, missing))
    try:
        _decode_chains(job, todo, workers, cluster, note)
    except KeyboardInterrupt:
        store.remove_leftovers()
        n_done = len(set(wanted) & store.done())
        raise Stopped(
            f"stopped: {n_done} of {len(wanted)} frames are done; the same command goes on from there"
        ) from None
    store.remove_leftovers()  # of workers that died
    store.check(stored)
    summary.bad.sort(key=lambda frame: frame.number)
    return summary


def _wanted(source: Source, start: int, stop: int | None, step: int) -> range:
    """Return the numbers of the frames that are asked for; refuse none."""
    wanted = range(len(source))[start:stop:step]
    if not wanted:
        raise SettingsError(
            f"{source.name} has {len(source)} frames, none of which is asked for: look at --start, --stop"
        )
    return wanted


def _ready_store(job: Job, source: Source) -> tuple[ResultStore, tuple[str, ...]]:
    """Open the store, a new one with what the footage tells of itself; and return what the user should know."""
    notes, light, rims = source.notes, None, None
    try:
        there = is_there(job.store)
    except DamageError as error:
        there, notes = False, (*notes, f"{error}; it is written anew")
    if not there:
        runtime.init(job.arch)
        light, rims, doubts = job.learn(source)
        notes += doubts
    store = job.make_store(source, light, rims)
    store.remove_leftovers()
    return store, notes


def _decode_chains(
    job: Job, todo: list[Chain], workers: int | None, cluster: str | None, note: Callable[[Outcome], None]
) -> None:
    """Decode chains of frames: on a scheduler's workers, in processes that are started here, or in this one."""
    if not todo:
        return
    if cluster is not None:
        from pipeline.batch.cluster import decode_on_cluster  # slow to import, and of the extra `cluster`

        decode_on_cluster(job, todo, cluster, note)
        return
    count = _worthwhile_processes(job, todo) if workers is None else workers
    if count > 1:
        decode_in_processes(job, todo, count, note)
    else:
        Worker(job).decode(todo, note)


def _worthwhile_processes(job: Job, todo: list[Chain]) -> int:
    """Return in how many processes frames are decoded the soonest."""
    if job.arch != "cpu" and (job.arch != "auto" or runtime.init("auto") != "cpu"):
        return 1  # one GPU does all the work
    n_frames = sum(len(missing) for _, missing in todo)
    return min(len(usable_cores()), n_frames // _FRAMES_A_START)
