"""Lossless recordings, written so that what was committed stays readable whatever happens later."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.recording.recorder import Recorder

__all__ = ["Recorder"]
__getattr__, __dir__ = lazily(__name__)
