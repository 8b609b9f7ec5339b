"""Checks of a calibration, causes of a wavy surface, and the cost of footage in accuracy."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.diagnosis.drift import Drift, measure_drift
    from pipeline.diagnosis.footage_inspection import inspect_footage
    from pipeline.diagnosis.frame_sequence import diagnose_sequence
    from pipeline.diagnosis.rig_check import check_epipolar, check_surface, correct_light
    from pipeline.diagnosis.ripple import diagnose

__all__ = [
    "Drift",
    "check_epipolar",
    "check_surface",
    "correct_light",
    "diagnose",
    "diagnose_sequence",
    "inspect_footage",
    "measure_drift",
]
__getattr__, __dir__ = lazily(__name__)
