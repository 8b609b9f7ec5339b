"""Read all that is stored and report what is complete: results, recordings, captures."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from pipeline.acquisition.capture_folder import RECORDING, end_log
from pipeline.errors import FootageError
from pipeline.files import LEFTOVER
from pipeline.footage.footage import BadFrame
from pipeline.footage.frame_times import LOG
from pipeline.footage.opening import open_footage
from pipeline.output.folder import STORE, changed_files
from pipeline.output.stored_result import StoredResult
from pipeline.recording.zarr_writer import finish_recording, unfinished

Notify = Callable[[int, int], None]


@dataclass(frozen=True)
class Verified:
    """The verdict on one result or recording."""

    name: str
    n_whole: int  # frames
    faults: dict[int, str]  # what is wrong with the others, by their numbers
    notes: tuple[str, ...] = ()  # what else there is to know
    damage: tuple[str, ...] = ()  # and what else is wrong

    @property
    def whole(self) -> bool:
        """True if nothing is wrong."""
        return not self.faults and not self.damage


def verify(location: str, notify: Notify = lambda done, of: None) -> list[Verified]:
    """Check a result, the folder that it is in, a capture, or a recording; finish a capture that was killed.

    Parameters
    ----------
    location : str
        A ``result.zarr``, which may be an fsspec URL; or a folder or file here.
    notify : callable
        Called with the number of frames checked and of all.

    Raises
    ------
    FootageError
        There is nothing of ours, or it cannot be read at all.
    OutputError
        Somebody is writing it.
    """
    path = Path(location)
    if "://" in location or _is_result(path):
        return [_verify_result(location, notify)]
    if not path.is_dir() or path.suffix == ".zarr":
        return [_verify_recording(path, notify)]
    found = [*_finish(path)]
    if (path / STORE).is_dir():
        result = _verify_result(str(path / STORE), notify)
        changed = tuple(f"{name} has been changed since it was written" for name in changed_files(path))
        found.append(Verified(result.name, result.n_whole, result.faults, result.notes, (*result.damage, *changed)))
    if (path / RECORDING).exists():
        found.append(_verify_recording(path / RECORDING, notify))
    if left := tuple(f"{name} was left by a program that was killed, and may be removed" for name in _left(path)):
        found.append(Verified(location, 0, {}, notes=left))
    if not found:
        raise FootageError(f"{location} holds no result and no recording: give one of them, or a folder that holds one")
    return found


def _is_result(path: Path) -> bool:
    return path.is_dir() and (path.name == STORE or (path / "done").is_dir())


def _verify_result(location: str, notify: Notify) -> Verified:
    """Check every frame of a result that is done, even while others continue to write it."""
    try:
        result = StoredResult(location)
    except FootageError as error:
        return Verified(location, 0, {}, damage=(str(error),))
    faults = {}
    for i, number in enumerate(result.done):
        fault = result.fault(number)
        if fault is not None:
            faults[number] = fault
        notify(i + 1, len(result.done))
    missing = len(result.wanted) - len(result.done)
    notes = (f"{missing} frames between the first and the last have not been decoded",) if missing > 0 else ()
    return Verified(location, len(result.done) - len(faults), faults, notes)


def _verify_recording(path: Path, notify: Notify) -> Verified:
    """Read every frame of a recording, or of other footage."""
    faults = {}
    with open_footage(path) as source:
        for frame in source.frames():
            if isinstance(frame, BadFrame):
                faults[frame.number] = frame.reason
            notify(frame.number + 1, len(source))
        return Verified(str(path), len(source) - len(faults), faults, source.notes)


def _left(folder: Path) -> Iterator[str]:
    """Yield the names of half-written files in a folder, and of those that were to become it; they may be removed."""
    yield from (entry.name for entry in sorted(folder.iterdir()) if entry.name.endswith(LEFTOVER))
    yield from (str(work) for work in sorted(folder.parent.glob(f".{folder.name}.*")) if work.is_dir())


def _finish(folder: Path) -> Iterator[Verified]:
    """Finish recordings that were killed; a capture's log then ends with the last frame, too."""
    for part in unfinished(folder):
        try:
            path, n_frames = finish_recording(part)
        except FootageError as error:
            yield Verified(str(part), 0, {}, damage=(str(error),))
            continue
        if (folder / LOG).exists():
            end_log(folder / LOG, n_frames)
        held = f"{path.name} now holds the {n_frames} frames that were whole" if n_frames else "no frame was whole"
        yield Verified(str(path), n_frames, {}, notes=(f"its program was killed: {held}",))
