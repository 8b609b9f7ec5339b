"""A field of a frame as a figure with a scale, drawn without a screen."""

import io
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

# The few values beyond these percentiles are mostly wrong, and would leave all others one colour.
_LIMITS = (1, 99)


def plot_image(values: npt.NDArray[Any], title: str, unit: str | None, ax: "Axes | None" = None) -> "FigureBase":
    """Draw a field.

    Parameters
    ----------
    values : (H, W) or (H, W, 3)
        Numbers, with a scale beside them from their 1st to their 99th percentile; or flags, or RGB in uint8, without.
        NaN is left out.
    title : str
        The field's name.
    unit : str or None
        Of its values.
    ax : matplotlib.axes.Axes, optional
        Where to draw; None: a figure of its own.

    Returns
    -------
    matplotlib.figure.Figure
        The figure that it is drawn in. One of its own is known to no window: a notebook shows it where it is the last
        value of a cell, and `savefig` writes it.
    """
    if ax is None:
        ax = _own_figure().subplots()
    if values.ndim == 3 or values.dtype == np.bool_:
        ax.imshow(values, cmap="gray")
    else:
        known = values[np.isfinite(values)]
        low, high = np.percentile(known, _LIMITS) if known.size else (0, 1)
        image = ax.imshow(values, vmin=low, vmax=high)
        ax.figure.colorbar(image, ax=ax, extend="both", label=title if unit is None else f"{title} ({unit})")
    ax.set(title=title, xlabel="x (px)", ylabel="y (px)")
    return ax.figure


def _own_figure() -> "Figure":
    from matplotlib.figure import Figure  # slow to import, and only needed here

    class ShownFigure(Figure):
        """A figure that shows itself where pyplot, which tells notebooks how, was never imported."""

        def _repr_png_(self) -> bytes:
            file = io.BytesIO()
            self.savefig(file, format="png")
            return file.getvalue()

    return ShownFigure(layout="compressed")
