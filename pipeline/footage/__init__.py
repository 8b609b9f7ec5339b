"""Frames as they were stored: image files, folders of them, videos and recordings, read by number."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.footage.footage import BadFrame, Footage, StoredAs, StoredFrame
    from pipeline.footage.image_file import read_image
    from pipeline.footage.opening import open_footage

__all__ = ["BadFrame", "Footage", "StoredAs", "StoredFrame", "open_footage", "read_image"]
__getattr__, __dir__ = lazily(__name__)
