"""Decode whole recordings into a store, resumably: in this process, in several, or on a cluster."""

from pipeline.batch.job import Job
from pipeline.batch.run import decode_footage

__all__ = ["Job", "decode_footage"]
