"""How objects show themselves in a notebook: as a block of HTML with a picture, figures and warnings.

What draws an object is often in a room above its class. So classes call the functions below, which load
`pipeline.output.notebook` when they first meet an object: it registers how each is shown.
"""

import base64
import sys
from collections.abc import Iterable, Mapping
from functools import singledispatch
from html import escape
from importlib import import_module
from typing import Any

from pipeline.errors import OutputError

_BLOCK = "display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start"


@singledispatch
def to_html(thing: object) -> str | None:
    """Return what a notebook shows of an object; None: its `repr`."""
    return to_html(thing) if _just_loaded() else None


@singledispatch
def to_pyvista(thing: object) -> Any:
    """Return an object as PyVista's data.

    Raises
    ------
    OutputError
        There is no such data for it.
    """
    if _just_loaded():
        return to_pyvista(thing)
    raise OutputError(f"a {type(thing).__name__} has no PyVista data: pass a decoded frame")


def _just_loaded() -> bool:
    """Load what shows the objects, unless it is loaded already; return whether it was loaded now."""
    if "pipeline.output.notebook" in sys.modules:
        return False
    import_module("pipeline.output.notebook")
    return True


def html_block(
    heading: str, figures: Mapping[str, str], warnings: Iterable[str] = (), picture: bytes | None = None
) -> str:
    """Return a block of HTML that needs no style sheet and no script; all texts are escaped.

    Parameters
    ----------
    heading : str
        What it is.
    figures : mapping of str to str
        Names, and what is to be told of each.
    warnings : iterable of str
        What the user should know, a line each.
    picture : bytes, optional
        A PNG file.
    """
    rows = "".join(
        f'<tr><th style="text-align:left">{escape(name)}</th><td style="text-align:left">{escape(value)}</td></tr>'
        for name, value in figures.items()
    )
    doubts = "".join(f"<li>{escape(text)}</li>" for text in warnings)
    image = ""
    if picture is not None:
        data = base64.b64encode(picture).decode("ascii")
        image = f'<img alt="{escape(heading)}" src="data:image/png;base64,{data}">'
    return (
        f'<div style="{_BLOCK}">{image}<div><b>{escape(heading)}</b><table>{rows}</table>'
        + (f"<b>Warnings</b><ul>{doubts}</ul>" if doubts else "")
        + "</div></div>"
    )
