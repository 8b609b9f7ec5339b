"""Faults that the pictures of a rig show: the projector's delay, light, flicker, colours and pixels.

A picture is shown, photographed when it is on the screen for certain, and compared with another one. A channel that is
off by the part e of its range leaves the phase off by sqrt(8 / 3) e rad RMS (`pipeline.calibration.verdict`), which is
the cost of most faults.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import inf, sqrt

import numpy as np
import numpy.typing as npt

from pipeline.acquisition.studio import Studio
from pipeline.models import FloatArray, ImageArray
from tikernels.raw.linearization import WHITE_LEVELS

#: rad RMS per part of the channels' range.
RAD_PER_PART = sqrt(8 / 3)
#: Time in which every projector and camera shows and sees a picture, s.
SURE_S = 1.0
# Flashes by which the true time is measured.
_FLASHES = 4
# A flash is on the screen when a frame has this part of its light.
_ON = 0.98
# White must be brighter than black by this part of full scale.
_MIN_LIGHT = 0.06
#: Levels from here on, of full scale, are saturated; and the part of the lit pixels that may be.
SATURATED, MAX_SATURATED = 0.99, 0.02
#: Pixels count that are this part as bright as the brightest: the projector lights them fully.
LIT = 0.3
# Frames of white by which flicker is seen, in bands of so many rows.
_FLICKER_TAKES, _BAND_PX = 12, 32
# Codes whose noise is measured, too, and in how many pairs of frames: a tone curve makes more of it in the dark.
_DARK_CODES, _DARK_TAKES = (0.0, 0.25), 3
#: Flicker that a phase bears: a channel off by a hundredth makes .013 rad (verdict.py), as much as a frame's noise.
MAX_FLICKER = 0.01
# Stripes of one px are this part darker than those of two where a picture is resampled: interpolation mixes codes, and
# light is a power of them.
_MAX_RESAMPLED = 0.04


@dataclass(frozen=True)
class RigFault:
    """A fault of a rig."""

    key: str
    words: str  # what is wrong, and what to change
    cost_rad: float  # RMS error of phase; infinite: nothing can be measured


class RigProbe:
    """Shows pictures and measures what the camera sees of them.

    Parameters
    ----------
    studio : Studio
        Projector and camera.

    Attributes
    ----------
    black, white : (H, W, 3)
        Frames of plain pictures, of full scale, once `look` was called.
    lit : (H, W) bool
        Pixels that the projector lights.
    delay_s : float
        Delay from a picture to the screen, once `measure_delay` was called.
    noise : float
        Largest RMS difference of two frames of a plain picture, of full scale, once `flicker` was called.
    variation : float
        Of white from frame to frame, as a part of it, once `flicker` was called.
    px_per_px : float
        Projector px per camera px, once `mirrored` was called.
    takes : int
        Number of frames whose mean is compared: more where the room's light flickers.
    """

    def __init__(self, studio: Studio) -> None:
        self.studio = studio
        self.black: FloatArray = np.zeros((1, 1, 3))
        self.white: FloatArray = np.ones((1, 1, 3))
        self.lit: npt.NDArray[np.bool_] = np.ones((1, 1), bool)
        self.delay_s, self.noise, self.variation, self.px_per_px = SURE_S, 0.0, 0.0, 1.0
        self.takes = 1
        self._shown_codes: npt.NDArray[np.floating] | None = None

    def faults(self) -> Iterator[RigFault]:
        """Look for every fault in this file, and yield each that is found; without light it ends.

        Raises
        ------
        CalibrationError
            White is never seen.
        """
        fault = self.look()
        if fault is not None:
            yield fault
            return
        for check in (
            self.measure_delay,
            self.flicker,
            self.saturated,
            self.swapped_colors,
            self.resampled,
            self.mirrored,
        ):
            fault = check()
            if fault is not None:
                yield fault

    def field(self, code: float | FloatArray) -> npt.NDArray[np.floating]:
        """Return the codes, (height, width, 3), of a plain picture."""
        width, height = self.studio.projector_px
        return np.broadcast_to(np.asarray(code, np.float64) * np.ones(3), (height, width, 3))

    def show(self, codes: npt.NDArray[np.floating]) -> None:
        """Send codes, 0..1, to the projector, where it does not show them already."""
        if codes is not self._shown_codes:
            self.studio.show(np.rint(255 * codes).astype(np.uint8))
        self._shown_codes = codes

    def frames(self, codes: npt.NDArray[np.floating], takes: int) -> list[FloatArray]:
        """Return frames of a picture, of full scale, when it and all automatics of the camera have settled."""
        self.show(codes)
        self.studio.sleep(SURE_S)
        return [shares(frame) for _ in range(takes) for frame in self.studio.take()]

    def settled(self, code: float | FloatArray) -> FloatArray:
        """Return the frame of a plain picture, 0..1, when it is on the screen for certain."""
        return self._last_or_mean(self.frames(self.field(code), self.takes))

    def look(self) -> RigFault | None:
        """Photograph black and white; return the fault that hardly any light is seen."""
        self.black, self.white = self.settled(0.0), self.settled(1.0)
        gain = self.white.mean(axis=-1) - self.black.mean(axis=-1)
        brightest = float(np.percentile(gain, 99))
        self.lit = gain > LIT * brightest
        if brightest >= _MIN_LIGHT:
            return None
        return RigFault(
            "no light",
            f"the camera sees hardly any light of the projector: white is {brightest:.1%} of full scale brighter than "
            "black. Look whether the projector shows it, and expose longer",
            inf,
        )

    def measure_delay(self) -> RigFault | None:
        """Find by flashes how long a picture takes to the screen: the longest of some, and one frame more."""
        dark = float(self.black.mean(axis=-1)[self.lit].mean())
        gain = float(self.white.mean(axis=-1)[self.lit].mean()) - dark
        longest = 0.0
        for _ in range(_FLASHES):
            self.settled(0.0)
            start_s = self.studio.now_s()
            self.show(self.field(1.0))
            while True:
                began_s = self.studio.now_s()
                frames = self.studio.take()
                if shares(frames[0]).mean(axis=-1)[self.lit].mean() > dark + _ON * gain:
                    break
                if began_s - start_s > 3 * SURE_S:
                    return RigFault(
                        "unsteady picture",
                        "white took longer than 3 s to the screen, or shows for a moment only: switch off what the "
                        "projector does to its picture (dynamic iris, eco blanking, signal search)",
                        inf,
                    )
            longest = max(longest, began_s - start_s)
            frame_s = (self.studio.now_s() - began_s) / len(frames)
        self.delay_s = longest + frame_s
        return None

    def saturated(self) -> RigFault | None:
        """Return the fault that too many pixels are saturated by white."""
        part = saturated_part(self.white, self.lit)
        if part <= MAX_SATURATED:
            return None
        # Levels that are cut off above full scale are off by at least the part of the range that is cut off.
        return RigFault("too bright", f"{part:.0%} of the lit pixels are saturated by white: expose shorter", 1.0)

    def flicker(self) -> RigFault | None:
        """Return the fault that white varies from frame to frame; measure the noise."""
        means, noise = [], []
        self._shown(self.field(1.0))
        for _ in range(_FLICKER_TAKES):
            frames = [shares(frame) for frame in self.studio.take()]
            means += [_band_means(frame, self.lit) for frame in frames]
            noise.append(rms(frames[0] - frames[-1]))
        self.noise = max(float(np.median(noise)), *(self._noise(code) for code in _DARK_CODES))
        series = np.array(means)
        self.variation = float(np.nanmax(series.std(axis=0) / series.mean(axis=0)))
        if self.variation <= MAX_FLICKER:
            return None
        return RigFault(
            "flicker",
            f"white flickers by {self.variation:.1%} from frame to frame: colorphase expose finds whether the "
            "exposure, light of the room or an automatic of the camera does it",
            RAD_PER_PART * self.variation,
        )

    def _noise(self, code: float) -> float:
        """Return the RMS difference of two frames of a plain picture."""
        frames = self.frames(self.field(code), _DARK_TAKES)
        return float(np.median([rms(one - other) for one, other in pairwise(frames)]))

    def swapped_colors(self) -> RigFault | None:
        """Return the fault that the camera's channels see other colours than their own."""
        seen = np.array([(self.settled(color) - self.black)[self.lit].mean(axis=0) for color in np.eye(3)])
        parts = seen / np.maximum(seen.sum(axis=0), 1e-9)  # [primary, channel]
        most = tuple(parts.argmax(axis=0))
        if most == (0, 1, 2):
            return None
        if most == (2, 1, 0):
            words = "the camera's frames are B, G, R instead of R, G, B: set its pixel format"
        else:
            words = (
                "the camera's channels see other colours of the projector more than their own: switch off the "
                "projector's colour modes and the camera's colour effects, and correct its white balance"
            )
        return RigFault("swapped colours", words, inf)

    def resampled(self) -> RigFault | None:
        """Return the fault that the projector does not show the picture pixel for pixel."""
        width, height = self.studio.projector_px
        for axis, positions in (("columns", np.arange(width)[None]), ("rows", np.arange(height)[:, None])):
            light = []
            for wide in (1, 2):
                stripes = np.broadcast_to((positions // wide % 2)[..., None], (height, width, 3))
                light.append(float((self._shown(stripes.astype(np.float64)) - self.black)[self.lit].mean()))
            darker = 1 - light[0] / light[1]
            if darker > _MAX_RESAMPLED:
                return RigFault(
                    "resampled picture",
                    f"the projector does not show the picture pixel for pixel: {axis} of one px are {darker:.0%} "
                    "darker than those of two. Switch off keystone, zoom, overscan and sharpness, set its own "
                    "resolution, and do not mirror it to a display of another size",
                    inf,
                )
        return None

    def mirrored(self) -> RigFault | None:
        """Return the fault that the picture is mirrored; measure the projector's px per camera px."""
        width, height = self.studio.projector_px
        y, x = np.nonzero(self.lit)
        places = np.column_stack([np.ones(len(x)), x, y])
        slopes = []
        for ramp in (np.linspace(0, 1, width)[None], np.linspace(0, 1, height)[:, None]):
            shown = self._shown(np.broadcast_to(ramp[..., None], (height, width, 3)))
            share = (shown - self.black)[self.lit].mean(axis=-1) / (self.white - self.black)[self.lit].mean(axis=-1)
            slopes.append(np.linalg.lstsq(places, share, rcond=None)[0][1:])
        area = float(np.linalg.det(np.array(slopes)))
        self.px_per_px = sqrt(abs(area) * width * height)
        if area >= 0:
            return None
        return RigFault(
            "mirrored picture",
            "the picture is mirrored: switch off the projector's rear projection or ceiling mode, or the camera's "
            "mirroring, whichever is on",
            inf,
        )

    def _shown(self, codes: npt.NDArray[np.floating]) -> FloatArray:
        """Return a frame of a picture as soon as it is on the screen."""
        self.show(codes)
        self.studio.sleep(self.delay_s)
        frames = [shares(frame) for _ in range(self.takes) for frame in self.studio.take()]
        return self._last_or_mean(frames)

    def _last_or_mean(self, frames: list[FloatArray]) -> FloatArray:
        return frames[-1] if self.takes == 1 else np.asarray(np.mean(frames, axis=0))


def shares(frame: ImageArray) -> FloatArray:
    """Return a frame as shares of full scale."""
    return np.asarray(frame / np.float32(WHITE_LEVELS[frame.dtype.name]), np.float64)


def saturated_part(frame: FloatArray, lit: npt.NDArray[np.bool_]) -> float:
    """Return which part of the lit pixels is saturated in a channel."""
    return float((frame[lit] >= SATURATED).any(axis=-1).mean())


def rms(values: FloatArray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt((values**2).mean()))


def _band_means(frame: FloatArray, lit: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the mean of the lit pixels of bands of rows, (bands, 3); NaN where a band has few."""
    starts = np.arange(0, len(frame), _BAND_PX)
    counts = np.add.reduceat(lit.sum(axis=1), starts)
    sums = np.add.reduceat((frame * lit[..., None]).sum(axis=1), starts)
    return np.where(counts[:, None] < _BAND_PX**2, np.nan, sums / np.maximum(counts, 1)[:, None])
