"""Models of users' files: frozen, unknown keys refused, errors that name the key."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, ValidationError
from pydantic_core import core_schema

from pipeline.limits import read_text

FloatArray = npt.NDArray[np.float64]
#: Levels in any element type that cameras and files give: a colour image (H, W, 3), or one plane of a stored frame.
ImageArray = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]

#: Nothing in a rig's files is as large, whatever its unit; and its fourth power still is a float32.
LARGEST = 1e9
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
#: A number with a sign.
Signed = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class Model(BaseModel):
    """A frozen record whose unknown keys are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False)


M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True)
class ArrayOf:
    """Annotate a field as a read-only float64 array of this shape, a nested list in the file."""

    shape: tuple[int, ...]
    largest: float = LARGEST  # of what it holds, whatever the sign

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        to_list = core_schema.plain_serializer_function_ser_schema(lambda array: array.tolist())
        return core_schema.no_info_plain_validator_function(self.read, serialization=to_list)

    def read(self, value: Any) -> FloatArray:
        """Turn numbers into the array, or say what they should be."""
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
        raise error(f"{where}: {first_fault(invalid)}") from None


def first_fault(invalid: ValidationError) -> str:
    """Return the first fault that a model has found, by its key, and how many more there are."""
    faults = invalid.errors(include_url=False)
    fault = faults[0]
    key = "".join(f"{part}." for part in fault["loc"]).rstrip(".") + ": " if fault["loc"] else ""
    reason = {"extra_forbidden": "is not a known key", "missing": "is missing"}.get(
        fault["type"], fault["msg"].removeprefix("Value error, ")
    )
    more = f" (and {len(faults) - 1} more)" if len(faults) > 1 else ""
    return f"{key}{reason}{more}"


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
