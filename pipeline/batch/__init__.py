"""Decode whole recordings into a store, resumably: in this process, in several, or on a cluster."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.batch.job import Crop, Job
    from pipeline.batch.run import DecodeProgress, DecodeSummary, decode_footage

__all__ = ["Crop", "DecodeProgress", "DecodeSummary", "Job", "decode_footage"]
__getattr__, __dir__ = lazily(__name__)
