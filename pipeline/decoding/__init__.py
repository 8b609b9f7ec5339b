"""State and results of the decoder: the light, its buffers, the decoded frame."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.decoding.frame import DecodedFrame
    from pipeline.decoding.frame_fields import FrameFields
    from pipeline.decoding.rig_state import RigState
    from pipeline.decoding.self_calibration import LightEstimate

__all__ = ["DecodedFrame", "FrameFields", "LightEstimate", "RigState"]
__getattr__, __dir__ = lazily(__name__)
