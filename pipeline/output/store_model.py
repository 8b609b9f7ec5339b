"""The valid metadata of a ``result.zarr``: its checksum detects accidents, not tampering."""

from datetime import datetime
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from hardware.models import first_fault
from pipeline.calibration.lens import Lens
from pipeline.decoding.front_side import RimVotes
from pipeline.decoding.rig_state import RigState
from pipeline.decoding.self_calibration import LightEstimate
from pipeline.errors import DamageError
from pipeline.limits import MOST_FRAMES
from pipeline.models import CodeName

_Count = Annotated[int, Field(ge=0, le=MOST_FRAMES)]
# A plain name: it chooses what is read.
_Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,63}$")]
M = TypeVar("M", bound=BaseModel)


class _Said(BaseModel):
    """The content of a file; entries that a later version adds are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore", arbitrary_types_allowed=True)


class _Footage(_Said):
    name: str


class StoreAttributes(_Said):
    """A store's attributes of how its frames were decoded, as far as they are read again."""

    colorphase_version: str
    settings: dict[str, Any]
    fields: tuple[_Name, ...]
    coordinates: str = ""  # stores that an earlier version made have none
    calibration_sha256: str | None = None
    range_unit: Literal["mm", "rad"] = "rad"
    footage: _Footage | None = None
    step: Annotated[int, Field(ge=1, le=MOST_FRAMES)] = 1
    rims: dict[Literal["falls", "grows", "needed"], _Count] = {}
    code: CodeName | None = None
    light: LightEstimate | None = None
    camera: Lens | None = None

    @property
    def state(self) -> RigState:
        """The rig's state as estimated from frames, all of it settled."""
        return RigState(self.light, self.code, RimVotes(**self.rims), frozenset())


class GroupSays(_Said):
    """A store's own ``zarr.json``."""

    attributes: StoreAttributes


class _ArrayLabels(_Said):
    units: str | None = None

    @property
    def since(self) -> str | None:
        """The origin of times; None: the first frame."""
        return (self.units or "").partition(" since ")[2] or None

    @model_validator(mode="after")
    def _check(self) -> "_ArrayLabels":
        if self.since is not None:
            datetime.fromisoformat(self.since)
        return self


class ArraySays(_Said):
    """The ``zarr.json`` of one of its arrays."""

    shape: tuple[_Count, ...]
    attributes: _ArrayLabels = _ArrayLabels()


def parsed(model: type[M], content: bytes, where: str) -> M:
    """Return the content of a file of metadata.

    Raises
    ------
    DamageError
        Its content is invalid; `where` names the file.
    """
    try:
        return model.model_validate_json(content)
    except ValidationError as invalid:
        raise DamageError(f"{where} is not what was written ({first_fault(model, invalid)})") from None
