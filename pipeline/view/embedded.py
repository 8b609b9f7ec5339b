"""The page as a notebook shows it, with its frames inside."""

import math
from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from pipeline.decoding.frame_fields import FrameFields
from pipeline.errors import FootageError
from pipeline.output.stored_result import StoredResult
from pipeline.showing import view_frames
from pipeline.view.message import ViewedFrame, describe_maps, maps_of
from pipeline.view.page import color_table, page

# Bytes of all frames of a page before compression: a notebook with several such pages still opens.
_MOST_BYTES = 16_000_000
# Frames taken from a long result, evenly spaced.
_MOST_FRAMES = 24
# Per pixel: place, sigma, order, colour, mask.
_BYTES_A_PIXEL = 24
# Maps included; the others, which are seldom needed, would add half of the size.
_MAPS = ("points", "depth", "sigma", "order", "texture", "mask")
_HEIGHT_PX = 640


class EmbeddedPage:
    """A self-contained page that a notebook displays.

    Parameters
    ----------
    html : str
        The document.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> frame.view()
    <EmbeddedPage of 1.0 MB>
    """

    def __init__(self, html: str) -> None:
        self.html = html

    def __repr__(self) -> str:
        return f"<EmbeddedPage of {len(self.html) / 1e6:.1f} MB>"

    def _repr_html_(self) -> str:
        """Return a sandboxed frame: the page can only draw, and save pictures."""
        style = f"width:100%;height:{_HEIGHT_PX}px;border:0"
        return f'<iframe sandbox="allow-scripts allow-downloads" style="{style}" srcdoc="{escape(self.html)}"></iframe>'


@view_frames.register
def _view_frame(frame: FrameFields) -> EmbeddedPage:
    name = "frame" if frame.number is None else f"frame {frame.number}"
    return embed([frame], name)


@view_frames.register
def _view_result(result: StoredResult) -> EmbeddedPage:
    """Show some frames of a result, evenly spaced.

    Raises
    ------
    FootageError
        No frame is done.
    """
    if not result.done:
        raise FootageError(f"{result.name} holds no frame that is done: decode first")
    places = np.unique(np.linspace(0, len(result) - 1, _MOST_FRAMES).round().astype(int))
    name = result.name if len(places) == len(result) else f"{result.name}: {len(places)} of {len(result)} frames"
    return embed([result[int(place)] for place in places], name)


def embed(frames: Sequence[FrameFields], title: str) -> EmbeddedPage:
    """Return a page of frames with the same fields; many or large ones are subsampled, and the page says so."""
    first = frames[0]
    fields = [name for name in first.fields if getattr(first, name, None) is not None]
    viewed = [ViewedFrame.of(frame, _MAPS) for frame in frames]
    height, width = next(iter(viewed[0].arrays.values())).shape[:2]
    step = math.ceil(math.sqrt(max(1.0, _BYTES_A_PIXEL * height * width * len(frames) / _MOST_BYTES)))
    shown = {name for name in maps_of(fields, in_mm=first.calibrated) if name in _MAPS}
    maps = {name: about for name, about in describe_maps(fields, in_mm=first.calibrated).items() if name in shown}
    about: dict[str, Any] = {
        **{"title": title, "maps": maps, "count": len(frames), "size": (width, height), "rate_hz": 2.0},
        **{"camera": False, "growing": False, "live": False, "colors": color_table()},
    }
    return EmbeddedPage(page(about, viewed, step))
