"""The codes that show which cycle a place of the pattern is in, by the contrast that it has there.

"contrast" has one symbol per cycle, of a sequence that never repeats: absolute orders without a calibration.
"contrast2" has one for every cell of a cycle, a few pixels along the stripe, and needs a geometry: a place's column is
known at every order that it may have, so only windows at the same columns have to differ, and a small one determines
its order. `docs/coded_pattern.md` derives both.
"""

from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Pattern
from pipeline.models import CodeName, FloatArray

#: Cycles that either code has.
CYCLES = 136
# Contrast of the symbols, modulation over background; a plain pattern's is 1.
_CONTRASTS, _CONTRASTS_2 = (0.72, 0.86, 1.0), (0.8, 1.0)
# One digit per cycle, from the projector's first row (or column) on. No two stretches of five cycles change alike.
_SYMBOLS = (
    "02110212222212202220002020101200122102022110011202100200012120200212102101210002202120122012011220022120"
    "00021022001002222020211201022210"
)
# One word of fifteen cells per cycle, repeated along the stripe: each differs from every other one in five cells or
# more.
_WORDS = (
    "31eb5b8e1c11708a063202e46fd1544266e32ef6213a36bb01176a651d4f262c64be606807af5a9949442bc70edb2f6b587d78e62c98102e"
    "7587218c422b53673af13f3041d87e9274d934a061f56d7c23211669191c1b3b32187c0c4d9d7cb513a82566450e3a846c57390220a72aaa"
    "73c0692f04ea4fba36ce159a33b657b108d5746f673729596dca2a134b5f6510438511c6227f1ebc524c37e55f5879b85109457b0c3f4ac2"
    "7b15034a30457379389f0ea151bf715e779c4cf00d5230fc3cc365a91a565a200863596a177e3dd400b90f752e402bbd1e0a4931468872d7"
    "79cd68fb03f327825e73665a13dd4be9407669967d1b5ec52834620655ec4c49148d1523449329e052fa2ced4e1447d6"
)
WORD_CELLS = 15
#: Responses of the projector, as gammas of its codes, under which the codes' levels are known.
GAMMAS = (0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.3, 2.6, 3.0)
# Places a cell at which levels are tabled.
_PLACES = 16
# Within a cell the contrast is its own over this share; from there it goes to the next one's in a smooth step.
_FLAT = 0.5


