"""The evidence of about twenty frames of footage, one after another, in pairs of neighbours and as a sequence.

Of how they were taken: contrast, clipping, drift, motion, and where their colours sit.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.causes import Cause
from pipeline.decoder import Decoder
from pipeline.decoding.doubts import finest_fringe
from pipeline.decoding.frame import DecodedFrame
from pipeline.decoding.self_calibration import MAX_CONSTANT
from pipeline.diagnosis.channel_spectra import KnownLight
from pipeline.diagnosis.frame_sequence import MIN_FRAMES, SequenceDiagnosis, diagnose_sequence
from pipeline.diagnosis.ripple import Diagnosis, diagnose
from pipeline.errors import DecodeWarning, FootageError
from pipeline.footage.footage import BadFrame, Footage, StoredAs, StoredFrame
from pipeline.models import FloatArray
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.arrays import LevelsImage
from tikernels.phase.frame_statistics import measure_frame
from tikernels.phase.smoothing import left_of_variance
from tikernels.raw.development import develop
from tikernels.raw.linearization import WHITE_LEVELS, linearize
from tikernels.raw.pixel_format import FLOAT_BITS, Siting
from tikernels.raw.repeated_chroma import RepeatedChroma, find_repeated_chroma, undo_repeated_chroma
from tikernels.transposing import transpose

# Share of full scale from which on a value counts as clipped: a codec leaves clipped ones a little below it.
_FULL = 0.995
#: Below this contrast, blur may have turned the fringe over.
MIN_CONTRAST = 0.12
# Lit is what is at least this part as bright as where the fringe is found: shadows are darker.
_LIT = 0.5
# Chroma samples of a window along a row in which an edge is sought.
_EDGE_SAMPLES = 8
# A window holds an edge where its chroma changes by this factor more than in most.
_EDGE_STRENGTH = 20.0
# Windows with an edge, at least, that show where chroma sits.
_MIN_EDGES = 100
# One siting fits better than another where it leaves less than this part of it; noise makes a difference of up to 3 %.
_CLEARLY = 0.95
# Rows and columns of the middle of a frame that are kept.
_KEPT_PX = (768, 1024)
# A place shows the colour of what is lit where the lit share around it is at least this.
_INSIDE = 0.95
# A drift of the camera is alike in most places: a quarter of them may change by less than this part of the median.
_EVEN = 0.5
# A surface whose phase changes by less, rad, keeps its brightness: by 0.3 rad, about 2 mm of 900, light that falls with
# the square of the distance changes by half a per cent. Noise makes less.
_STILL_RAD = 0.3
# Motion shows where a pixel's standard deviation is at most this many times what most have.
_AS_SURE = 2.0
# Places at least that show a drift.
_MIN_PLACES = 12
# Pairs of neighbours that are inspected, evenly spaced.
_PAIRS = 4
# Frames of the run in the middle: as many as a sequence needs to show a beat.
_RUN = MIN_FRAMES


@dataclass(frozen=True, eq=False)
class InspectedFrame:
    """One frame: light, and its decoded phase."""

    number: int
    encoded: npt.NDArray[np.float32]  # (H, W, 3) as stored, 0..1 of full scale
    light: npt.NDArray[np.float32]  # (H, W, 3) linear, 0..1
    frame: DecodedFrame | None  # None: no fringes
    settings: DecodeSettings
    repeated: RepeatedChroma | None = None  # how its colours were repeated, which is undone
    warnings: tuple[Cause, ...] = ()

    @property
    def period_px(self) -> float:
        """Camera px per cycle."""
        return (self.frame.period_px if self.frame is not None else None) or 1.0


def inspect_frame(stored: StoredFrame, decoder: Decoder, settings: DecodeSettings) -> InspectedFrame:
    """Decode a frame; `decoder` takes linear light, `settings` state how this frame's is encoded."""
    levels = runtime.to_host(develop(stored.planes, stored.format, stripes=settings.stripes))
    white = settings.white_level or WHITE_LEVELS[levels.dtype.name]
    repeated = find_repeated_chroma(levels, white)
    if repeated is not None:
        levels = undo_repeated_chroma(levels, white, repeated)
    encoded, light = as_light(levels, settings)
    frame = decoder.decode(light)
    shown = frame if frame.mask.any() else None
    return InspectedFrame(stored.number, encoded, light, shown, settings, repeated, frame.warnings)


