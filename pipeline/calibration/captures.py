"""Pictures to project, one after another, and the captures of them under the same names."""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import RootModel

from pipeline.errors import CalibrationError, OutputError
from pipeline.files import explain
from pipeline.footage.image_file import read_turned
from pipeline.footage.picture_tags import other_orientation
from pipeline.models import ImageArray, Model, SensorPart, build, read_file
from tikernels.raw.linearization import WHITE_LEVELS

#: What a sequence is called in its folder.
SEQUENCE_FILE = "sequence.json"
#: Description of a guided capture in its folder, and the key of the part of the sensor that its pictures are.
SESSION, SENSOR = "session.json", "part of the sensor"
_SUFFIXES = (".png", ".tif", ".tiff")
# Full scales, levels, of cameras whose 10, 12 or 14 bits come in 16-bit files.
_PART_SCALES = (2**10 - 1, 2**12 - 1, 2**14 - 1)


class PictureSequence(Model):
    """The pictures that are projected, in order; ``sequence.json``."""

    error_type = CalibrationError

    kind: Literal["radiometry", "geometry", "chart"]
    size_px: tuple[int, int]  # the projector's width and height
    names: tuple[str, ...]  # of the files, without suffix, in the order of projection


def write_sequence(
    folder: Path, sequence: PictureSequence, codes: Callable[[str], npt.NDArray[np.float64] | npt.NDArray[np.float32]]
) -> None:
    """Write the pictures to project as 8-bit PNGs, and ``sequence.json``: all, or nothing.

    Parameters
    ----------
    folder : Path
        A folder that does not exist yet, or is empty.
    sequence : PictureSequence
        Pictures to write.
    codes : callable
        From a name to (height, width, 3) projector codes, 0..1.

    Raises
    ------
    OutputError
        The folder holds something, or cannot be written.
    """
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise OutputError(f"{folder} is not an empty folder: choose another one")
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            for name in sequence.names:
                levels = np.rint(255 * np.asarray(codes(name))).astype(np.uint8)
                (work / f"{name}.png").write_bytes(cv2.imencode(".png", levels[..., ::-1])[1].tobytes())
            (work / SEQUENCE_FILE).write_text(sequence.model_dump_json(indent=1) + "\n", encoding="utf-8")
            work.chmod(0o755)
            work.replace(folder)
        finally:
            shutil.rmtree(work, ignore_errors=True)
    except OSError as error:
        if isinstance(error, OutputError):
            raise
        raise OutputError(f"cannot write {folder}: {explain(error)}") from None


def full_scale(white: ImageArray, white_level: float | None = None) -> float:
    """Return the captures' full scale, levels.

    Parameters
    ----------
    white : (H, W, 3) uint8, uint16 or float
        The brightest capture.
    white_level : float, optional
        Full scale where it is known; None: the type's (1.0 for floats).

    Raises
    ------
    CalibrationError
        The white level is not positive, or 16-bit captures end where a camera of fewer bits does.
    """
    if white_level is not None:
        if not white_level > 0:
            raise CalibrationError(f"white_level is {white_level:g}: give the level at which the camera saturates")
        return white_level
    top = int(white.max())
    if white.dtype == np.uint16 and top in _PART_SCALES:
        raise CalibrationError(
            f"the levels of these 16-bit captures end at {top}: the camera has fewer bits, give {top} as white level"
        )
    return WHITE_LEVELS.get(white.dtype.name, 1.0)


def captured_files(folder: Path) -> dict[str, Path]:
    """Return the captures in a folder by their names without suffix."""
    return {path.stem: path for path in sorted(folder.glob("*")) if path.suffix.lower() in _SUFFIXES}


def _sensor_of(folder: Path) -> SensorPart | None:
    """Return the part of the sensor that the captures in a folder are, where their session states it."""
    # Those of a pose lie in a folder of all poses.
    for file in (folder.parent / SESSION, folder.parent.parent / SESSION):
        if file.exists():
            said = read_file(file, RootModel[dict[str, Any]], json.loads, CalibrationError).root.get(SENSOR)
            return None if said is None else build(SensorPart, said, CalibrationError, f"{file}: {SENSOR}")
    return None


class CapturedFolder(Mapping[str, ImageArray]):
    """The captures in a folder by their names, each read on demand."""

    def __init__(self, folder: Path, names: tuple[str, ...], orientations: list[int] | None = None) -> None:
        """Look for the files; `orientations` are those of the same camera's captures in other folders, added to here.

        Raises
        ------
        CalibrationError
            A file is missing, or the session that they are of cannot be read.
        """
        found = captured_files(folder)
        missing = [name for name in names if name not in found]
        if missing:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise CalibrationError(
                f"{folder} lacks the capture {missing[0]}.png{more}: capture every picture under the name it has in "
                "the sequence"
            )
        self._paths = {name: found[name] for name in names}
        self.sensor = _sensor_of(folder)
        self._orientations: list[int] = [] if orientations is None else orientations
        self._shape: tuple[tuple[int, ...], str] | None = None

    def __getitem__(self, name: str) -> ImageArray:
        """Read one capture, (H, W, 3) RGB.

        Raises
        ------
        CalibrationError
            It has another size, type or orientation than the one before.
        FootageError
            It cannot be read.
        """
        image, orientation = read_turned(self._paths[name])
        self._orientations.append(orientation)
        if (turned_otherwise := other_orientation(orientation, self._orientations[0])) is not None:
            raise CalibrationError(f"{self._paths[name]}: {turned_otherwise}")
        shape = (image.shape, image.dtype.name)
        if self._shape is not None and shape != self._shape:
            raise CalibrationError(
                f"{self._paths[name]} is {image.shape[1]}x{image.shape[0]} {image.dtype}, others are "
                f"{self._shape[0][1]}x{self._shape[0][0]} {self._shape[1]}: do not change the camera in between"
            )
        self._shape = shape
        return image

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names in order."""
        return iter(self._paths)

    def __len__(self) -> int:
        """Return how many captures there are."""
        return len(self._paths)
