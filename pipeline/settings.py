"""Settings of decoding."""

import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from pipeline.errors import SettingsError
from pipeline.models import ArrayOf, CameraState, CodeChoice, FloatArray, Matrix3, Model, read_file
from tikernels.errors import ShapeError
from tikernels.phase.color_fields import ColorFields
from tikernels.phase.crosstalk import invert_crosstalk
from tikernels.phase.frame_statistics import MIN_PERIOD_PX
from tikernels.phase.smoothing import MAX_SMOOTHING_PX

# The tallest sensors have 14,200 rows, and a cycle and a half is the least that a frame shows of a fringe.
_MAX_PERIOD_PX = 10_000
# Up to here float32 counts every level; and floats from 0 to 1 may have been scaled down, but not to where their
# noise's squares are too small for it.
_MIN_WHITE, _MAX_WHITE = 2.0**-10, float(2**24)
# An hour, as in `hardware.settings`; and by how much times may miss each other, as in `hardware.colour_cycle`.
_LONGEST_S, _OFF = 3600.0, 0.002
_Level = Annotated[float, Field(ge=0, le=_MAX_WHITE)]


class FieldTimes(Model):
    """A projector that shows red, green and blue one after another, before a camera that exposes whole cycles."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    cycle_s: Annotated[float, Field(gt=0, le=_LONGEST_S)]
    """Time of red, green and blue together."""
    shown_s: Annotated[FloatArray, ArrayOf((3, 2), _LONGEST_S)] | None = None
    """Times when red, green and blue go on and off in a cycle; None: a third of it each, in an order that the frames
    show or not."""
    locked: bool = False
    """True if every exposure starts with a cycle; false: its start is found in each frame."""

    @model_validator(mode="after")
    def _check(self) -> "FieldTimes":
        if self.shown_s is None:
            if self.locked:
                raise ValueError("locked needs shown_s, when each colour is on after the start of an exposure")
            return self
        turns = sorted(self.shown_s.tolist())
        if any(on >= off for on, off in turns) or turns[-1][1] - turns[0][0] > self.cycle_s * (1 + _OFF):
            raise ValueError(f"each colour must go on before it goes off, and all within {self.cycle_s:g} s")
        if any(off > on for (_, off), (on, _) in pairwise(turns)):
            raise ValueError(
                "two colours are on at the same time: a white, yellow or cyan segment belongs to no colour, and its "
                "motion cannot be undone: switch it off in the projector's menu (BrilliantColor, white boost)"
            )
        return self

    def in_cycles(self, frame_s: float, row_s: float) -> ColorFields:
        """Return it as decoding uses it."""
        shown = None if self.shown_s is None else self.shown_s / self.cycle_s
        start = 0.0 if self.locked else None
        return ColorFields(self.cycle_s / frame_s, row_s / self.cycle_s, shown, start)


def _odd_or_zero(value: int) -> int:
    if value != 0 and value % 2 == 0:
        raise ValueError(f"must be 0 or odd, got {value}")
    return value


class DecodeSettings(Model):
    """Settings of decoding; in TOML, omitted ones have their defaults.

    Thresholds and noise are grey levels of the input, in linear light (a sRGB frame's after its transfer is undone).

    Examples
    --------
    >>> colorphase.DecodeSettings(camera_period_px=12, smoothing_px=5).smoothing_px
    5
    """

    model_config = ConfigDict(use_attribute_docstrings=True)

    camera_period_px: Annotated[float, Field(ge=MIN_PERIOD_PX, le=_MAX_PERIOD_PX)] | None = None
    """Camera px per cycle, roughly; None: measured from the frame."""
    stripes: Literal["horizontal", "vertical"] = "horizontal"
    """"horizontal" where the phase changes from row to row; stripes may be tilted by 20 degrees."""
    crosstalk_matrix: Matrix3 | None = None
    """camera = matrix @ projector in linear light; wins over the calibration's."""
    reflectance_bands: Literal["broad", "narrow"] | None = None
    """The place where a surface's colour acts: "broad" on the camera's channels, after the crosstalk, "narrow" on the
    projector's primaries, before it. Real surfaces are between the two; None: found in the frame, surface by
    surface."""
    transfer: Literal["linear", "srgb", "bt709"] | None = None
    """Encoding of light by the camera; undone before anything else. None: as the calibration has measured it, else as
    the file states, where a JPEG without a statement is sRGB; else, and for arrays, linear."""
    capture: CameraState | None = None
    """The camera's settings for this footage; compared with the calibration's."""
    equalize: bool = True
    """True to undo an unknown response of the projector by making the phase's distribution uniform. A calibration's
    response is used in either case; so is the first frame's estimate where nothing is known of the light (see
    `Decoder`)."""
    smoothing_px: Annotated[int, Field(ge=0, le=MAX_SMOOTHING_PX), AfterValidator(_odd_or_zero)] = 7
    """Side of the window that the phase is smoothed over, along the stripes and across them, an odd number; 0: none."""
    projector_side: Literal["above", "below", "left", "right"] | None = None
    """The projector's side, as the camera's picture shows it: "above" or "below" with horizontal stripes, "left" or
    "right" with vertical ones. It determines which side of a surface is in front where no calibration does; None: the
    frame determines it, in which surfaces turn away from the camera at their rims."""
    code: CodeChoice | None = None
    """The pattern's code, by which orders become absolute. "contrast": the modulation of each cycle shows which one it
    is, as in what `colorphase pattern` makes; "contrast2": that of its cells, as wide as in the calibration's pattern;
    "none": the pattern is plain. None: the calibration's pattern has one, or the first frame with fringes shows it."""
    fields: FieldTimes | None = None
    """Times of red, green and blue where the projector shows them one after another. Then `previous` shows what moved
    in between, and, unless `fields.locked`, when each exposure began. It needs `frame_s`. None: all at once."""
    frame_s: Annotated[float, Field(gt=0, le=_LONGEST_S)] | None = None
    """From one frame of a video to the next. None: not known, as of single pictures."""
    row_s: Annotated[float, Field(ge=0, le=_LONGEST_S)] = 0.0
    """From one row's exposure to the next one's, of a camera with a rolling shutter: each row shows what moves where it
    is in the middle of the row's own exposure. With `frame_s` and `previous` the phase is carried to that of the middle
    row. Pictures must not be turned. 0: all rows at once, or not known."""
    noise: tuple[_Level, _Level] | None = None
    """Read noise's standard deviation s and gain g, in grey levels: a channel's variance is s^2 + g times its level.
    None: estimated from the frame."""
    white_level: Annotated[float, Field(ge=_MIN_WHITE, le=_MAX_WHITE)] | None = None
    """Full scale of the input, from 2^-10 to 2^24; None: the type's (1.0 for floats)."""
    min_intensity: _Level | None = None
    """Darkest mean of the three channels that counts; None: chosen from the frame."""
    min_modulation: _Level | None = None
    """Smallest amplitude of the fringe that counts; None: 3 % of the frame's brightness, and the phase must have a
    standard deviation, computed from light and noise, of at most 0.2 rad after smoothing."""

    @model_validator(mode="after")
    def _check(self) -> "DecodeSettings":
        if self.crosstalk_matrix is not None:
            try:
                invert_crosstalk(self.crosstalk_matrix, normalize_rows=True)
            except ShapeError as error:
                raise ValueError(str(error)) from None
        if self.fields is not None and self.frame_s is None:
            raise ValueError("fields need frame_s, the time from one frame to the next")
        if self.fields is not None and self.frame_s is not None and self.fields.cycle_s > self.frame_s * (1 + _OFF):
            raise ValueError(
                f"fields: a colour cycle of {self.fields.cycle_s:g} s is longer than a frame of {self.frame_s:g} s, "
                "whose exposure cannot see all colours: take frames at a lower rate"
            )
        sides = ("above", "below") if self.stripes == "horizontal" else ("left", "right")
        if self.projector_side not in (None, *sides):
            raise ValueError(
                f"projector_side is {self.projector_side!r} and stripes are {self.stripes}: they determine depth only "
                f"with a projector {' or '.join(sides)}"
            )
        return self

    @classmethod
    def read(cls, path: str | Path) -> "DecodeSettings":
        """Read settings from TOML.

        Raises
        ------
        SettingsError
            The file cannot be read, or a key is unknown or wrong; the message names it.
        """
        return read_file(path, cls, tomllib.loads, SettingsError)
