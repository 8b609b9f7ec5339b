"""From a user's array to linear light with the stripes along the rows, or a line that refuses it."""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Geometry
from pipeline.decoding.light_model import LightModel
from pipeline.errors import FootageError
from pipeline.settings import DecodeSettings
from pipeline.text import sizes_differ
from tikernels import checks, runtime
from tikernels.arrays import LevelsImage
from tikernels.checks import on_host
from tikernels.errors import ShapeError
from tikernels.phase.frame_statistics import count_out_of_range
from tikernels.raw.lateral_color import align_channels
from tikernels.raw.linearization import WHITE_LEVELS, linearize
from tikernels.raw.repeated_chroma import RepeatedChroma, find_repeated_chroma, undo_repeated_chroma
from tikernels.transposing import transpose

# Smaller frames hold no surface.
_MIN_SIZE_PX = 16


@dataclass(frozen=True, eq=False)
class LinearFrame:
    """A frame in linear light, its colours aligned and its stripes along the rows."""

    image: LevelsImage  # (H, W, 3)
    white: float  # full scale, levels
    shared: bool = True  # whether the image is in its caller's memory
    repeated: RepeatedChroma | None = None  # how its colours were repeated, which is undone

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return int(self.image.shape[0]), int(self.image.shape[1])


class FrameReader:
    """Check frames of one rig, and bring them into the form that every stage takes.

    Parameters
    ----------
    settings : DecodeSettings
        Full scale and stripes.
    light : LightModel
        The camera's encoding of light, and its lateral colour.
    geometry : Geometry, optional
        The calibrated rig's, for images of one size.
    reference : (H, W) float32, optional
        The origin of ranges, for images of its size.
    """

    def __init__(
        self,
        settings: DecodeSettings,
        light: LightModel,
        geometry: Geometry | None,
        reference: npt.NDArray[np.float32] | None,
    ) -> None:
        self._settings = settings
        self._light = light
        self._geometry = geometry
        self._reference_shape = None if reference is None else reference.shape

    def read(self, image: LevelsImage) -> LinearFrame:
        """Return a frame in linear light.

        Raises
        ------
        ShapeError, CalibrationError, FootageError
            See `Decoder.decode`.
        """
        image = cast(LevelsImage, on_host("image", image))
        if isinstance(image, np.ndarray) and image.dtype == np.float64:
            image = image.astype(np.float32)
        self._check_shape(image)
        dtype = runtime.dtype_name(image)
        if dtype not in WHITE_LEVELS:
            raise ShapeError(f"image is {dtype}: pass uint8, uint16 or float32 levels")
        image = checks.read_array("image", image, (None, None, 3), checks.element_type(image))
        given = image
        if isinstance(image, np.ndarray):
            image = runtime.to_device(image)
        white = self._settings.white_level or WHITE_LEVELS[dtype]
        if dtype == "float32" or white < WHITE_LEVELS[dtype]:
            missing, outside = count_out_of_range(image, white)
            if missing:
                raise FootageError(f"image holds NaN in {missing} values: replace them, by 0 for pixels to be masked")
            if outside:
                raise FootageError(
                    f"image has {outside} values outside 0..{white:g}: scale it, or set white_level to its full scale"
                )
        repeated = None
        if isinstance(given, np.ndarray) or dtype != "float32":  # floats on a device come of planes or of a mosaic
            levels = runtime.to_host(given)
            repeated = find_repeated_chroma(levels, white)
            if repeated is not None:
                image = runtime.to_device(undo_repeated_chroma(levels, white, repeated))
        transfer = self._light.transfer
        if not isinstance(transfer, str) or transfer != "linear":
            image = linearize(image, transfer, white, white)
        if self._light.camera_shift_px is not None:
            image = align_channels(image, self._light.camera_shift_px)
        image = transpose(image) if self._settings.stripes == "vertical" else image
        return LinearFrame(image, white, shared=image is given, repeated=repeated)

    def _check_shape(self, image: Any) -> None:
        if not isinstance(image, np.ndarray) and not runtime.is_device_array(image):
            raise ShapeError(f"image is a {type(image).__name__}: pass a NumPy array of shape (H, W, 3)")
        shape = tuple(image.shape)
        channels = shape[2:]
        if len(shape) == 2 or channels == (1,):
            raise ShapeError(f"image is grey ({size_text(shape)}): the phase is in the colours, pass (H, W, 3) RGB")
        if channels == (4,):
            raise ShapeError("image has four channels: drop the transparency with image[..., :3]")
        if channels != (3,):
            raise ShapeError(f"image has shape {shape}: pass (H, W, 3) RGB")
        if min(shape[:2]) < _MIN_SIZE_PX:
            raise ShapeError(f"image is {size_text(shape)}: at least {_MIN_SIZE_PX}x{_MIN_SIZE_PX} px are needed")
        if self._geometry is not None:
            self._geometry.check_frame((shape[1], shape[0]))
        if self._reference_shape is not None and self._reference_shape != shape[:2]:
            raise ShapeError(sizes_differ("frame", shape[1::-1], "the reference is", self._reference_shape[::-1]))


def size_text(shape: tuple[int, ...]) -> str:
    """Return the size of an image of a shape (H, W, ...) for messages: width x height."""
    return f"{shape[1]}x{shape[0]}"
