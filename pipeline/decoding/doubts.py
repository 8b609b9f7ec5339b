"""Warnings about a frame, each in one line that states what to do."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.causes import Cause, Key
from pipeline.decoding.frame import FrameMemory
from pipeline.decoding.frame_reader import LinearFrame
from pipeline.decoding.surface_search import NoModelFits
from tikernels import runtime
from tikernels.arrays import LevelsImage
from tikernels.phase.color_fields import ColorFields
from tikernels.phase.field_motion import FieldMotion, RowMotion
from tikernels.phase.frame_statistics import COLUMNS, MIN_PERIOD_PX, FrameLevels, measure_frame
from tikernels.raw.repeated_chroma import RepeatedChroma
from tikernels.transposing import transpose

#: Issued once, by the frame that shows it.
CODE_SHOWN = Cause(
    "code shown",
    'the frame shows a contrast code, which is used: set code = "none" (--code none) to decode it as plain',
)
# Below this contrast, blur may have turned the fringe over; a sharp pattern in as much other light has a third.
_MIN_CONTRAST = 0.12
#: A code needs more: a simulated bust keeps all its orders at .73, and loses a fifth to a third of them at .53.
CODE_CONTRAST = 0.65
_LOWERED = (
    "the fringe's contrast is only {:.0%}, and the frame does not show whether other light, blur, a wrong transfer or "
    "colours of a lower resolution take it: colorphase inspect looks at the file, and a frame under black shows the "
    "other light"
)
#: A fringe that differs by more from what the crosstalk makes is more than the leaks of a good calibration are off by.
MAX_MISMATCH = 0.12
# A share of the pixels that is lost unnoticed, as at edges.
_FEW = 0.05
# A frame is dark whose brightest thousandth stays below this share of full scale.
_BRIGHTEST, _DIM = 0.999, 0.15
# From this share on, clipped channels cost more than noise does: simulated planes, balls and busts are off by 1.2 times
# as much at .05, twice as much at .15 and ten times as much at .4.
_MOST_CLIPPED = 0.1
# Colours agree with a calibration if they are off by less than this plus twice the misfit of those that fit best.
_MISMATCH = 0.02
# What a frame is that fits the calibration when it is changed so.
_REVERSED: dict[Key, str] = {
    "turned over": "turned over it fits: the camera's or the projector's picture is upside down or mirrored; turn it",
    "colours swapped": "its colours are stored in the order B, G, R, and exchanged they fit: exchange red and blue",
}
_UNDECIDED = (
    "it is upside down or mirrored, or its colours are stored in the order B, G, R, which only a code or a calibrated "
    "crosstalk can distinguish: turn it, or exchange red and blue"
)
_NEITHER = "it fits neither turned over nor with red and blue exchanged: check that the calibration is this rig's"

# A fringe that is too fine has this share of the changes along columns, and its frequency differs from place to place
# by this fraction: white noise has a sixth of its power in such a band.
_FRINGE_SHARE, _FRINGE_BAND = 0.25, 0.08


def fringe_doubt(frame: LinearFrame, stripes: str, clipped: float) -> Cause:
    """Say why no fringe was found in a frame; from `clipped` levels on its light counts as full scale."""
    # First, for what is too fine to be seen beats with the pixels, and may then pass for stripes the other way.
    finest = finest_fringe(frame.image)
    if finest is not None:
        return Cause(
            "too fine",
            f"the fringe has {finest:.1f} px a cycle in this frame, and {MIN_PERIOD_PX:g} are the least: go nearer, "
            "take more pixels, or project a longer period",
        )
    if measure_frame(transpose(frame.image), frame.white).period_px is not None:
        other = "vertical" if stripes == "horizontal" else "horizontal"
        words = f"no {stripes} fringe stands out, but a {other} one does: set stripes to {other!r} (--stripes {other})"
        return Cause("other stripes", words)
    badly = _badly_exposed(runtime.to_host(frame.image), frame.white, clipped)
    words = "exposure and direction are right, and no fringe is too fine: look whether it shows the pattern, and sharp"
    key, cause = badly or ("no fringe", words)
    return Cause(key, f"no fringe stands out of this frame: {cause}")


def _badly_exposed(image: npt.NDArray[Any], white: float, clipped: float) -> tuple[Key, str] | None:
    """Return the key and words of a frame that is over- or under-exposed; None: it is neither."""
    share = float((image.max(axis=2) >= clipped).mean())
    brightest = float(np.quantile(image, _BRIGHTEST)) / white
    if share > _MOST_CLIPPED:
        return "over-exposed", f"{share:.0%} of it is over-exposed: expose it shorter"
    if brightest < _DIM:
        words = f"its brightest places reach {brightest:.0%} of full scale only: expose it longer, or open the aperture"
        return "under-exposed", words
    return None


class Changed(NamedTuple):
    """A frame that was turned over, or whose red and blue were exchanged, decoded as such; None: nothing shows it."""

    read: float | None  # share of its surfaces whose code is read
    mismatch: float | None  # of its colours from those that the crosstalk predicts, as a fraction


def reversed_doubt(changed: dict[Key, Changed]) -> Cause:
    """Say why a frame's phase runs against the calibrated rig's, by what became of it when it was changed."""
    least = min((found.mismatch for found in changed.values() if found.mismatch is not None), default=0.0)
    most = min(MAX_MISMATCH, _MISMATCH + 2 * least)
    fits = [
        key
        for key, found in changed.items()
        # Of a frame that is as calibrated the code is read on nearly all surfaces, of others on hardly any.
        if (found.read is None or found.read > 0.5) and (found.mismatch is None or found.mismatch < most)
    ]
    key: Key
    if len(fits) == 1:
        key, words = fits[0], _REVERSED[fits[0]]
    else:
        key = "reversed" if fits else "reversed for another reason"
        words = _UNDECIDED if fits else _NEITHER
    return Cause(key, f"the phase runs against the calibrated rig's, so that no depth can be determined: {words}")


def few_pixels_doubt(frame: LinearFrame, levels: FrameLevels, contrast: float, n_measured: int) -> Cause | None:
    """Say what a frame with a fringe of some contrast lacks if next to nothing was measured; None: enough was."""
    height, width = frame.shape
    if n_measured >= _FEW * height * width:
        return None
    image = runtime.to_host(frame.image)
    lit = int((image.mean(axis=2) >= levels.intensity).sum())
    if 0 < n_measured and n_measured >= 0.5 * lit:  # a small thing before a black curtain
        return None
    weak: tuple[Key, str] = (
        "weak fringe",
        f"too little of a fringe stands out of the noise, {levels.noise / frame.white:.1%} of full scale; the exposure "
        f"is right, and the fringe's contrast is {contrast:.0%}: light more by the pattern, or lower the gain",
    )
    if contrast < _MIN_CONTRAST:
        weak = "low contrast", _LOWERED.format(contrast)
    key, cause = _badly_exposed(image, frame.white, levels.clipped) or weak
    share = "nothing" if n_measured == 0 else f"only {n_measured / (height * width):.1%}"
    return Cause(key, f"{share} of this frame could be measured: {cause}")


def over_exposure_doubt(clipped: float) -> Cause | None:
    """State that a share of the lit pixels has a channel at full scale; None: too little of it to matter."""
    if clipped < _MOST_CLIPPED:
        return None
    words = f"{clipped:.0%} of what is lit has a colour at full scale, which bends its phase: expose it shorter"
    return Cause("over-exposed", words)


def repeated_chroma_doubt(repeated: RepeatedChroma) -> Cause:
    """Say how a frame's colours were repeated, and what is better."""
    words = (
        f"each colour of this frame is repeated for {repeated}, as cv2.VideoCapture and ffmpeg make RGB of a video; it "
        "was interpolated instead, which leaves more error than the video itself: decode that, or record its planes"
    )
    return Cause("repeated-chroma", words)


