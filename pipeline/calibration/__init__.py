"""Measure a rig: its lenses, where they stand, and its light; and keep what was measured."""

from pipeline.calibration.model import (
    Calibration,
    ColorShift,
    Geometry,
    Lens,
    Pattern,
    Uncertainty,
)

__all__ = ["Calibration", "ColorShift", "Geometry", "Lens", "Pattern", "Uncertainty"]
