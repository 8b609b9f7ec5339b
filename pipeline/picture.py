"""Read a colour picture, or say in one line why it is none."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.errors import FootageError

# How each kind of file begins and how a whole one ends; OpenCV decodes the rest of a truncated one as grey.
_ENDS = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8\xff": b"\xff\xd9"}


def read_picture(path: str | Path) -> npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]:
    """Read an image file as RGB.

    Returns
    -------
    (H, W, 3) uint8, uint16 or float32
        The levels as they are stored.

    Raises
    ------
    FootageError
        The file cannot be read, is truncated, is no picture, or has no three colours.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        what = "it is a folder, give one picture" if path.is_dir() else error.strerror or str(error)
        raise FootageError(f"cannot read {path}: {what}") from None
    for start, end in _ENDS.items():
        if data.startswith(start) and end not in data[-1024:]:
            raise FootageError(f"{path} is truncated: copy it again")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the message below says it in one line
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error:
        image = None
    if image is None:
        raise FootageError(f"{path} is not a picture that can be read: give a PNG, TIFF or JPEG file")
    if image.ndim == 2:
        raise FootageError(f"{path} is grey: the phase is in the colours, give a colour picture")
    if image.shape[2] != 3:
        raise FootageError(f"{path} has {image.shape[2]} channels: save it without transparency")
    if image.dtype not in (np.uint8, np.uint16, np.float32):
        raise FootageError(f"{path} holds {image.dtype} values: save it with 8 or 16 bits")
    return np.ascontiguousarray(image[..., ::-1])
