"""The encoding of footage's light: by the settings, the calibration, or the footage itself."""

from pipeline.calibration import Calibration
from pipeline.footage.footage import Footage
from pipeline.settings import DecodeSettings


def with_transfer_of(
    source: Footage, settings: DecodeSettings, calibration: Calibration | None
) -> tuple[DecodeSettings, str]:
    """Return settings that state how light is encoded (their own, the calibration's or the footage's), and the source.

    Where the calibration has measured a curve of its own, they leave it to that.
    """
    capture = None if calibration is None else calibration.capture
    measured = None if capture is None else capture.transfer
    if settings.transfer is not None:
        return settings, "the settings say so"
    if measured is not None:
        known = settings.model_copy(update={"transfer": measured}) if isinstance(measured, str) else settings
        return known, "the calibration has measured it"
    return settings.model_copy(update={"transfer": source.transfer or "linear"}), source.transfer_because
