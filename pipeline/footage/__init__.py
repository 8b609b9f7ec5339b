"""Frames as they were stored: pictures, folders of them, videos and recordings, read by number."""

from pipeline.footage.image_file import read_picture
from pipeline.footage.source import BadFrame, Source, StoredAs, StoredFrame
from pipeline.footage.sources import open_source

__all__ = ["BadFrame", "Source", "StoredAs", "StoredFrame", "open_source", "read_picture"]
