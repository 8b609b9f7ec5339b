"""Draw the figures of docs/method.md: what a pixel is taken to be, and what a paint's own crosstalk is worth.

python tests/benchmarks/method_figures.py
"""

import argparse
from pathlib import Path

import _tests_path  # noqa: F401 - puts `support` and `reference` on the path
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from support.colored_boards import PAINTS, board, board_decoder, light, surface_matrix

from pipeline.decoding.frame import memory_of
from tikernels import runtime

_DOCS = Path(__file__).resolve().parents[2] / "docs"
_PAINTED = ["white", "skin", "orange", "blue"]
_COLORS = ("tab:red", "tab:green", "tab:blue")
# Levels of a bright pixel, of its ambient light, and of the noise.
_BRIGHT, _AMBIENT, _NOISE = 200.0, 10.0, 1.5


def main() -> None:
    """Draw both."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    runtime.init("cpu")
    mpl.rcParams.update({"svg.hashsalt": "colorphase", "font.size": 9, "figure.constrained_layout.use": True})
    draw_pixel(_DOCS / "method_pixel.svg")
    draw_surfaces(_DOCS / "method_surfaces.png")


def draw_pixel(path: Path) -> None:
    """Draw the channels over a cycle on two paints, and what a pixel of one leaves over under the matrix of each."""
    phase = np.linspace(-np.pi, np.pi, 361)
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.3))
    for axis, paint in zip(axes, ("white", "orange"), strict=False):
        matrix = surface_matrix(PAINTS[paint])
        channels = _BRIGHT * light(phase) @ matrix.T + _AMBIENT * matrix.sum(axis=1)
        for channel, color in enumerate(_COLORS):
            axis.plot(phase, channels[:, channel], color=color)
            axis.axhline(_AMBIENT * matrix.sum(axis=1)[channel], color=color, linewidth=0.6, linestyle=":")
        axis.set_title(f"{paint}: $C_i = s A_i t_i(\\varphi) + B_i$")
        axis.set_ylim(0, 1.05 * _BRIGHT)
        axis.set_ylabel("grey levels")
    own, white = surface_matrix(PAINTS["orange"]), surface_matrix(PAINTS["white"])
    seen = _BRIGHT * light(phase) @ own.T
    # White paint under a lamp of orange's colour: what the balance alone takes orange for.
    balanced = (seen.mean(axis=0) / (light(phase) @ white.T).mean(axis=0))[:, None] * white
    for matrix, name in ((balanced, "as balanced white"), (own, "as orange")):
        axes[2].plot(phase, _left_over(seen, matrix), label=name)
    axes[2].axhspan(-1, 1, color="0.9")
    axes[2].set_title("z of an orange pixel, in $\\sigma$ of the noise")
    figure.legend(*axes[2].get_legend_handles_labels(), loc="outside lower right", ncols=2, frameon=False)
    for axis in axes:
        axis.set_xlim(-np.pi, np.pi)
        axis.set_xticks([-np.pi, 0, np.pi], ["$-\\pi$", "0", "$\\pi$"])
        axis.set_xlabel("phase $\\varphi$")
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def _left_over(seen: npt.NDArray[np.float64], matrix: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return z of pixels, (N,): what the best phase and brightness under a matrix leave over."""
    phases = np.linspace(-np.pi, np.pi, 1440, endpoint=False)
    model = light(phases) @ matrix.T
    slope = np.gradient(model, phases, axis=0)
    cosine = seen @ model.T / np.linalg.norm(model, axis=1)
    best = cosine.argmax(axis=1)
    across = np.cross(model[best], slope[best])
    return np.asarray((seen * across).sum(axis=1) / np.linalg.norm(across, axis=1) / _NOISE)


def draw_surfaces(path: Path) -> None:
    """Draw a board of four paints, which surface each pixel was found to show, and the error without and with them."""
    image, phase, _ = board(_PAINTED, (200, 280), noise=_NOISE)
    found = board_decoder().decode(image)
    alike = board_decoder(reflectance_bands="broad").decode(image)
    surfaces = memory_of(found).surfaces
    assert surfaces is not None, "no surfaces were found"
    labels = runtime.to_host(surfaces.crosstalk.surfaces.labels)
    figure, grid = plt.subplots(2, 2, figsize=(9.0, 6.4))
    axes = grid.ravel()
    axes[0].imshow(np.clip(image / 255, 0, 1) ** (1 / 2.2))
    axes[0].set_title("frame")
    axes[1].imshow(labels, cmap="tab10", vmax=9)
    axes[1].set_title("surfaces found")
    for axis, frame, title in ((axes[2], alike, "error, one crosstalk"), (axes[3], found, "error, one for each paint")):
        error = np.angle(np.exp(1j * (frame.unwrapped_phase - phase)))
        picture = axis.imshow(error, cmap="RdBu", vmin=-0.3, vmax=0.3)
        axis.set_title(f"{title}: {np.sqrt(np.nanmean(error**2)):.3f} rad")
    figure.colorbar(picture, ax=axes[2:], label="rad")
    for axis in axes:
        axis.set_axis_off()
    figure.savefig(path, dpi=100, metadata={"Software": None})
    plt.close(figure)


if __name__ == "__main__":
    main()