def as_light(image: LevelsImage, settings: DecodeSettings) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Return a developed frame as it is encoded, and as linear light, (H, W, 3) in 0..1."""
    levels = np.array(runtime.to_host(image))
    white = settings.white_level or WHITE_LEVELS[levels.dtype.name]
    encoded = np.clip(levels.astype(np.float32) / np.float32(white), 0, 1)
    transfer = settings.transfer or "linear"
    light = encoded if transfer == "linear" else runtime.to_host(linearize(encoded, transfer))
    return encoded, light


@dataclass(frozen=True)
class FrameQuality:
    """Quality of one frame; the limits are for a pixel smoothed as decoded."""

    contrast: float  # amplitude over mean of the camera's channels
    limit_rad: float  # what contrast and noise allow
    level_limit_rad: float  # what rounding to whole levels allows
    sigma_rad: float  # what neighbouring pixels differ by
    clipped: float  # share of the lit pixels with a channel at full scale
    lost: float  # share of them with two, which have no phase
    faint: float  # share of the others whose contrast is below `MIN_CONTRAST`


def measure_quality(look: InspectedFrame, frame: DecodedFrame, bits: int) -> FrameQuality:
    """Measure a frame with fringes, whose levels have `bits` bits; medians over the fringes."""
    part = _middle(frame.mask.shape)  # shows enough of the fringes, at a quarter of the time for a large frame
    inside, light = frame.mask[part], look.light[part]
    along, across = 1.0, 0.75 * look.period_px
    if look.settings.stripes == "vertical":
        along, across = across, along
    mean = cv2.GaussianBlur(light, (0, 0), along, sigmaY=across)
    noise = frame.noise_levels
    variance = cv2.GaussianBlur(light**2, (0, 0), along, sigmaY=across) - mean**2 - noise**2
    variance = np.maximum(variance, 1e-9)
    contrast = (np.sqrt(2 * variance) / np.maximum(mean, 1e-6)).mean(axis=-1)
    # The information on the phase, sum_i (dI_i / dphi)^2 over noise^2, is half the sum of the squared amplitudes over
    # noise^2; and half a squared amplitude is its wave's variance.
    power = np.sqrt(np.median(variance.sum(axis=-1)[inside]) / left_of_variance(look.settings.smoothing_px // 2))
    at_full = np.count_nonzero(look.encoded >= _FULL, axis=-1)
    lit = at_full[frame.mask | (at_full > 1)]
    brightness = mean.mean(axis=-1)
    shown = (brightness > _LIT * np.median(brightness[inside])) & (at_full[part] < 2)
    return FrameQuality(
        contrast=float(np.median(contrast[inside])),
        limit_rad=float(noise / power),
        level_limit_rad=float(1 / (2**bits - 1) / np.sqrt(12) / power),
        sigma_rad=float(np.nanmedian(frame.row_sigma[frame.mask])),
        clipped=float(np.mean(lit > 0)),
        lost=float(np.mean(lit > 1)),
        faint=float(np.mean(contrast[shown] < MIN_CONTRAST)) if shown.any() else 0.0,
    )


def _middle(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return the part of a frame (H, W) that is kept."""
    top, left = (max(0, (there - kept) // 2) for there, kept in zip(shape, _KEPT_PX, strict=True))
    return np.s_[top : top + _KEPT_PX[0], left : left + _KEPT_PX[1]]


@dataclass(frozen=True, eq=False)
class KeptFrame:
    """The part of a frame with fringes that is kept for comparison: of a large one, the middle."""

    encoded: npt.NDArray[np.float32]  # (H, W, 3) as stored, 0..1 of full scale
    light: npt.NDArray[np.float32]  # (H, W, 3) linear, 0..1
    unwrapped_phase: npt.NDArray[np.float32]  # (H, W) rad
    mask: npt.NDArray[np.bool_]  # (H, W)
    period_px: float

    @classmethod
    def of(cls, look: InspectedFrame, frame: DecodedFrame) -> "KeptFrame":
        """Keep a frame."""
        part = _middle(frame.mask.shape)
        encoded, light = look.encoded[part].copy(), look.light[part].copy()
        return cls(encoded, light, frame.unwrapped_phase[part].copy(), frame.mask[part].copy(), look.period_px)


def measure_gains(first: KeptFrame, later: KeptFrame) -> npt.NDArray[np.float64] | None:
    """Return by how much R, G and B have become brighter, (3,), where the same factor holds for most of the image.

    1 where it does not: then an object that moves has changed it here and there. None: too little is lit in both.
    """
    both = (first.mask & later.mask).astype(np.float32)
    # A Gaussian of a whole cycle hides where the fringe is.
    sigma = first.period_px
    step = max(1, round(2 * sigma))
    weight = cv2.GaussianBlur(both, (0, 0), sigma)[::step, ::step]
    inside = weight > _INSIDE
    if np.count_nonzero(inside) < _MIN_PLACES:
        return None
    before, after = (
        cv2.GaussianBlur(look.light * both[..., None], (0, 0), sigma)[::step, ::step][inside] for look in (first, later)
    )
    ratios = np.log(np.maximum(after, 1e-6) / np.maximum(before, 1e-6)).astype(np.float64)
    low, middle, high = np.percentile(ratios, (25, 50, 75), axis=0)
    uneven = np.abs(np.where(middle > 0, low, high)) < _EVEN * np.abs(middle)
    uneven |= np.sign(np.where(middle > 0, low, high)) != np.sign(middle)
    return np.exp(np.where(uneven, 0.0, middle))


def stands_still(first: KeptFrame, later: KeptFrame) -> bool:
    """Return whether most of what both frames show is where it was: its brightness then shows the camera's exposure."""
    both = first.mask & later.mask
    change = later.unwrapped_phase[both] - first.unwrapped_phase[both]
    return bool(np.mean(np.cos(change) > np.cos(_STILL_RAD)) > 0.5) if both.any() else False


def measure_motion(first: InspectedFrame, second: InspectedFrame) -> npt.NDArray[np.float32]:
    """Return by how much the phase differs, rad, where both are sure of it; half a cycle is the most that shows."""
    if first.frame is None or second.frame is None:
        return np.zeros(0, np.float32)
    both = _sure_pixels(first.frame) & _sure_pixels(second.frame)
    change = second.frame.wrapped_phase[both] - first.frame.wrapped_phase[both]
    return np.asarray(np.abs(change - np.float32(2 * np.pi) * np.rint(change / np.float32(2 * np.pi))))


def _sure_pixels(frame: DecodedFrame) -> npt.NDArray[np.bool_]:
    """Return the pixels that are about as sure as most: dim ones differ by their noise from frame to frame."""
    sigma = frame.phase_sigma
    usual = float(np.median(sigma[frame.mask])) if frame.mask.any() else 0.0
    return np.asarray(frame.mask & (sigma <= _AS_SURE * usual))


@dataclass(frozen=True)
class SitingFit:
    """Siting of the chroma samples that fits a frame."""

    better: Siting | None  # None: the frame does not show it
    differ_rad: float  # by how much their phases differ, RMS


#: What is compared: chroma of files as they are stored sits so, unless its rows are those of the picture's columns.
SITINGS: tuple[Siting, Siting] = ("left", "centre")


class Scale(NamedTuple):
    """The size of things in a frame, by a calibrated rig; medians."""

    mm_per_px: float  # of the camera
    mm_per_rad: float  # of depth, along the pixels' rays


def measure_scale(source: Footage, settings: DecodeSettings, calibration: Calibration, arch: str) -> Scale | None:
    """Return the scale in the middle frame; None if it shows nothing.

    Raises
    ------
    CalibrationError
        The calibration is for another frame size.
    """
    for stored in source.frames(len(source) // 2, len(source) // 2 + 1):
        if isinstance(stored, BadFrame):
            break
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DecodeWarning)  # reported of the same frame without a calibration
            look = inspect_frame(stored, Decoder(decoder_settings(settings), calibration, arch=arch), settings)
        frame = look.frame
        if frame is None or frame.points is None or frame.point_sigma is None:
            break
        depth_mm = float(np.nanmedian(frame.points[..., 2]))
        per_rad = float(np.nanmedian(frame.point_sigma / frame.phase_sigma))
        return Scale(depth_mm / float(calibration.geometry().camera.matrix[0, 0]), per_rad)
    return None


def fit_siting(stored: StoredFrame, settings: DecodeSettings, arch: str) -> SitingFit:
    """Compare "left" and "centre" for a frame whose chroma is halved along its rows."""
    frames = []
    for siting in SITINGS:
        image = develop(stored.planes, replace(stored.format, siting=siting), stripes=settings.stripes)
        # Each learns the light by itself: what is learnt of one makes up for some of its fault.
        decoder = Decoder(decoder_settings(settings), arch=arch)
        frames.append(decoder.decode(as_light(image, settings)[1]))
    both = frames[0].mask & frames[1].mask
    if not both.any():
        return SitingFit(None, 0.0)
    change = np.exp(1j * (frames[1].wrapped_phase[both] - frames[0].wrapped_phase[both]))
    apart = np.angle(change * np.conj(change.mean()))
    # Where the fringe runs across the samples, a wrong siting is lateral colour: the channels' waves lag against each
    # other as no crosstalk makes them, which leaves the constant unsure. Where it runs along them, only edges show it.
    if settings.stripes == "vertical":
        left, centre = (float(frame.constant_sigma) for frame in frames)
    else:
        left, centre = _left_of_edges(stored)
    better = next((name for name, a, b in (("left", left, centre), ("centre", centre, left)) if a < _CLEARLY * b), None)
    return SitingFit(next((s for s in SITINGS if s == better), None), float(np.sqrt(np.mean(apart**2))))


def _left_of_edges(stored: StoredFrame) -> tuple[float, float]:
    """Return what share of the chroma's change at edges luma does not explain, its samples sited left and centre.

    Along a stripe little changes but at edges, and there chroma changes where luma does.
    """
    luma = np.asarray(stored.planes[0], np.float32)
    chroma = [np.asarray(plane, np.float32) for plane in stored.planes[1:]]
    rows, columns = luma.shape[0] // stored.format.subsampling[1], luma.shape[1] // 2
    if stored.format.subsampling[1] == 2:
        luma = np.asarray((luma[: 2 * rows : 2] + luma[1 : 2 * rows : 2]) / 2, np.float32)
    padded = np.pad(luma, ((0, 0), (1, 1)), "edge")
    lefts = ((padded[:, :-2] + 6 * luma + padded[:, 2:]) / np.float32(8))[:, : 2 * columns : 2]
    centres = (luma[:, : 2 * columns : 2] + luma[:, 1 : 2 * columns : 2]) / np.float32(2)

    def windows(values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        change = np.diff(values[:rows, :columns], axis=1)
        whole = change.shape[1] // _EDGE_SAMPLES * _EDGE_SAMPLES
        return np.asarray(change[:, :whole].reshape(-1, _EDGE_SAMPLES))

    both = [windows(plane) for plane in chroma]
    energy = sum((plane**2).sum(axis=1) for plane in both)
    edges = energy > _EDGE_STRENGTH * np.median(energy)
    if np.count_nonzero(edges) < _MIN_EDGES:
        return 1.0, 1.0
    unexplained = []
    for guess in (windows(lefts)[edges], windows(centres)[edges]):
        explained = sum(
            (guess * plane[edges]).sum(axis=1) ** 2 / np.maximum((guess**2).sum(axis=1), 1e-6) for plane in both
        )
        unexplained.append(1 - float(np.sum(explained) / energy[edges].sum()))
    return unexplained[0], unexplained[1]


def decoder_settings(settings: DecodeSettings) -> DecodeSettings:
    """Return the settings of a decoder that is given linear light in 0..1."""
    return settings.replace(transfer="linear", white_level=None, min_intensity=None, min_modulation=None, noise=None)


@dataclass
class FootageEvidence:
    """Evidence of the frames that were inspected."""

    settings: DecodeSettings  # as given, with the container's transfer, and the stripes' true direction
    n_frames: int = 0
    bad: list[BadFrame] = field(default_factory=list)
    no_fringes: dict[int, str] = field(default_factory=dict)  # frames without fringes, and the reasons
    kept: list[KeptFrame] = field(default_factory=list)  # the first with fringes of every run
    qualities: list[FrameQuality] = field(default_factory=list)
    motion_rad: list[float] = field(default_factory=list)  # of pairs of neighbours, 95th percentile
    repeats: list[int] = field(default_factory=list)  # frames that are as the one before, value by value
    n_pairs: int = 0
    brightest: float = 0.0  # value, of full scale
    diagnosis: Diagnosis | None = None
    siting: SitingFit | None = None
    repeated: RepeatedChroma | None = None  # of the first frame whose colours were repeated
    sequence: SequenceDiagnosis | None = None


def gather_evidence(
    source: Footage, says: StoredAs, settings: DecodeSettings, arch: str, notify: Callable[[str], None]
) -> FootageEvidence:
    """Look at frames all over some footage: pairs of neighbours, and a longer run in its middle.

    Parameters
    ----------
    source : Footage
        The footage.
    says : StoredAs
        The user's statement of how pixels are stored.
    settings : DecodeSettings
        Settings intended for decoding.
    arch : str
        Device to compute on.
    notify : callable
        Called with what is being done.
    """
    if settings.transfer is None:
        settings = settings.replace(transfer=source.transfer or "linear")
    gatherer = _Gatherer(source, says, settings, arch, notify)
    runs = _runs(len(source))
    middle, total = max(runs, key=len), sum(map(len, runs))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)
        for run in runs:
            gatherer.look_at_run(run, total, ask=run.start >= middle.start, follow=run == middle and len(run) == _RUN)
        gatherer.finish()
    return gatherer.seen


class _Gatherer:
    """Looks at one frame after another, and keeps what they show."""

    def __init__(
        self, source: Footage, says: StoredAs, settings: DecodeSettings, arch: str, notify: Callable[[str], None]
    ) -> None:
        self.seen = FootageEvidence(settings)
        self._source, self._says, self._arch, self._notify = source, says, arch, notify
        self._decoder: Decoder | None = None
        self._sequence: list[KeptFrame] = []  # the frames of the run in the middle

    def look_at_run(self, run: range, total: int, *, ask: bool, follow: bool) -> None:
        """Look at neighbouring frames.

        Parameters
        ----------
        run : range
            Their numbers.
        total : int
            Number of frames that are inspected in all.
        ask : bool
            True to diagnose the first one with fringes, if none has been.
        follow : bool
            True to keep them all as a sequence.
        """
        before: tuple[StoredFrame, InspectedFrame] | None = None
        first = True
        for stored in self._source.frames(run.start, run.stop):
            self.seen.n_frames += 1
            self._notify(f"frame {stored.number} ({self.seen.n_frames} of {total})")
            inspected = self._inspect(stored)
            if isinstance(stored, BadFrame) or inspected is None:
                before = None
                continue
            if before is not None:
                self._compare(before, (stored, inspected))
            before = (stored, inspected)
            if inspected.frame is None:
                self.seen.no_fringes[stored.number] = next(iter(inspected.warnings), "")
                continue
            self.seen.qualities.append(measure_quality(inspected, inspected.frame, bits_of(self._source)))
            if first or follow:
                kept = KeptFrame.of(inspected, inspected.frame)
                if first:
                    self.seen.kept.append(kept)
                    if ask and self.seen.diagnosis is None:
                        self._diagnose(stored, kept)
                if follow:
                    self._sequence.append(kept)
            first = False

    def finish(self) -> None:
        """Diagnose the sequence, if every frame of it shows fringes."""
        if len(self._sequence) < _RUN:
            return
        self._notify("motion and beat")
        self.seen.sequence = diagnose_sequence(
            [kept.light for kept in self._sequence],
            1.0,
            [kept.unwrapped_phase for kept in self._sequence],
            [kept.mask for kept in self._sequence],
            crosstalk_matrix=_known_crosstalk(self._decoder),
        )

    def _inspect(self, stored: StoredFrame | BadFrame) -> InspectedFrame | None:
        """Decode a frame; None if it is bad."""
        if isinstance(stored, BadFrame):
            self.seen.bad.append(stored)
            return None
        try:
            if self._decoder is None:
                self.seen.settings = _turned(stored, self.seen.settings)
                self._decoder = Decoder(decoder_settings(self.seen.settings), arch=self._arch)
            inspected = inspect_frame(stored, self._decoder, self.seen.settings)
        except FootageError as error:
            self.seen.bad.append(BadFrame(stored.number, str(error)))
            return None
        self.seen.repeated = self.seen.repeated or inspected.repeated
        self.seen.brightest = max(self.seen.brightest, float(inspected.encoded.max()))
        return inspected

    def _compare(self, before: tuple[StoredFrame, InspectedFrame], now: tuple[StoredFrame, InspectedFrame]) -> None:
        """Note whether a frame repeats the one before, or else how its phase has changed."""
        self.seen.n_pairs += 1
        if all(np.array_equal(a, b) for a, b in zip(before[0].planes, now[0].planes, strict=True)):
            self.seen.repeats.append(now[0].number)
        elif (change := measure_motion(before[1], now[1])).size:
            self.seen.motion_rad.append(float(np.quantile(change, 0.95)))

    def _diagnose(self, stored: StoredFrame, kept: KeptFrame) -> None:
        """Diagnose one frame's ripple, and where its colours sit."""
        known, transfer = KnownLight(_known_crosstalk(self._decoder)), self.seen.settings.transfer or "linear"
        self.seen.diagnosis = diagnose(kept.encoded, 1.0, kept.unwrapped_phase, kept.mask, known, transfer)
        format = self._source.format
        as_stored = format.siting in SITINGS and format.origin == (0, 0)  # not turned
        if format.subsampling[0] == 2 and as_stored and self._says.siting is None:
            self._notify("where the colours sit")
            self.seen.siting = fit_siting(stored, self.seen.settings, self._arch)


def _runs(n_frames: int) -> list[range]:
    """Return which frames to look at: a run in the middle, and pairs before and after it."""
    starts = np.linspace(0, max(n_frames - 2, 0), _PAIRS + 1).round().astype(int).tolist()
    runs = [range(start, min(start + 2, n_frames)) for start in starts]
    begin = max(0, starts[len(starts) // 2] - _RUN // 2)
    middle = range(begin, min(begin + _RUN, n_frames))
    clear = [run for run in runs if run.stop <= middle.start or run.start >= middle.stop]
    return sorted({*clear, middle}, key=lambda run: run.start)


def bits_of(source: Footage) -> int:
    """Return how many bits distinguish levels; floats are as fine as their mantissa."""
    return 24 if source.format.bits == FLOAT_BITS else source.format.bits


def _turned(stored: StoredFrame, settings: DecodeSettings) -> DecodeSettings:
    """Return the settings turned to this frame's stripes, if only the other direction shows a fringe."""
    light = as_light(develop(stored.planes, stored.format, stripes=settings.stripes), settings)[1]
    other = "vertical" if settings.stripes == "horizontal" else "horizontal"
    across = {"horizontal": light, "vertical": transpose(light)}
    # What is too fine to be seen beats with the pixels, and may pass for stripes the other way.
    if finest_fringe(across[settings.stripes]) is not None:
        return settings
    if measure_frame(across[settings.stripes]).period_px is not None or measure_frame(across[other]).period_px is None:
        return settings
    return settings.replace(stripes=other)


def _known_crosstalk(decoder: Decoder | None) -> FloatArray | None:
    """Return the crosstalk that is given, or that a frame showed; None: none that explains how its channels differ."""
    if decoder is None:
        return None
    known, light = decoder.settings.crosstalk_matrix, decoder.state.light
    if known is None and light is not None and light.reliable and light.misfit < MAX_CONSTANT:
        return light.crosstalk_matrix
    return known
