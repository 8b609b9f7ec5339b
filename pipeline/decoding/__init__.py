"""What the decoder knows and gives: the light, its buffers, the decoded frame."""

from pipeline.decoding.frame import DecodedFrame
from pipeline.decoding.self_calibration import LightEstimate, estimate_light

__all__ = ["DecodedFrame", "LightEstimate", "estimate_light"]
