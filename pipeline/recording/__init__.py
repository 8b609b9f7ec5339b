"""Lossless recordings, written so that what was committed stays readable whatever happens later."""

from pipeline.recording.recorder import Recorder

__all__ = ["Recorder"]
