"""Windows of a two-dimensional code, a few cycles by a few cells, and how far any two at the same cells are apart."""

import numpy as np
import numpy.typing as npt

from pipeline.models import FloatArray


def words_of_distance_five() -> npt.NDArray[np.int64]:
    """Return the 256 words of fifteen cells of the punctured Nordstrom-Robinson code, (256, 15).

    Any two differ in five cells or more. They are the octacode's by the Gray map (A. R. Hammons et al., The
    Z4-linearity of Kerdock, Preparata, Goethals, and related codes, IEEE Trans. Inf. Theory 40, 301, 1994).
    """
    generator = np.array([np.roll([3, 1, 2, 1, 0, 0, 0], k) for k in range(4)])
    generator = np.column_stack([generator, -generator.sum(axis=1) % 4])
    quaternary = np.stack(np.unravel_index(np.arange(256), (4,) * 4), axis=1) @ generator % 4
    return np.array([[0, 0], [0, 1], [1, 1], [1, 0]])[quaternary].reshape(256, 16)[:, :15]


def apart(
    symbols: npt.NDArray[np.int64], shape: tuple[int, int], starts: npt.NDArray[np.int64] | None = None
) -> FloatArray:
    """Return the squared distance of windows at the same cells, whatever gain either has.

    Parameters
    ----------
    symbols : (R, C) int
        0 and 1 of cycles and cells; the cells repeat.
    shape : (cycles, cells)
        The windows'.
    starts : (N,) int, optional
        First cycles of the windows that are compared with all; None: all.

    Returns
    -------
    (C, N, R - cycles + 1) float64
        In steps from symbol to symbol, by the first cell and the first cycle of each.
    """
    cycles, cells = shape
    count = symbols.shape[1]
    around = (np.arange(count)[:, None] + np.arange(cells)) % count
    seen = np.lib.stride_tricks.sliding_window_view(symbols[:, around], cycles, axis=0)  # (windows, C, cells, cycles)
    seen = seen.swapaxes(0, 1).reshape(count, -1, cycles * cells).astype(np.float64)
    own = seen if starts is None else seen[:, starts]
    ones, others = own.sum(axis=-1)[..., None], seen.sum(axis=-1)[:, None]
    return np.asarray(ones + others - 2 * own @ seen.swapaxes(1, 2) - (ones - others) ** 2 / (cycles * cells))


def lowest_distances(symbols: npt.NDArray[np.int64], shape: tuple[int, int]) -> tuple[float, float]:
    """Return the least of the distances of any two windows of this shape, and that below which .1 % of them are."""
    between = apart(symbols, shape)
    each = between[:, *np.triu_indices(between.shape[1], 1)]
    return float(each.min()), float(np.quantile(each, 0.001))
