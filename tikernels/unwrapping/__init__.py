"""From wrapped phase to regions whose fringe orders agree, and the filter of single wrong orders."""

from tikernels.unwrapping.order_filter import correct_fringe_order
from tikernels.unwrapping.unwrapper import unwrap_phase

__all__ = ["correct_fringe_order", "unwrap_phase"]
