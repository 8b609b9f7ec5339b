"""From wrapped phase to regions whose fringe orders agree, and the filter of single wrong orders."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from tikernels.unwrapping.given_regions import GivenRegions, UserUnwrapper
    from tikernels.unwrapping.order_filter import correct_fringe_order
    from tikernels.unwrapping.patches import Patches, PatchGraph, RegionTable
    from tikernels.unwrapping.unwrapper import RegionUnwrapper, unwrap_phase

__all__ = [
    "GivenRegions",
    "PatchGraph",
    "Patches",
    "RegionTable",
    "RegionUnwrapper",
    "UserUnwrapper",
    "correct_fringe_order",
    "unwrap_phase",
]
__getattr__, __dir__ = lazily(__name__)
