"""From linear RGB light to the phase of every pixel, its modulation and its standard deviation."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from tikernels.phase.color_balance import balance_color
    from tikernels.phase.crosstalk import correct_crosstalk, invert_crosstalk
    from tikernels.phase.equalization import equalize_phase
    from tikernels.phase.frame_statistics import measure_frame
    from tikernels.phase.smoothing import smooth_phase
    from tikernels.phase.wrapped_phase import compute_wrapped_phase

__all__ = [
    "balance_color",
    "compute_wrapped_phase",
    "correct_crosstalk",
    "equalize_phase",
    "invert_crosstalk",
    "measure_frame",
    "smooth_phase",
]
__getattr__, __dir__ = lazily(__name__)
