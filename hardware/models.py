"""Base of all models that users fill: frozen, unknown keys refused, errors that name the key."""

import json
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaWarningKind

from hardware.errors import RigError
from tikernels.errors import Error

# Letters of a wrong value that an error shows.
_LONGEST_SHOWN = 40

if TYPE_CHECKING:  # a metaclass with `__call__` would hide the constructors' signatures
    _Base = BaseModel
else:

    class _ModelType(type(BaseModel)):
        """Type of the models. Validation of nested values does not call it, so that keys are named from the top."""

        def __call__(cls, *args, **values):
            try:
                return super().__call__(*args, **values)
            except ValidationError as invalid:
                raise cls.error_type(first_fault(cls, invalid)) from None

    class _Base(BaseModel, metaclass=_ModelType):
        pass


class Model(_Base):
    """A frozen record whose unknown keys are refused; its constructor raises `error_type`, with one line."""

    model_config = ConfigDict(frozen=True, extra="forbid", arbitrary_types_allowed=True, allow_inf_nan=False)
    error_type: ClassVar[type[Error]] = RigError

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other values, checked as by the constructor."""
        return type(self)(**{name: getattr(self, name) for name in self.model_fields_set} | changes)


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

    >>> from hardware.settings import TimingSettings
    >>> allowed_values(TimingSettings, "period_s")
    'a number above 0 and at most 3600'
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
    # The base class declares it as an attribute of instances.
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
