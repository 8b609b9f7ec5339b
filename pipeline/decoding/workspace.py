"""The device buffers that decoding needs between a frame's image and its result."""

import numpy as np

from tikernels import runtime
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.color_balance import Gains
from tikernels.phase.smoothing import rates_buffer
from tikernels.unwrapping.patches import Patches
from tikernels.unwrapping.unwrap_methods import METHODS
from tikernels.unwrapping.unwrapper import RegionUnwrapper


class Workspace:
    """Buffers for one image size and fringe period; stripes lie along the rows."""

    patches: Patches

    def __init__(self, height: int, width: int, period_px: float, unwrap_method: str) -> None:
        self.key = (height, width, period_px)
        self.gains = Gains(height, width, period_px)
        self.model = ChannelModel(self.gains)
        self.rates = rates_buffer(height)
        self.raw_phase = runtime.empty((height, width), np.float32)
        self.unwrapper = RegionUnwrapper(height, width, METHODS[unwrap_method](height, width))
