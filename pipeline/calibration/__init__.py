"""Measure a rig, keep what was measured, and check it later."""

from pipeline.calibration.model import (
    Calibration,
    Capture,
    ColorShift,
    Geometry,
    Lens,
    Pattern,
    Uncertainty,
)

__all__ = ["Calibration", "Capture", "ColorShift", "Geometry", "Lens", "Pattern", "Uncertainty"]
