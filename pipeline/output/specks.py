"""What of linked pixels is a surface: no teeth at rims, and no specks.

A pixel belongs to a surface where it is a corner of a whole square: four pixels, linked along all sides and along a
diagonal. What hangs on by less is a tooth, as the last pixel at a rim that lies a step away from the one beside it.
Squares that share a corner are one surface, and surfaces of few squares are specks.
"""

import cv2
import numpy as np
import numpy.typing as npt

from tikernels.depth.step_cutting import DOWN, FALLING, RIGHT, RISING

Bits = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.bool_]

# Squares of four pixels: as many as the decoder asks a region to have pixels, of which fewer seldom know their order.
_LEAST_SQUARES = 128


def find_surfaces(links: Bits, least_squares: int = _LEAST_SQUARES) -> tuple[Pixels, Pixels]:
    """Tell the pixels of surfaces from teeth and specks.

    Parameters
    ----------
    links : (H, W) uint8
        See `tikernels.depth.step_cutting.link_pixels`.
    least_squares : int
        Whole squares that a surface has at least.

    Returns
    -------
    surfaces, specks : (H, W) bool
        Pixels of surfaces, and of specks; what is neither is a tooth, or linked with nothing.
    """
    squares = _whole_squares(links)
    if squares.size == 0:
        return _corners(squares), _corners(squares)
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(squares.view(np.uint8), connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] >= least_squares
    large[0] = False  # what is no square
    surfaces = _corners(large[labels])
    return surfaces, _corners(squares) & ~surfaces


def links_within(links: Bits, pixels: Pixels) -> Bits:
    """Return the links without those that lead to other pixels than these."""
    kept = np.zeros_like(links)
    for bit, start, end in _edges(pixels):
        kept[: start.shape[0], : start.shape[1]] |= np.where(start & end, np.uint8(bit), np.uint8(0))
    return links & kept


def _edges(pixels: Pixels) -> tuple[tuple[int, Pixels, Pixels], ...]:
    """Return the pixels at both ends of each kind of link, at the place where the link is kept."""
    return (
        (RIGHT, pixels[:, :-1], pixels[:, 1:]),
        (DOWN, pixels[:-1], pixels[1:]),
        (FALLING, pixels[:-1, :-1], pixels[1:, 1:]),
        (RISING, pixels[:-1, 1:], pixels[1:, :-1]),
    )


def _whole_squares(links: Bits) -> Pixels:
    """(H - 1, W - 1) bool: squares whose four pixels are linked along all sides and a diagonal."""
    here, right, below = links[:-1, :-1], links[:-1, 1:], links[1:, :-1]
    sides = (here & RIGHT != 0) & (here & DOWN != 0) & (right & DOWN != 0) & (below & RIGHT != 0)
    return np.ascontiguousarray(sides & (here & (FALLING | RISING) != 0))


def _corners(squares: Pixels) -> Pixels:
    """Return the pixels that are a corner of a square."""
    pixels = np.zeros((squares.shape[0] + 1, squares.shape[1] + 1), np.bool_)
    for part in (pixels[:-1, :-1], pixels[:-1, 1:], pixels[1:, :-1], pixels[1:, 1:]):
        part |= squares
    return pixels
