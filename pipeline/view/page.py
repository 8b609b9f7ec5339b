"""The page: one self-contained HTML document that loads its frames from a server or contains them."""

import base64
import gzip
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
# Of compression: a higher one takes twice as long, for a fiftieth less.
_LEVEL = 1


@cache
def color_table() -> str:
    """Return the colour map as 256 RGB triples in Base64, lowest value first."""
    colors = ColorScale(0.0, 255.0, "", "").colors(np.arange(256.0, dtype=np.float32))
    return base64.b64encode(colors.tobytes()).decode("ascii")


def page(about: Mapping[str, Any] | None = None, frames: Sequence[ViewedFrame] = (), step: int = 1) -> str:
    """Return the page.

    Parameters
    ----------
    about : mapping, optional
        Description of the subject, see `Subject.about`, of a page that contains its frames; None: the page requests
        both from its server.
    frames : sequence of ViewedFrame
        The frames that it contains.
    step : int
        Step between the pixels that are kept.
    """
    styles, scripts = page_text("viewer.css"), [page_text(name) for name in _SCRIPTS]
    data = ""
    if about is not None:
        packed = [base64.b64encode(gzip.compress(frame.pack(step), _LEVEL)).decode("ascii") for frame in frames]
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
    """Return the Content-Security-Policy: no other script runs and no request leaves, whatever texts a frame contains.

    Parameters
    ----------
    styles : str
        Further style sheets.
    asks : bool
        True if the page requests its frames from its server.
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
    """Return JSON that cannot end the script element that it is in."""
    return json.dumps(values).replace("<", "\\u003c")


@cache
def page_text(name: str) -> str:
    """Return a file that pages are made of."""
    return files("pipeline.view").joinpath("page", name).read_text(encoding="utf-8")


def _hash(text: str) -> str:
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
    return f"'sha256-{digest}'"
