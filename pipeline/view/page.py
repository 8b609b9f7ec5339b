"""The page: one HTML text that needs nothing else, and takes its frames from a server, or out of itself."""

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from functools import cache
from html import escape
from importlib.resources import files
from typing import Any

import numpy as np

from pipeline.output.pictures.picture_overlay import ColorScale
from pipeline.view.message import ViewedFrame

_SCRIPTS = ("three.min.js", "frames.js", "measure.js", "panes.js", "surface.js", "viewer.js")


@cache
def color_table() -> str:
    """Return the colours of values, 256 times RGB from the lowest, as Base64."""
    colors = ColorScale(0.0, 255.0, "", "").colors(np.arange(256.0, dtype=np.float32))
    return base64.b64encode(colors.tobytes()).decode("ascii")


def page(about: Mapping[str, Any] | None = None, frames: Sequence[ViewedFrame] = (), step: int = 1) -> str:
    """Return the page.

    Parameters
    ----------
    about : mapping, optional
        What is shown, see `Subject.about`, if the page has its frames in it; None: it asks a server for both.
    frames : sequence of ViewedFrame
        The frames in it.
    step : int
        Every how many pixels of them.
    """
    styles, scripts = page_text("viewer.css"), [page_text(name) for name in _SCRIPTS]
    data = ""
    if about is not None:
        packed = [base64.b64encode(frame.pack(step)).decode("ascii") for frame in frames]
        data = f'<script type="application/json" id="about">{_safe(about)}</script>' + "".join(
            f'<script type="text/plain" id="frame-{place}">{text}</script>' for place, text in enumerate(packed)
        )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{escape(policy(asks=about is None))}">'
        f"<title>colorphase</title><style>{styles}</style></head><body>{page_text('viewer.html')}{data}"
        + "".join(f"<script>{script}</script>" for script in scripts)
        + "</body></html>"
    )


def policy(*styles: str, asks: bool = False) -> str:
    """Return the rule by which nothing but the viewer runs and nothing goes out, whatever texts a frame brings.

    Parameters
    ----------
    styles : str
        Style sheets next to the viewer's own.
    asks : bool
        Whether the page asks its server for what it shows.
    """
    allowed = " ".join(_hash(style) for style in (page_text("viewer.css"), *styles))
    return "; ".join(
        [
            "default-src 'none'",
            f"style-src {allowed} 'unsafe-hashes'",
            f"script-src {' '.join(_hash(page_text(script)) for script in _SCRIPTS)}",
            "img-src data: blob:",
            "connect-src 'self'" if asks else "connect-src 'none'",
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )


def _safe(values: Mapping[str, Any]) -> str:
    """Return JSON that ends no script, whatever is in it."""
    return json.dumps(values).replace("<", "\\u003c")


@cache
def page_text(name: str) -> str:
    """Return a file that pages are made of."""
    return files("pipeline.view").joinpath("page", name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
    return f"'sha256-{digest}'"
