"""Capture with a rig: bursts are recorded, logged and decoded while they arrive."""

from pipeline.acquisition.live import LiveDecoder
from pipeline.acquisition.rig_file import read_rig
from pipeline.acquisition.session import capture

__all__ = ["LiveDecoder", "capture", "read_rig"]
