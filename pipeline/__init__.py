"""The user's tasks with the kernels: decode, export, render, simulate."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.calibration import Calibration
    from pipeline.decoder import Decoder
    from pipeline.decoding.frame import DecodedFrame
    from pipeline.errors import DecodeWarning
    from pipeline.settings import DecodeSettings

__all__ = ["Calibration", "DecodeSettings", "DecodeWarning", "DecodedFrame", "Decoder"]
__version__ = "0.1.0"
__getattr__, __dir__ = lazily(__name__)
