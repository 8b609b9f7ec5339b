"""What a user does with the kernels: decode, export, render, simulate."""

from pipeline.calibration import Calibration
from pipeline.decoder import Decoder
from pipeline.decoding.frame import DecodedFrame
from pipeline.errors import DecodeWarning
from pipeline.settings import DecodeSettings

__all__ = ["Calibration", "DecodeSettings", "DecodeWarning", "DecodedFrame", "Decoder"]
