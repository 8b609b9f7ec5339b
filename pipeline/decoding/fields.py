"""The table of what a decoded frame holds, pixel by pixel: `@field` turns a method of `DecodedFrame` into an entry.

Frame, store, reader, meshes and the README's table all come from these entries: a new field is one method.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

T = TypeVar("T")
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Rounding:
    """Rounding of a stored field to its significant digits, because noise does not compress."""

    how: str
    apply: Callable[[Floats, float, bool], Floats]  # values, the frame's noise in grey levels, whether ranges are in mm


# A power of two, so that every rounded phase is a float32 with many zeros at its end, which compress away. Photon noise
# alone leaves more than 6e-4 rad to a pixel with 100,000 electrons and five rows' smoothing: ten steps.
_PHASE_STEP_RAD = 2.0**-14
# A modulation is known no better than half the noise of a channel; a tenth of the noise is below a fifth of that, and
# what rounding adds to it in quadrature is 0.2 %.
_NOISE_STEP = 0.1
# A standard deviation is never known to 0.4 %: seven bits of its mantissa.
_SIGMA_BITS = 7


class Field(cached_property[T]):
    """A field of a frame: a property that is computed when it is first read, and its description.

    Two threads that read it at once may both compute it, with the same result.

    Attributes
    ----------
    dtype : str
        NumPy's name of the element type.
    unit : str or None
        Of its values; "range": mm with a calibration, rad without; None for labels, flags and counts.
    axes : tuple of str
        Names of the axes: ("y", "x"), with "xyz" or "rgb" behind them, or none for one value per frame.
    meaning : str
        One line.
    needs : tuple of str
        Buffers of the frame that are read from the device for it.
    in_mm : bool
        True if only a calibrated rig has it.
    vertex : str or None
        Its name as a property of a mesh's vertices; None: meshes do not carry it.
    rounding : Rounding or None
        Of its values in the store; None: they are kept as they are.
    """

    def __init__(
        self,
        compute: Callable[[Any], T],
        dtype: str,
        unit: str | None,
        axes: tuple[str, ...],
        needs: tuple[str, ...],
        in_mm: bool,
        vertex: str | None,
        rounding: Rounding | None,
    ) -> None:
        super().__init__(compute)
        self.dtype, self.unit, self.axes, self.needs = dtype, unit, axes, needs
        self.in_mm, self.vertex, self.rounding = in_mm, vertex, rounding
        text = (compute.__doc__ or "").strip()
        self.meaning = text.partition("\n\n")[0]
        shape = {0: "one value", 2: "(H, W)", 3: "(H, W, 3)"}[len(axes)]
        self.__doc__ = f"{shape} {dtype}: {text}"

    def rounded(self, values: npt.NDArray[Any], noise_levels: float, *, in_mm: bool) -> npt.NDArray[Any]:
        """Return a frame's values as the store keeps them.

        Parameters
        ----------
        values : array
            The field.
        noise_levels : float
            The frame's noise, grey levels.
        in_mm : bool
            True if the frame's ranges are in mm.
        """
        return values if self.rounding is None else self.rounding.apply(values, noise_levels, in_mm)


def field(
    dtype: Literal["float32", "int32", "uint8", "bool"],
    unit: str | None = None,
    *,
    needs: tuple[str, ...],
    axes: tuple[str, ...] = ("y", "x"),
    in_mm: bool = False,
    vertex: str | None = None,
    rounding: Rounding | None = None,
) -> Callable[[Callable[[Any], T]], Field[T]]:
    """Make an entry of the table of a method that computes a field; its docstring defines the field."""
    return lambda compute: Field(compute, dtype, unit, axes, needs, in_mm, vertex, rounding)


def fields_of(frame: type) -> dict[str, Field[Any]]:
    """Return the fields that a class has, by name, in the order of their definition."""
    return {name: entry for name, entry in vars(frame).items() if isinstance(entry, Field)}


def _rounded(values: Floats, step: float) -> Floats:
    return np.asarray(np.rint(values * np.float32(1 / step)) * np.float32(step))


def _phase(phase: Floats, noise_levels: float, in_mm: bool) -> Floats:
    return _rounded(phase, _PHASE_STEP_RAD)


def _wrapped_phase(phase: Floats, noise_levels: float, in_mm: bool) -> Floats:
    end = np.float32(_PHASE_STEP_RAD * np.floor(np.pi / _PHASE_STEP_RAD))
    return np.clip(_rounded(phase, _PHASE_STEP_RAD), -end, end)


def _relative_range(values: Floats, noise_levels: float, in_mm: bool) -> Floats:
    return values if in_mm else _rounded(values, _PHASE_STEP_RAD)


def _modulation(modulation: Floats, noise_levels: float, in_mm: bool) -> Floats:
    if not noise_levels > 0:
        return modulation
    return _rounded(modulation, float(2 ** np.floor(np.log2(_NOISE_STEP * noise_levels))))


def _sigma(sigma: Floats, noise_levels: float, in_mm: bool) -> Floats:
    dropped = np.finfo(np.float32).nmant - _SIGMA_BITS
    bits = sigma.view(np.int32) + np.int32(1 << (dropped - 1))
    return np.asarray((bits & np.int32(-1 << dropped)).view(np.float32))


PHASE_DIGITS = Rounding("to 2^-14 rad", _phase)
WRAPPED_PHASE_DIGITS = Rounding("to 2^-14 rad, within [-pi, pi]", _wrapped_phase)
RELATIVE_RANGE_DIGITS = Rounding("in rad: to 2^-14 rad; in mm: not", _relative_range)
MODULATION_DIGITS = Rounding("to the power of two below a tenth of the frame's noise", _modulation)
SIGMA_DIGITS = Rounding("to 8 significant bits", _sigma)
