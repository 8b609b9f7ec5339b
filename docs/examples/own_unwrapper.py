"""An unwrapper of your own in place of the decoder's: here scikit-image's.

python docs/examples/own_unwrapper.py

It needs `pip install scikit-image`.
"""

import numpy as np
import numpy.typing as npt
from skimage.measure import label
from skimage.restoration import unwrap_phase

import colorphase

Unwrapped = tuple[npt.NDArray[np.float64], npt.NDArray[np.int64]]


class ScikitImage:
    """scikit-image's unwrapping; the connected parts of the mask are the regions."""

    def unwrap(self, phase: npt.NDArray[np.float32], quality: npt.NDArray[np.float32]) -> Unwrapped:
        """Return the unwrapped phase, (H, W) rad, and the regions, (H, W) integers from 1; 0 outside the mask."""
        inside = np.isfinite(phase)
        # scikit-image does not return from a masked NaN.
        masked = np.ma.masked_array(np.nan_to_num(phase).astype(np.float64), ~inside)
        return np.ma.filled(unwrap_phase(masked, rng=0), np.nan), label(inside, connectivity=1)


def main() -> None:
    """Decode a simulated frame with both unwrappers and print where their orders differ."""
    rig, scene = colorphase.simulated_rig(), colorphase.SimulationSettings(scene="waves")
    image = colorphase.simulate_frame(rig, scene).image
    settings = colorphase.DecodeSettings(crosstalk_matrix=scene.crosstalk_matrix)
    own = colorphase.Decoder(settings, arch="cpu").decode(image)
    theirs = colorphase.Decoder(settings, arch="cpu", unwrapper=ScikitImage()).decode(image)
    both = own.mask & theirs.mask
    cycles = np.rint((theirs.unwrapped_phase - own.unwrapped_phase)[both] / (2 * np.pi))
    # Without a calibration the orders count from any cycle: the commonest difference is no difference.
    constant = np.median(cycles)
    print(f"{both.sum()} pixels in both, {np.count_nonzero(cycles != constant)} with different orders")


if __name__ == "__main__":
    main()
