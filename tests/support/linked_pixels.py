"""Links between pixels, as `link_pixels` finds them."""

import numpy as np
import numpy.typing as npt

from tikernels.depth.step_cutting import DOWN, FALLING, RIGHT, RISING


def all_linked(shape: tuple[int, int]) -> npt.NDArray[np.uint8]:
    """Return the links of a surface without steps that fills the image."""
    links = np.full(shape, RIGHT | DOWN | FALLING | RISING, np.uint8)
    links[:, -1] = DOWN
    links[-1] = RIGHT
    links[-1, -1] = 0
    return links


def cut_beside(links: npt.NDArray[np.uint8], column: int) -> npt.NDArray[np.uint8]:
    """Return links without those between a column and the next."""
    cut = links.copy()
    cut[:, column] &= DOWN
    return cut
