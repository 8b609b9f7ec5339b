"""What the radiometry measured, as a figure, drawn without a screen."""

import io
from pathlib import Path

import numpy as np

from pipeline.calibration.radiometry import PRIMARIES, RAMP_CODES, Radiometry
from pipeline.files import write_atomically


def plot_radiometry(radiometry: Radiometry, path: str | Path) -> None:
    """Draw what each camera channel sees of red, green and blue, and the three responses (figure 2.2 of the paper).

    Parameters
    ----------
    radiometry : Radiometry
        What was measured.
    path : str or Path
        The PNG.

    Raises
    ------
    OutputError
        The place cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import, and only needed here
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2 * 4, 3.6), layout="constrained")
    axes = figure.subplots(1, 4)
    codes = np.array([0, *RAMP_CODES])
    for k, color in enumerate(PRIMARIES):
        axes[k].set_title(f"camera's response to {color}")
        for i, channel in enumerate(PRIMARIES):
            axes[k].plot(codes, radiometry.ramps[k, :, i], color=channel, marker="o", markersize=3)
        axes[3].plot(np.arange(256), radiometry.response[k], color=color)
    axes[3].set_title("the projector's responses")
    for panel in axes:
        panel.set_xlabel("projector code")
        panel.set_ylabel("linear light")
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)  # type: ignore[no-untyped-call]  # matplotlib has no annotation there
    write_atomically(path, buffer.getvalue())
