"""Models of users' files: frozen, unknown keys refused, errors that name the key."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaWarningKind
from pydantic_core import core_schema

from pipeline.limits import read_text

if TYPE_CHECKING:
    from hardware.protocols import CameraLimits

FloatArray = npt.NDArray[np.float64]
#: Levels in any element type that cameras and files give: a colour image (H, W, 3), or one plane of a stored frame.
ImageArray = npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]

# Letters of a wrong value that an error shows.
_LONGEST_SHOWN = 40

#: By what a pattern tells the cycle of a place, and what users may name.
CodeName = Literal["contrast", "contrast2"]
CodeChoice = Literal[CodeName, "none"]

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

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "array", "shape": self.shape}

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


_Count = Annotated[int, Field(ge=1, lt=2**20)]
_Offset = Annotated[int, Field(ge=0, lt=2**20)]


class SensorPart(Model):
    """The part of its sensor that a camera's frames are, as `hardware.SensorPart` says it."""

    sensor_px: tuple[_Count, _Count]  # width and height of the sensor
    offset_px: tuple[_Offset, _Offset]  # first column and row that are read out, of the sensor
    binning: tuple[_Count, _Count]  # columns and rows of the sensor that make one of the frame

    @classmethod
    def of(cls, limits: "CameraLimits") -> "SensorPart | None":
        """Return that of a camera as it is set up; None: it does not say."""
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


def first_fault(model: type[BaseModel], invalid: ValidationError) -> str:
    """Return the first fault that a model has found, by its key, and how many more there are."""
    faults = invalid.errors(include_url=False)
    keys = ["".join(f"{part}." for part in _key(fault)).rstrip(".") for fault in faults]
    more = f" (and {len({*keys}) - 1} more)" if len({*keys}) > 1 else ""
    named = f"{keys[0]}: " if keys[0] else ""
    return f"{named}{_reason(model, faults[0])}{more}"


def _key(fault: Any) -> tuple[str | int, ...]:
    """Return the key that a fault is at, without pydantic's names of the types that a value may have."""
    loc: tuple[str | int, ...] = fault["loc"]
    if fault["type"] == "extra_forbidden":
        return loc
    return tuple(part for part in loc if isinstance(part, int) or part.isidentifier())


def _reason(model: type[BaseModel], fault: Any) -> str:
    """Return what is wrong with a value, and what it may be."""
    kind, value = fault["type"], fault["input"]
    if kind in ("extra_forbidden", "missing"):
        return {"extra_forbidden": "is not a known key", "missing": "is missing"}[kind]
    if kind == "value_error":  # of a validator of ours
        return str(fault["msg"]).removeprefix("Value error, ")
    short = isinstance(value, str | float) or (isinstance(value, int) and value.bit_length() < 64)
    shown = json.dumps(value) if short else ""
    got = f", got {shown}" if 0 < len(shown) <= _LONGEST_SHOWN else ""
    return f"must be {allowed_values(model, *_key(fault))}{got}"


def allowed_values(model: type[BaseModel], *key: str | int) -> str:
    """Return what a key of a model, or of a section or list in it, may hold, in words.

    >>> allowed_values(CameraState, "transfer")
    '"linear", "srgb" or "bt709", or 256 numbers'
    """
    schema = model.model_json_schema(schema_generator=_Schema)

    def kinds(of: dict[str, Any]) -> list[dict[str, Any]]:
        if "$ref" in of:
            return kinds(schema["$defs"][of["$ref"].rpartition("/")[2]])
        return [kind for each in of["anyOf"] for kind in kinds(each)] if "anyOf" in of else [of]

    found = [schema]
    for part in key:
        within = [kind for each in found for kind in kinds(each)]
        if isinstance(part, int):
            found = [item for kind in within for item in kind.get("prefixItems", [])[part : part + 1]]
        else:
            found = [kind["properties"][part] for kind in within if part in kind.get("properties", {})]
    return ", or ".join(_words(kind, kinds) for each in found for kind in kinds(each) if kind.get("type") != "null")


class _Schema(GenerateJsonSchema):
    ignored_warning_kinds: set[JsonSchemaWarningKind] = {"skipped-choice", "non-serializable-default"}  # noqa: RUF012


def _words(kind: dict[str, Any], kinds: Callable[[dict[str, Any]], list[dict[str, Any]]]) -> str:
    """Return what a type of JSON Schema allows."""
    if "enum" in kind or "const" in kind:
        *others, last = map(json.dumps, kind.get("enum", [kind.get("const")]))
        return f"{', '.join(others)} or {last}" if others else last
    if "shape" in kind:
        return f"{'x'.join(map(str, kind['shape']))} numbers"
    if "prefixItems" in kind:
        parts = [_words(kinds(item)[0], kinds) for item in kind["prefixItems"]]
        return f"{len(parts)} values, each {parts[0]}" if len({*parts}) == 1 else f"{', '.join(parts)}"
    if "properties" in kind:
        return f"a section of {', '.join(kind['properties'])}"
    if kind.get("type") not in ("integer", "number"):
        words = {"boolean": "true or false", "object": "a section", "array": "a list"}
        return words.get(kind.get("type", ""), "text")
    noun = "a whole number" if kind["type"] == "integer" else "a number"
    if {"minimum", "maximum"} <= kind.keys():
        return f"{noun} from {kind['minimum']:.10g} to {kind['maximum']:.10g}"
    names = {"minimum": "at least", "exclusiveMinimum": "above", "maximum": "at most", "exclusiveMaximum": "below"}
    bounds = [f"{word} {kind[name]:.10g}" for name, word in names.items() if name in kind]
    return f"{noun} {' and '.join(bounds)}".rstrip()


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
