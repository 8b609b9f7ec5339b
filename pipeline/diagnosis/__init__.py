"""Whether a rig still holds what its calibration says, why a surface is wavy, and what footage costs in accuracy."""

from pipeline.diagnosis.footage_inspection import inspect_footage
from pipeline.diagnosis.ripple import diagnose
from pipeline.diagnosis.surface_check import check_surface

__all__ = ["check_surface", "diagnose", "inspect_footage"]
