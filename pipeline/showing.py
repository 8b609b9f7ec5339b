"""Display of objects in a notebook: as HTML with a picture, figures and warnings, or as a figure; and saving.

What draws an object is often in a room above its class. So classes call the functions below, which load
`pipeline.output.notebook` or `pipeline.view.embedded` when they first meet an object: it registers how each is shown.
"""

import base64
import io
import sys
from collections.abc import Iterable, Mapping
from functools import singledispatch
from html import escape
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import OutputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, FigureBase

_BLOCK = "display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start"
# The few values beyond these percentiles are mostly wrong, and would leave all others one colour.
_LIMITS = (1, 99)


@singledispatch
def to_html(thing: object) -> str | None:
    """Return what a notebook shows of an object; None: its `repr`."""
    return to_html(thing) if _just_loaded() else None


@singledispatch
def to_pyvista(thing: object) -> Any:
    """Return an object as PyVista's data.

    Raises
    ------
    OutputError
        There is no such data for it.
    """
    if _just_loaded():
        return to_pyvista(thing)
    raise OutputError(f"a {type(thing).__name__} has no PyVista data: pass a decoded frame")


@singledispatch
def save_frame(frame: object, path: Path) -> None:
    """Write a frame as a file; see `FrameFields.save`."""
    if _just_loaded():
        save_frame(frame, path)


@singledispatch
def view_frames(frames: object) -> Any:
    """Return a page that shows a frame, or a result's frames; see `FrameFields.view`."""
    if "pipeline.view.embedded" not in sys.modules:
        import_module("pipeline.view.embedded")
        return view_frames(frames)
    raise OutputError(f"a {type(frames).__name__} has no page: pass a decoded frame or a result")


def _just_loaded() -> bool:
    """Load what shows the objects, unless it is loaded already; return whether it was loaded now."""
    if "pipeline.output.notebook" in sys.modules:
        return False
    import_module("pipeline.output.notebook")
    return True


def html_block(
    heading: str, figures: Mapping[str, str], warnings: Iterable[str] = (), picture: bytes | None = None
) -> str:
    """Return a block of HTML that needs no style sheet and no script; all texts are escaped.

    Parameters
    ----------
    heading : str
        The object's name.
    figures : mapping of str to str
        Names, and the text about each.
    warnings : iterable of str
        Warnings for the user, one line each.
    picture : bytes, optional
        A PNG file.
    """
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in figures.items()
    )
    doubts = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    image = ""
    if picture is not None:
        data = base64.b64encode(picture).decode("ascii")
        image = f'<img alt="{escape(heading)}" style="max-width:100%" src="data:image/png;base64,{data}">'
    return (
        f'<div style="{_BLOCK}">{image}<div><b>{escape(heading)}</b><table>{rows}</table>'
        + (f"<b>Warnings</b><ul>{doubts}</ul>" if doubts else "")
        + "</div></div>"
    )


def plot_image(values: npt.NDArray[Any], title: str, unit: str | None, ax: "Axes | None" = None) -> "FigureBase":
    """Draw a field.

    Parameters
    ----------
    values : (H, W) or (H, W, 3)
        Numbers, with a scale next to them from their 1st to their 99th percentile; or flags, or RGB in uint8, without.
        NaN is left out.
    title : str
        The field's name.
    unit : str or None
        Of its values.
    ax : matplotlib.axes.Axes, optional
        The axes to draw into; None: a new figure.

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
        """A figure that shows itself where pyplot, which registers its display, was never imported."""

        def _repr_png_(self) -> bytes:
            file = io.BytesIO()
            self.savefig(file, format="png")
            return file.getvalue()

    return ShownFigure(layout="compressed")
