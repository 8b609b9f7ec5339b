"""Frames as they were stored: image files, folders of them, videos and recordings, read by number."""

from pipeline.footage.image_file import read_image
from pipeline.footage.opening import open_source
from pipeline.footage.source import BadFrame, Source, StoredAs, StoredFrame

__all__ = ["BadFrame", "Source", "StoredAs", "StoredFrame", "open_source", "read_image"]
