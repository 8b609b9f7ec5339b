"""Pictures to project, one after another, and the captures of them under the same names."""

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import CalibrationError, OutputError
from pipeline.files import explain
from pipeline.models import Model
from pipeline.picture import read_picture

Picture = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]

#: What a sequence is called in its folder.
SEQUENCE_FILE = "sequence.json"
_SUFFIXES = (".png", ".tif", ".tiff")


class Sequence(Model):
    """What is projected, in order; ``sequence.json``."""

    kind: Literal["radiometry", "geometry"]
    size_px: tuple[int, int]  # the projector's width and height
    names: tuple[str, ...]  # of the files, without suffix, in the order of projection


def write_sequence(
    folder: Path, sequence: Sequence, codes: Callable[[str], npt.NDArray[np.float64] | npt.NDArray[np.float32]]
) -> None:
    """Write the pictures to project as 8-bit PNGs, and ``sequence.json``: all, or nothing.

    Parameters
    ----------
    folder : Path
        A folder that does not exist yet, or is empty.
    sequence : Sequence
        What to write.
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


class CapturedFolder(Mapping[str, Picture]):
    """The captures in a folder by their names, each read when it is asked for."""

    def __init__(self, folder: Path, names: tuple[str, ...]) -> None:
        """Look for the files.

        Raises
        ------
        CalibrationError
            A file is missing.
        """
        found = {path.stem: path for path in sorted(folder.glob("*")) if path.suffix.lower() in _SUFFIXES}
        missing = [name for name in names if name not in found]
        if missing:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise CalibrationError(
                f"{folder} lacks the capture {missing[0]}.png{more}: capture every picture under the name it has in "
                "the sequence"
            )
        self._paths = {name: found[name] for name in names}
        self._shape: tuple[tuple[int, ...], str] | None = None

    def __getitem__(self, name: str) -> Picture:
        """Read one capture, (H, W, 3) RGB.

        Raises
        ------
        CalibrationError
            It has another size or type than the one before.
        FootageError
            It cannot be read.
        """
        picture = read_picture(self._paths[name])
        shape = (picture.shape, picture.dtype.name)
        if self._shape is not None and shape != self._shape:
            raise CalibrationError(
                f"{self._paths[name]} is {picture.shape[1]}x{picture.shape[0]} {picture.dtype}, others are "
                f"{self._shape[0][1]}x{self._shape[0][0]} {self._shape[1]}: do not change the camera in between"
            )
        self._shape = shape
        return picture

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names in order."""
        return iter(self._paths)

    def __len__(self) -> int:
        """Return how many captures there are."""
        return len(self._paths)
