"""Evidence of a frame's absolute fringe orders: the contrast of each cycle, and the votes of the frame before."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from tikernels.order_evidence.contrast_reading import measure_contrast
    from tikernels.order_evidence.modulation_correction import correct_by_modulation, follow_phase
    from tikernels.order_evidence.order_votes import vote_orders
    from tikernels.order_evidence.part_joining import join_parts

__all__ = [
    "correct_by_modulation",
    "follow_phase",
    "join_parts",
    "measure_contrast",
    "vote_orders",
]
__getattr__, __dir__ = lazily(__name__)
