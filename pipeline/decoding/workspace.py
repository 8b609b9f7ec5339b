"""The device buffers that decoding needs between a frame's image and its result: the only thing that it writes to."""

import numpy as np

from tikernels import runtime
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.color_balance import Gains
from tikernels.phase.phase_change import rates_buffer
from tikernels.phase.smoothing import Smoother
from tikernels.unwrapping import GivenRegions, RegionUnwrapper


class Workspace:
    """Buffers for one image size and fringe period; stripes lie along the rows.

    Parameters
    ----------
    height, width : int
        Of the image.
    period_px : float
        Camera px per cycle.
    pairs : int
        Neighbours on either side that the smoothing fits.
    given : GivenRegions, optional
        A user's own unwrapper.
    """

    def __init__(
        self, height: int, width: int, period_px: float, pairs: int, given: GivenRegions | None = None
    ) -> None:
        self.period_px = period_px
        self._shape = (height, width)
        self.gains = Gains(height, width, period_px)
        self.model = ChannelModel(self.gains)
        self.rates = rates_buffer(height)
        self.fitted_phase = runtime.empty((height, width), np.float32)
        self.brightness = runtime.empty((height, width), np.float32)
        self.raw_phase = runtime.empty((height, width), np.float32)
        self.smoother = Smoother(height, width, pairs)
        self.phase = runtime.empty((height, width), np.float32)  # of the rows smoothed
        self.unwrapped = runtime.empty((height, width), np.float32)
        self.unwrapper = RegionUnwrapper(height, width, given)

    def fits(self, shape: tuple[int, int], period_px: float) -> bool:
        """Return whether these buffers are for frames of this size and period."""
        return (self._shape, self.period_px) == (shape, period_px)
