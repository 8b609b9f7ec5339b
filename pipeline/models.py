"""Models of users' files: frozen, unknown keys refused, errors that name the key."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic_core import core_schema

import hardware.models
from hardware.models import first_fault
from pipeline.errors import SettingsError
from pipeline.limits import read_text
from tikernels.errors import Error

if TYPE_CHECKING:
    from hardware.protocols import CameraLimits

FloatArray = npt.NDArray[np.float64]
#: Levels in any element type that cameras and files give: a colour image (H, W, 3), or one plane of a stored frame.
ImageArray = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]

#: The ways in which a pattern shows the cycle of a place, and those that users may name.
CodeName = Literal["contrast", "contrast2"]
CodeChoice = Literal[CodeName, "none"]

#: Nothing in a rig's files is as large, whatever its unit; and its fourth power still is a float32.
LARGEST = 1e9
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
#: A number with a sign.
Signed = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class Model(hardware.models.Model):
    """A frozen record whose unknown keys are refused."""

    error_type: ClassVar[type[Error]] = SettingsError


M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True)
class ArrayOf:
    """Annotate a field as a read-only float64 array of this shape, a nested list in the file."""

    shape: tuple[int, ...]
    largest: float = LARGEST  # of what it holds, whatever the sign

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        to_list = core_schema.plain_serializer_function_ser_schema(lambda array: array.tolist())
        return core_schema.no_info_plain_validator_function(self.read, serialization=to_list)

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "array", "shape": self.shape}

    def read(self, value: Any) -> FloatArray:
        """Turn numbers into the array, or state what they should be."""
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            raise ValueError(f"must be {'x'.join(map(str, self.shape))} numbers") from error
        if array.shape != self.shape:
            raise ValueError(f"must have shape {self.shape}, got {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError("must be finite")
        if np.abs(array).max() > self.largest:
            raise ValueError(f"must lie from {-self.largest:g} to {self.largest:g}")
        array.setflags(write=False)
        return array


Vector3 = Annotated[FloatArray, ArrayOf((3,))]
Matrix3 = Annotated[FloatArray, ArrayOf((3, 3))]


class CameraState(Model):
    """The camera's state, as calibrations and settings of footage hold it."""

    exposure_s: Positive | None = None
    gain: Signed | None = None
    white_balance: Vector3 | None = None
    transfer: Literal["linear", "srgb", "bt709"] | Annotated[FloatArray, ArrayOf((256,))] | None = None
    """The camera's encoding of light; or, measured, the linear light of 256 levels, from 0 to 1."""


_Count = Annotated[int, Field(ge=1, lt=2**20)]
_Offset = Annotated[int, Field(ge=0, lt=2**20)]


class SensorPart(Model):
    """The part of its sensor that a camera's frames are, as `hardware.SensorPart` states it."""

    sensor_px: tuple[_Count, _Count]  # width and height of the sensor
    offset_px: tuple[_Offset, _Offset]  # first column and row that are read out, of the sensor
    binning: tuple[_Count, _Count]  # columns and rows of the sensor that make one of the frame

    @classmethod
    def of(cls, limits: "CameraLimits") -> "SensorPart | None":
        """Return that of a camera as it is set up; None: unknown."""
        return None if limits.sensor is None else cls.model_validate(asdict(limits.sensor))

    def __str__(self) -> str:
        return "{}x{} from {},{}, binned {}x{}".format(*self.sensor_px, *self.offset_px, *self.binning)


def build(model: type[M], values: Any, error: type[Exception], where: str) -> M:
    """Validate values into a model; the first fault becomes one line that names its key.

    Raises
    ------
    Exception
        The given error type.
    """
    try:
        return model.model_validate(values)
    except ValidationError as invalid:
        raise error(f"{where}: {first_fault(model, invalid)}") from None


def read_file(path: str | Path, model: type[M], parse: Callable[[str], Any], error: type[Exception]) -> M:
    """Read a text file into a model.

    Raises
    ------
    Exception
        The given error type, with one line that names the file and the key.
    """
    try:
        values = parse(read_text(path))
    except OSError as fault:
        raise error(f"cannot read {path}: {fault.strerror or fault}") from None
    except RecursionError:
        raise error(f"{path} is not what it should be: its values are nested too deep") from None
    except ValueError as fault:  # JSON and TOML raise one, too
        raise error(f"{path} is not what it should be: {str(fault).splitlines()[0]}") from None
    return build(model, values, error, str(path))
