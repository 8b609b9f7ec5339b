"""Measure a rig: its lenses, their poses, and its light; and keep what was measured."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.calibration.lens import Lens
    from pipeline.calibration.model import Calibration, ColorShift, Geometry, Pattern, Uncertainty

__all__ = ["Calibration", "ColorShift", "Geometry", "Lens", "Pattern", "Uncertainty"]
__getattr__, __dir__ = lazily(__name__)
