"""
An unwrapper of your own
========================

The decoder accepts any object with a method ``unwrap``. This one calls scikit-image, which needs ``pip install
scikit-image``.
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


# %%
# Both decode the same frame.

rig, scene = colorphase.simulated_rig(), colorphase.SimulationSettings(scene="waves")
image = colorphase.simulate_frame(rig, scene).image
settings = colorphase.DecodeSettings(crosstalk_matrix=scene.crosstalk_matrix)
own = colorphase.Decoder(settings, arch="cpu").decode(image)
theirs = colorphase.Decoder(settings, arch="cpu", unwrapper=ScikitImage()).decode(image)
theirs.plot("unwrapped_phase").savefig("phase.png")

# %%
# Without a calibration the orders count from an arbitrary cycle: only differences from the median one count.

both = own.mask & theirs.mask
cycles = np.rint((theirs.unwrapped_phase - own.unwrapped_phase)[both] / (2 * np.pi))
print(f"{both.sum()} pixels in both, {np.count_nonzero(cycles != np.median(cycles))} with different orders")