@dataclass(frozen=True, eq=False)
class ContrastCode:
    """The contrast of every place of the pattern.

    Attributes
    ----------
    name : {"contrast", "contrast2"}
        The pattern's.
    contrasts : (CYCLES, columns) float64
        In the middle of every cycle and cell; the columns repeat along the stripe.
    cell_px : float or None
        Width of a cell along the stripe, projector px; None: a cycle has the same contrast all along.
    """

    name: CodeName
    contrasts: FloatArray
    cell_px: float | None = None

    @staticmethod
    @cache
    def named(name: CodeName, cell_px: float | None = None) -> "ContrastCode":
        """Return the code of this name, its cells as wide as that."""
        if name == "contrast":
            return ContrastCode(name, np.array(_CONTRASTS)[[[int(symbol)] for symbol in _SYMBOLS]])
        words = np.array([int(_WORDS[4 * k : 4 * k + 4], 16) for k in range(CYCLES)])
        return ContrastCode(name, np.array(_CONTRASTS_2)[words[:, None] >> np.arange(WORD_CELLS) & 1], cell_px)

    @classmethod
    def of(cls, pattern: Pattern) -> "ContrastCode | None":
        """Return the code of a pattern; None: it has none."""
        return None if pattern.code is None else cls.named(pattern.code, pattern.cell_px)

    @property
    def usual(self) -> float:
        """The mean contrast."""
        return float(self.contrasts.mean())

    @property
    def least_change(self) -> float:
        """The median change of the contrast's logarithm from a cycle to the next one, under the flattest response."""
        return float(np.median(np.abs(np.diff(self.levels(), axis=1)), axis=(1, 2)).min())

    @property
    def repeats_px(self) -> float:
        """After how many projector px along the stripe the code is the same again; 1 where it does not change."""
        return 1.0 if self.cell_px is None else self.cell_px * self.contrasts.shape[1]

    @property
    def places_px(self) -> FloatArray:
        """(places,) px along the stripe of the places at which the code is tabled, evenly over `repeats_px`."""
        places = 1 if self.cell_px is None else _PLACES * self.contrasts.shape[1]
        return np.asarray((np.arange(places) + 0.5) / places * self.repeats_px)

    def place_at(self, along_px: npt.NDArray[np.floating]) -> npt.NDArray[np.int64]:
        """Return the numbers of the places at which the code is tabled that these px along the stripe lie in."""
        count = len(self.places_px)
        return np.asarray(np.floor(np.remainder(along_px / self.repeats_px, 1) * count).astype(np.int64) % count)

    def modulation(self, cycles: npt.ArrayLike, along_px: npt.ArrayLike = 0.0) -> FloatArray:
        """Return the pattern's modulation as a fraction of full scale.

        Parameters
        ----------
        cycles : array
            Phase in cycles; before the first one's middle and after the last one's the modulation stays.
        along_px : array
            Projector px along the stripe, where the other array broadcasts against it.
        """
        modulation = self.contrasts / (1 + self.contrasts)
        across = np.clip(np.asarray(cycles, np.float64), 0, CYCLES - 1)
        cycle = np.minimum(across.astype(int), CYCLES - 2)
        column, on = np.zeros(np.shape(along_px), int), np.zeros(np.shape(along_px))
        if self.cell_px is not None:
            cells = np.asarray(along_px, np.float64) / self.cell_px - 0.5
            column = np.floor(cells).astype(int)
            step = np.clip((cells - column - _FLAT / 2) / (1 - _FLAT), 0, 1)
            on = step**2 * (3 - 2 * step)
        count = modulation.shape[1]
        first, then = (
            modulation[row, column % count] * (1 - on) + modulation[row, (column + 1) % count] * on
            for row in (cycle, cycle + 1)
        )
        return np.asarray(first + (across - cycle) * (then - first))

    @cached_property
    def _levels(self) -> npt.NDArray[np.float64]:
        """(gammas, 2, CYCLES, places): what of a cycle is modulation and background, as it is read, place by place."""
        within = np.linspace(-0.5, 0.5, 33)  # cycles
        weight = (1 - (2 * within) ** 2) ** 2
        projected = self.modulation(np.arange(CYCLES)[:, None, None] + within, self.places_px[:, None])
        # What of the light's own cycle is background and modulation, for every modulation of the codes.
        modulations = np.linspace(projected.min(), projected.max(), 65)
        wave = np.cos(2 * np.pi * np.arange(64) / 64)
        codes = np.maximum(1 - modulations[:, None] * (1 - wave), 0)
        seen = []
        for gamma in GAMMAS:
            shares = 2 * (codes**gamma * wave).mean(axis=1), (codes**gamma).mean(axis=1)
            seen.append([np.interp(projected, modulations, share) @ (weight / weight.sum()) for share in shares])
        return np.array(seen)

    def levels(self, width_px: float = 0.0, cycles: int = CYCLES) -> npt.NDArray[np.float32]:
        """Return the logarithm of each cycle's contrast, as `measure_contrast` reads it, under each of GAMMAS.

        A cycle's neighbours contribute 8 % each.

        Parameters
        ----------
        width_px : float
            Projector px along the stripe over which it is averaged.
        cycles : int
            Number of the pattern's cycles.

        Returns
        -------
        (gammas, cycles, places) float32
            Natural logarithm, at places evenly over `repeats_px`, half a place from its start on.
        """
        return _averaged(self, max(1, round(width_px / self.repeats_px * self._levels.shape[-1])), cycles)


@lru_cache(maxsize=4)
def _averaged(code: ContrastCode, width: int, cycles: int) -> npt.NDArray[np.float32]:
    """Return the levels of a code's first cycles, averaged over so many places."""
    levels = code._levels[:, :, :cycles]
    if width > 1:
        away = np.abs(np.fft.fftfreq(levels.shape[-1], 1 / levels.shape[-1]))
        kernel = np.clip((width + 1) / 2 - away, 0, 1) / width  # as far to either side: half a place for an even one
        levels = np.fft.irfft(np.fft.rfft(levels) * np.fft.rfft(kernel), levels.shape[-1])
    return np.log(levels[:, 0] / levels[:, 1]).astype(np.float32)
