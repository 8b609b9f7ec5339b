"""Panels of curves, drawn without a screen."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.files import write_atomically


def draw_panels(path: str | Path, panels: int, draw: Callable[[Any], None]) -> None:
    """Draw panels side by side and write them as a PNG.

    Parameters
    ----------
    path : str or Path
        The PNG.
    panels : int
        How many.
    draw : callable
        Takes the panels' axes.

    Raises
    ------
    OutputError
        The place cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * panels, 3.6), layout="constrained")
    draw(figure.subplots(1, panels, squeeze=False)[0])
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)  # type: ignore[no-untyped-call]  # matplotlib has no annotation there
    write_atomically(path, buffer.getvalue())
