"""How objects show themselves in a notebook: as a block of HTML with a picture, figures and warnings.

What draws an object often lies in a room above its class. So classes ask the functions below, and `pipeline.output`,
which `import colorphase` imports, tells them how it is done.
"""

import base64
from collections.abc import Iterable, Mapping
from functools import singledispatch
from html import escape
from typing import Any

from pipeline.errors import OutputError

_BLOCK = "display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start"


@singledispatch
def to_html(thing: object) -> str | None:
    """Return what a notebook shows of an object; None: nobody has said how, and it shows its `repr`."""
    return None


@singledispatch
def to_pyvista(thing: object) -> Any:
    """Return an object as PyVista's data.

    Raises
    ------
    OutputError
        Nobody has said how.
    """
    raise OutputError(f"nothing makes PyVista's data of a {type(thing).__name__} yet: import colorphase first")


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