def folded_lens_doubt(n_blind: int, shape: tuple[int, int]) -> Cause:
    """Say how many pixels of a frame have no ray."""
    share = n_blind / (shape[0] * shape[1])
    words = (
        f"{n_blind} pixels ({share:.1%}) are left out, for which the calibration has no ray: its lens folds before it "
        "reaches them; calibrate with the board in the picture's corners, too"
    )
    return Cause("folded lens", words)


def finest_fringe(light: LevelsImage) -> float | None:
    """Return the period of a fringe too short to be decoded, px, stripes along the rows; None: there is none."""
    image = runtime.to_host(light)
    columns = image[:, :: max(1, image.shape[1] // COLUMNS)].astype(np.float64)
    power = (np.abs(np.fft.rfft(columns - columns.mean(axis=0), axis=0)) ** 2).sum(axis=(1, 2))
    cycles = np.arange(len(power))
    # One that has a share of all that changes along a column; noise spreads over all frequencies.
    peak = int(np.argmax(power * (cycles * MIN_PERIOD_PX > image.shape[0])))
    near = power * (np.abs(cycles - peak) <= max(1.0, _FRINGE_BAND * peak))
    if peak == 0 or near.sum() < _FRINGE_SHARE * power.sum():
        return None
    return float(image.shape[0] * near.sum() / (near @ cycles))


def light_doubts(
    contrast: float,
    mismatch: float,
    odd: NoModelFits | None,
    mm_per_rad: Callable[[], float | None],
    *,
    constant_known: bool,
    code_lost: bool = False,
) -> tuple[Cause, ...]:
    """State where the light is not as decoding assumes.

    Parameters
    ----------
    contrast : float
        The fringe's mean modulation over its mean background.
    mismatch : float
        Relative deviation of the channels' fundamentals from those that the crosstalk predicts.
    odd : NoModelFits, optional
        Surfaces whose colours no matrix explains.
    mm_per_rad : callable
        Returns the depth of a radian, mm; None without a calibration.
    constant_known : bool
        True if the crosstalk is known, so that a mismatch means that it has changed.
    code_lost : bool
        True if the pattern's code could not be read everywhere.
    """
    doubts: dict[Key, str] = {}
    if contrast < (CODE_CONTRAST if code_lost else _MIN_CONTRAST):
        doubts["low contrast"] = _LOWERED.format(contrast)
    if constant_known and mismatch > MAX_MISMATCH:
        doubts["other crosstalk"] = (
            f"the colours' fringes differ by {mismatch:.0%} from the crosstalk matrix's prediction, and phases "
            f"may be off by as much, {_in_depth(mismatch, mm_per_rad)}: colorphase inspect looks at the file, "
            "calibrate check at the rig"
        )
    elif odd is not None:
        excluded = "it is not the crosstalk; " if constant_known else ""
        doubts["odd colours"] = (
            f"no matrix explains the colours of {odd.share:.0%} of the surface, {odd.color} above all, where phases "
            f"may be off by about {_in_depth(odd.phase_rad, mm_per_rad)}. The frame does not show why: {excluded}other "
            "light, paint that fluoresces, light that scatters, colours of a lower resolution, too fine a print "
            "and another response than the calibrated one (which colorphase calibrate check would show) look like this"
        )
    return tuple(Cause(key, words) for key, words in doubts.items())


def motion_doubts(
    motion: FieldMotion | None, row_motion: RowMotion | None, fields: ColorFields | None, memory: FrameMemory | None
) -> tuple[Cause, ...]:
    """Say which motion inside a frame is left, and in which order the frames show that its colours come."""
    doubts: dict[Key, str] = {}
    for moved, parts in ((row_motion, "rows"), (motion, "colours")):
        if moved is not None and moved.too_fast > _FEW:
            doubts["too fast"] = (
                f"{moved.too_fast:.0%} of the surface moves by a third of a cycle or more from frame to frame: its "
                f"{parts}, one after another, cannot be put together there; take frames faster"
            )
        if moved is not None and memory is not None and moved.guessed > _FEW:
            doubts["frames apart"] = (
                f"{moved.guessed:.0%} of the surface moves between {parts} that are taken one after another, and the "
                f"previous frame is {memory.elapsed:.3g} frames back: how fast it moves is a guess, and sigma contains "
                "that; decode every frame (step 1)"
            )
    if motion is None or fields is None:
        return tuple(Cause(key, words) for key, words in doubts.items())
    rows = max(motion.times.shape[:2])
    order = fields.found_order(motion.shares, rows)
    if motion.unknown > _FEW:
        doubts["fields unknown"] = (
            f"{motion.unknown:.0%} of the surface moves while the projector shows its colours one after another, and "
            "the frames so far do not show which one when; sigma contains what it costs. State projector.fields and "
            "camera.row_s in the rig file if they are not"
        )
    before = None if memory is None or memory.fields is None else fields.found_order(memory.fields, rows)
    if order is not None and before is None:
        doubts["field order shown"] = (
            f"the projector's colours come in the order {order}, as the frames show: state projector.fields in the rig "
            "file"
        )
    return tuple(Cause(key, words) for key, words in doubts.items())


def _in_depth(phase_rad: float, mm_per_rad: Callable[[], float | None]) -> str:
    """Return a phase in words, with what it is in depth where that is known."""
    per_rad = mm_per_rad()
    depth = "" if per_rad is None else f" ({phase_rad * per_rad:.2g} mm)"
    return f"{phase_rad:.2f} rad{depth}"
