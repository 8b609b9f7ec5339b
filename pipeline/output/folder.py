"""The folder that decoding fills: made whole, or not at all."""

import json
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pipeline.calibration import Calibration
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import FootageError, OutputError
from pipeline.files import explain
from pipeline.output.mesh_files import write_mesh
from pipeline.output.range_image import shade_range, write_png, write_range_image
from pipeline.output.store import holds_footage, write_store
from pipeline.output.surface_mesh import frame_mesh
from pipeline.settings import DecodeSettings

#: What decoding puts into an output folder, and may therefore replace.
NAMES = (
    "result.zarr",
    "mesh.ply",
    "range.png",
    "shaded.png",
    "report.json",
    "frame.png",
    "render.png",
    "calibration.json",
)


@contextmanager
def output_folder(path: str | Path, *, force: bool = False) -> Iterator[Path]:
    """Give a fresh folder to write to; what is in it at the end appears in the output folder, at an error nothing does.

    Parameters
    ----------
    path : str or Path
        The output folder; made if it does not exist.
    force : bool
        Whether it may hold other things than an earlier result.

    Raises
    ------
    OutputError
        The folder holds something else, or cannot be written.
    """
    if "://" in str(path):
        raise OutputError(f"{path} is not a folder here: choose one")
    path = Path(path)
    work = None
    try:
        if path.is_dir():
            if not force:
                refuse_others(path, NAMES)
            if holds_footage(path / "result.zarr"):
                raise OutputError(f"{path} holds the frames of footage: choose another folder")
        elif path.exists():
            raise OutputError(f"{path} is a file: choose a folder")
        path.parent.mkdir(parents=True, exist_ok=True)
        # Beside the output folder, so that moving is renaming.
        work = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
        yield work
        path.mkdir(exist_ok=True)
        for entry in work.iterdir():
            target = path / entry.name
            if target.is_dir() and not target.is_symlink():
                shutil.rmtree(target)
            entry.replace(target)
    except (FootageError, OutputError):  # OSErrors too, but not about this folder
        raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {explain(error)}") from None
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)


def refuse_others(folder: Path, names: Collection[str]) -> None:
    """Refuse a folder that holds other things than these.

    Raises
    ------
    OutputError
        It does.
    """
    others = sorted(entry.name for entry in folder.iterdir() if entry.name not in names)
    if others:
        raise OutputError(f"{folder} holds something else ({others[0]}): choose another folder, or add --force")


def write_frame(
    folder: Path,
    frame: DecodedFrame,
    settings: DecodeSettings,
    calibration: Calibration | None,
    report: dict[str, Any],
) -> None:
    """Write one frame's ``result.zarr``, ``mesh.ply``, ``range.png``, ``shaded.png`` and ``report.json`` into a folder.

    Raises
    ------
    OSError
        The folder cannot be written.
    """
    write_store(folder / "result.zarr", frame, settings, calibration)
    write_mesh(frame_mesh(frame), folder / "mesh.ply")
    write_range_image(folder / "range.png", frame.range_image, frame.mask, "mm" if frame.calibrated else "rad")
    write_png(folder / "shaded.png", shade_range(frame.range_image, frame.mask, frame.points))
    (folder / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
