"""Sources of frames: image folders, video files and recordings."""

from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import FootageError
from pipeline.footage.footage import Footage, StoredAs
from pipeline.footage.heic_file import is_heic
from pipeline.footage.image_folder import IMAGE_SUFFIXES, ImageFolder
from pipeline.footage.tiff_file import RAW
from pipeline.footage.video_file import VideoFile
from pipeline.footage.zarr_recording import ZarrRecording
from pipeline.limits import open_plain
from tikernels.errors import ShapeError
from tikernels.raw.pixel_format import Bayer, Matrix, Siting

# Pictures that phones and browsers store as the brand of an ISO base media file states (ISO/IEC 23008-12, 10.2).
_UNREAD = {b"avif": "AVIF", b"avis": "AVIF"}
# How names of cameras' raw files end.
_RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")


def open_footage(
    path: str | Path,
    *,
    bayer: Bayer | None = None,
    bits: int | None = None,
    siting: Siting | None = None,
    matrix: Matrix | None = None,
    full_range: bool | None = None,
    listed: Sequence[str] | None = None,
) -> Footage:
    """Open footage: a folder of images, a single image, a video file, or a recording.

    Parameters
    ----------
    path : str or Path
        The folder or file.
    bayer, bits, siting, matrix, full_range
        How the pixels are stored, see `PixelFormat`; each wins over what the footage states of itself. Grey footage
        needs `bayer`.
    listed : sequence of str, optional
        Names of a folder's pictures, in order: others that have come since are ignored.

    Raises
    ------
    FootageError
        There is no such footage, or it cannot be read.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> with colorphase.Recorder("film.zarr", colorphase.PixelFormat("rgb"), rate_hz=30) as film:
    ...     for seed in range(2):
    ...         film.add(colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane", seed=seed)).image)
    >>> with colorphase.open_footage("film.zarr") as footage:
    ...     print(footage, f"{footage.times.seconds[1]:.3f} s")
    <ZarrRecording film.zarr: 2 frames of 160x120 px> 0.033 s
    """
    says = StoredAs(bayer, bits, siting, matrix, full_range)
    path = Path(path)
    try:
        if path.is_dir():
            # Any kind of Zarr group: those that are no recordings are refused there, by name.
            if path.suffix == ".zarr" or (path / "zarr.json").exists() or (path / ".zgroup").exists():
                return ZarrRecording(path, says)
            return ImageFolder.in_folder(path, says, listed)
        if not path.is_file():
            what = "it is neither a file nor a folder" if path.exists() else "there is no such file"
            raise FootageError(f"cannot read {path}: {what}")
        with open_plain(path) as file:
            head = file.read(12)
        if (kind := _unread_kind(head)) is not None:
            raise FootageError(f"cannot read {path}: it is a picture in {kind}: save it as PNG, TIFF or JPEG")
        if path.suffix.lower() in _RAW_SUFFIXES:
            raise FootageError(f"cannot read {path}: {RAW}")
        if path.suffix.lower() in IMAGE_SUFFIXES or is_heic(head):
            return ImageFolder.of_file(path, says)
        return VideoFile(path, says)
    except (FootageError, ShapeError) as error:
        if str(path) in str(error):
            raise
        raise FootageError(f"cannot read {path}: {error}") from None
    except OSError as error:
        raise FootageError(f"cannot read {path}: {error.strerror or error}") from None


def _unread_kind(head: bytes) -> str | None:
    """Return the name of a kind of picture that is not read, by how the file begins; None: it is another file."""
    if head[4:8] == b"ftyp":
        return _UNREAD.get(head[8:12])
    return "GIF" if head.startswith(b"GIF8") else None
