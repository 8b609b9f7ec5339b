"""What a user does with the kernels: decode, export, render, simulate.

What is named here is imported when it is first asked for: the program `colorphase` begins with this package, and Ctrl-C
is to end it at once, before all is loaded.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pipeline.calibration import Calibration
    from pipeline.decoder import Decoder
    from pipeline.decoding.frame import DecodedFrame
    from pipeline.errors import DecodeWarning
    from pipeline.settings import DecodeSettings

__all__ = ["Calibration", "DecodeSettings", "DecodeWarning", "DecodedFrame", "Decoder"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import pipeline.output  # noqa: F401  # it says how frames and calibrations show themselves
    from pipeline.calibration import Calibration
    from pipeline.decoder import Decoder
    from pipeline.decoding.frame import DecodedFrame
    from pipeline.errors import DecodeWarning
    from pipeline.settings import DecodeSettings

    there = (Calibration, DecodeSettings, DecodeWarning, DecodedFrame, Decoder)
    return dict(zip(__all__, there, strict=True))[name]
