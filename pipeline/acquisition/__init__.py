"""Capture with a rig: bursts are recorded, logged and decoded while they arrive."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from pipeline.acquisition.chosen_rig import read_rig
    from pipeline.acquisition.live import LiveDecoder, LiveFrame
    from pipeline.acquisition.session import capture_bursts

__all__ = ["LiveDecoder", "LiveFrame", "capture_bursts", "read_rig"]
__getattr__, __dir__ = lazily(__name__)
