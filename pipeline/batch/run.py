"""Decode footage into a store: what is missing of it, here or on a cluster."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pipeline.batch.executors import (
    ProcessExecutor,
    decode_by,
    idle_processes,
    shares,
    usable_cores,
    worthwhile_processes,
)
from pipeline.batch.job import Crop, Job, Learnt, chains
from pipeline.batch.worker import Chain, Outcome, Worker
from pipeline.calibration import Calibration
from pipeline.errors import DamageError, FootageError, OutputError, SettingsError
from pipeline.files import explain, make_folder
from pipeline.footage.footage import BadFrame, Footage, OnBad, StoredAs, check_on_bad
from pipeline.locking import locked
from pipeline.output.folder import MESHES, STORE, refuse_others
from pipeline.output.store import (
    ResultStore,
    SizeForecast,
    chosen_fields,
    is_there,
    mean_frame_bytes,
    most_frame_bytes,
)
from pipeline.settings import DecodeSettings
from tikernels import runtime

_AS_IT_SAYS = StoredAs()
_log = logging.getLogger("colorphase.batch")


@dataclass
class DecodeSummary:
    """Summary of a run.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> with colorphase.Recorder("film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
    ...     for seed in range(2):
    ...         film.add(colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane", seed=seed)).image)
    >>> summary = colorphase.decode_footage("film.zarr", "out", calibration=rig, arch="cpu", workers=1)
    >>> summary.n_frames, summary.n_before, summary.unmeasured
    (2, 0, [])
    """

    n_frames: int  # requested
    n_before: int  # of them were done already
    bad: list[BadFrame] = field(default_factory=list)
    warned: dict[int, tuple[str, ...]] = field(default_factory=dict)  # by number, in order
    notes: tuple[str, ...] = ()  # of the footage as a whole
    unmeasured: list[int] = field(default_factory=list)  # of the frames that are done, those that show nothing
    damaged: dict[int, str] = field(default_factory=dict)  # frames that were done, and why they are decoded again


class Stopped(KeyboardInterrupt):
    """The user has stopped the run; the message states how to continue."""


@dataclass(frozen=True)
class DecodeProgress:
    """Progress of a run, as passed to its `progress` at each change.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> with colorphase.Recorder("film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
    ...     for seed in range(2):
    ...         film.add(colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane", seed=seed)).image)
    >>> heard = []
    >>> how = dict(calibration=rig, arch="cpu", workers=1, progress=heard.append)
    >>> _ = colorphase.decode_footage("film.zarr", "out", **how)
    >>> heard[-1].done, heard[-1].of
    (2, 2)
    """

    done: int = 0
    """Frames, those included that an earlier run has decoded."""
    of: int = 0
    doing: str = ""
    """The current step, and the expected size of the store by the frames that are in it."""
    remark: str | None = None
    """A line that the user should know, sent once."""


def decode_footage(
    footage: str | Path,
    out: str | Path,
    settings: DecodeSettings | None = None,
    calibration: Calibration | None = None,
    *,
    fields: Sequence[str] | None = None,
    start: int = 0,
    stop: int | None = None,
    step: int = 1,
    crop: Crop | None = None,
    on_bad: OnBad = "skip",
    workers: int | None = None,
    cluster: str | None = None,
    arch: str = "auto",
    stored_as: StoredAs = _AS_IT_SAYS,
    force: bool = False,
    progress: Callable[[DecodeProgress], None] = lambda progress: None,
) -> DecodeSummary:
    """Decode footage into ``out/result.zarr``, as ``colorphase decode`` does; run again, it continues where it stopped.

    A script needs the guard ``if __name__ == "__main__"``, as for every process that `multiprocessing` spawns, unless
    `workers` is 1.

    Parameters
    ----------
    footage : str or Path
        A folder of pictures, a video or a recording.
    out : str or Path
        Folder for the result, or an fsspec URL.
    settings : DecodeSettings, optional
        Settings of the decoding; where they do not state how light is encoded, the calibration or the footage does.
    calibration : Calibration, optional
        The rig; with it, results are in mm.
    fields : sequence of str, optional
        The fields to store, ``["all"]`` for all; if omitted, mask, phase_sigma, absolute and points, or range_image
        without a calibration.
    start, stop, step : int
        The frames, as of a slice.
    crop : Crop, optional
        The part of each frame that is decoded.
    on_bad : {"skip", "raise"}
        Skip a damaged frame and list it in the summary, or end the run.
    workers : int, optional
        Number of processes here; 1: only this one. If omitted, one per core for long footage, but only this one on a
        GPU.
    cluster : str, optional
        Address of a Dask scheduler, ``tcp://...``, whose workers see footage and store under the same names.
    arch : {"auto", "cpu", "vulkan", "cuda", "metal"}
        The device; a named one never falls back.
    stored_as : StoredAs
        Properties of its pixels that the footage does not state.
    force : bool
        True if the folder may hold other things.
    progress : callable
        Called with a `DecodeProgress` at each change.

    Returns
    -------
    DecodeSummary
        Bad frames, and those with a warning. `StoredResult` opens the result.

    Raises
    ------
    FootageError, OutputError, SettingsError, CalibrationError, ClusterError, DeviceNotReady
        See `colorphase decode`; what is done stays.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> with colorphase.Recorder("film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
    ...     for seed in range(2):
    ...         film.add(colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane", seed=seed)).image)
    >>> summary = colorphase.decode_footage("film.zarr", "out", calibration=rig, arch="cpu", workers=1)
    >>> f"{summary.n_frames} frames, {len(summary.bad)} of them bad"
    '2 frames, 0 of them bad'
    >>> f"{np.nanmedian(colorphase.StoredResult('out/result.zarr')[1].points[..., 2]):.0f} mm"
    '900 mm'
    """
    check_on_bad(on_bad)
    if step < 1 or start < 0:
        raise SettingsError(f"start is {start} and step {step}: start at 0 or later, and go on by 1 or more")
    in_mm = calibration is not None and calibration.has_geometry
    job = Job(
        footage=str(footage),
        says=stored_as,
        settings=settings or DecodeSettings(),
        calibration=calibration,
        crop=crop,
        step=step,
        first=start % step,
        fields=chosen_fields(wanted_fields(fields, in_mm=in_mm), in_mm=in_mm),
        store=f"{str(out).rstrip('/')}/{STORE}",
        arch=arch,
    )
    if "://" not in str(out) and Path(out).is_dir() and not force:
        refuse_others(Path(out), (STORE, MESHES))
    come = DecodeProgress()

    def report(**change: Any) -> None:
        nonlocal come
        before, come = come, replace(come, **{"remark": None, **change})
        if come != before:
            progress(come)

    return decode_job(
        job,
        start,
        stop,
        strict=on_bad == "raise",
        workers=workers,
        cluster=cluster,
        notify=lambda done, of: report(done=done, of=of),
        step=lambda what: report(doing=what),
        remark=lambda line: report(remark=line),
    )


def wanted_fields(names: Sequence[str] | None, *, in_mm: bool) -> Sequence[str] | None:
    """Return the given fields, or those that most people read; None: all."""
    if names is None:
        return ("mask", "phase_sigma", *(("absolute", "points") if in_mm else ("range_image",)))
    return None if tuple(names) == ("all",) else names


def decode_job(
    job: Job,
    start: int = 0,
    stop: int | None = None,
    *,
    strict: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
    notify: Callable[[int, int], None] = lambda done, of: None,
    step: Callable[[str], None] = lambda what: None,
    remark: Callable[[str], None] = lambda line: None,
) -> DecodeSummary:
    """Decode what is missing in the store.

    Parameters
    ----------
    job : Job
        The job.
    start, stop : int
        The frames: from `start` on, in steps of `job.step`, below `stop`.
    strict : bool
        True if a bad frame ends the run, instead of being skipped.
    workers : int, optional
        Number of processes here; 1: only this one. If omitted, one per core for long footage, but only this one on a
        GPU.
    cluster : str, optional
        Address of a Dask scheduler, ``tcp://...``, whose workers see footage and store under the same names.
    notify : callable
        Called with the number of frames done and of all.
    step : callable
        Called with the current step, and the expected size of the store by the frames that are in it.
    remark : callable
        Called with each line that the user should know before frames are decoded: the size of the store, or that there
        are more processes than help.

    Returns
    -------
    DecodeSummary
        Bad frames, and those with a warning.

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
    with job.open() as source:
        wanted = _wanted(source, start, stop, job.step)
        step("reading the footage")
        job = job.pinned(source)
        with _one_writer(job.store):
            listeners = _Listeners(notify, step, remark)
            return _decode_missing(job, source, wanted, listeners, strict=strict, workers=workers, cluster=cluster)


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
    source: Footage,
    wanted: range,
    listeners: "_Listeners",
    *,
    strict: bool,
    workers: int | None,
    cluster: str | None,
) -> DecodeSummary:
    """Decode the frames that are missing, or damaged, in a store that nobody else writes to."""
    listeners.step("checking what is there")
    store, notes, size = _ready_store(job, source, wanted, listeners, workers=workers, cluster=cluster)
    there = store.done() & set(wanted)
    damaged = store.faults(there, job.made_of)
    store.unmark(damaged)
    missing = set(wanted) - (there - damaged.keys())
    summary = DecodeSummary(len(wanted), len(wanted) - len(missing), notes=notes, damaged=damaged)
    done, stored = summary.n_before, set[int]()
    if size is None:
        size = _forecast(job, source, len(missing), mean_frame_bytes(job.store, job.fields))
        listeners.remark_if(size.check())

    def note(report: Outcome) -> None:
        nonlocal done
        if isinstance(report, BadFrame):
            _log.warning("frame %d of %s is bad: %s", report.number, source.name, report.reason)
            if strict:
                raise FootageError(f"frame {report.number} of {source.name}: {report.reason}")
            summary.bad.append(report)
        else:
            stored.add(report.number)
            expected = size.corrected_by(report.n_bytes)
            listeners.step("decoding" if expected is None else f"decoding to about {expected}")
            if report.warnings:
                summary.warned[report.number] = report.warnings
        done += 1
        listeners.notify(done, summary.n_frames)

    for number, fault in damaged.items():
        _log.warning("frame %d of %s is decoded again: %s", number, job.store, fault)
    _log.info("decoding %d of %d frames of %s into %s", len(missing), len(wanted), source.name, job.store)
    listeners.notify(done, summary.n_frames)
    todo: list[Chain] = list(chains(wanted, missing))
    try:
        _decode_chains(job, todo, workers, cluster, note, listeners)
    except KeyboardInterrupt:
        store.remove_leftovers()
        n_done = len(set(wanted) & store.done())
        raise Stopped(
            f"stopped: {n_done} of {len(wanted)} frames are done; the same command goes on from there"
        ) from None
    store.remove_leftovers()  # of workers that died
    store.check(stored)
    summary.unmeasured = store.unmeasured(set(wanted) & store.done())
    summary.bad.sort(key=lambda frame: frame.number)  # workers finish in any order
    summary.warned = dict(sorted(summary.warned.items()))
    _log.info("%d of %d frames are in %s", summary.n_frames - len(summary.bad), summary.n_frames, job.store)
    return summary


def _wanted(source: Footage, start: int, stop: int | None, step: int) -> range:
    """Return the numbers of the requested frames; refuse an empty selection."""
    wanted = range(len(source))[start:stop:step]
    if not wanted:
        raise SettingsError(f"{source.name} has {len(source)} frames, none of which is selected: check --start, --stop")
    return wanted


def _ready_store(
    job: Job, source: Footage, wanted: range, listeners: "_Listeners", *, workers: int | None, cluster: str | None
) -> tuple[ResultStore, tuple[str, ...], SizeForecast | None]:
    """Open the store, a new one with the properties of the footage, and only if its disk has room for it.

    Returns
    -------
    ResultStore
        The store.
    tuple of str
        Lines for the user.
    SizeForecast or None
        Expected size of a new store, which has been reported.
    """
    notes, learnt, size = source.notes, Learnt(), None
    taken = job.settings.transfer  # None: a curve that the calibration has measured
    if taken is not None and source.transfer not in (None, taken):
        because = source.transfer_because
        notes += (
            f"its light is decoded as {taken}, as you or the calibration say, not as {source.transfer}: {because}",
        )
    damaged = False
    try:
        there = is_there(job.store)
    except DamageError as error:
        there, damaged, notes = False, True, (*notes, f"{error}; it is written anew")
    if not there:
        listeners.step("compiling kernels, and estimating the footage's light")
        with _kernels_to_share(job, wanted, workers, cluster):
            learnt = job.learn(source)
        if not damaged:  # else there may be frames
            size = _forecast(job, source, len(wanted), learnt.frame_bytes)
            listeners.remark_if(size.check())
    store = job.make_store(source, learnt)
    store.remove_leftovers()
    return store, (*notes, *learnt.notes), size


@contextmanager
def _kernels_to_share(job: Job, wanted: range, workers: int | None, cluster: str | None) -> Iterator[None]:
    """Compile the body's kernels in such a way that the processes that decode afterwards find them on the disk.

    What a process compiles is of use to those with as many threads per kernel, and is written when its device ends. A
    device that the caller has started is left alone.
    """
    started_here = not runtime.is_started()
    arch = runtime.init(job.arch)
    todo = list(chains(wanted, set(wanted)))
    count = min(len(todo), worthwhile_processes(job, todo) if workers is None else workers)
    if not started_here or arch != "cpu" or count == 1 or cluster is not None:
        yield
        return
    runtime.stop()
    runtime.init("cpu", cpu_threads=len(shares(usable_cores(), count)[0]))
    yield
    runtime.stop()


def _forecast(job: Job, source: Footage, n_frames: int, frame_bytes: float | None) -> SizeForecast:
    return SizeForecast(job.store, n_frames, most_frame_bytes(job.fields, job.size_px(source)), frame_bytes)


@dataclass(frozen=True)
class _Listeners:
    """Callbacks of a run; see `decode_footage`."""

    notify: Callable[[int, int], None]
    step: Callable[[str], None]
    remark: Callable[[str], None]

    def remark_if(self, line: str | None) -> None:
        """Report a line, if there is one."""
        if line is not None:
            self.remark(line)


def _decode_chains(
    job: Job,
    todo: list[Chain],
    workers: int | None,
    cluster: str | None,
    note: Callable[[Outcome], None],
    listeners: _Listeners,
) -> None:
    """Decode chains of frames: on a scheduler's workers, in processes that are started here, or in this one."""
    if not todo:
        return
    if cluster is not None:
        from pipeline.batch.cluster import cluster_executor  # slow to import, and of the extra `cluster`

        listeners.step("waiting for the cluster's first frame")
        with cluster_executor(job, cluster) as workers_there:
            decode_by(workers_there, todo, note)
        return
    count = worthwhile_processes(job, todo) if workers is None else workers
    listeners.remark_if(None if workers is None else idle_processes(job, todo, workers))
    if count > 1:
        listeners.step("starting processes, which compile their kernels")
        with ProcessExecutor(job, min(count, len(todo))) as processes:
            decode_by(processes, todo, note)
    else:
        listeners.step("compiling kernels")
        Worker(job).decode(todo, note)
