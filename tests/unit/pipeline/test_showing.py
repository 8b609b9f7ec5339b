"""What every object shows in a notebook goes through one function, which escapes it."""

import base64

import pytest
from support.shown_html import Shown

from pipeline.errors import OutputError
from pipeline.showing import html_block, to_html, to_pyvista


def test_a_block_has_a_table_warnings_and_a_picture():
    shown = Shown(html_block("Thing", {"size": "3 x 2 px", "period": "12 px"}, ["dark", "far"], b"PNG"))
    assert shown.figures == {"size": "3 x 2 px", "period": "12 px"}
    assert shown.warnings == ["dark", "far"]
    assert shown.pictures == [b"PNG"]
    assert "Thing" in shown.texts


def test_nothing_is_taken_for_a_tag():
    """Footage may be called anything, and warnings name it."""
    evil = '<script>alert("x")</script>&amp;\''
    block = html_block(evil, {evil: evil}, [evil], b"PNG")
    assert "<script" not in block
    shown = Shown(block)
    assert shown.figures == {evil: evil}
    assert shown.warnings == [evil]
    assert shown.tags <= {"div", "b", "table", "tr", "th", "td", "ul", "li", "img"}


def test_a_block_without_warnings_does_not_speak_of_any():
    block = html_block("Thing", {})
    assert "Warnings" not in block
    assert "<img" not in block


def test_a_picture_stands_in_the_page_itself():
    assert f'src="data:image/png;base64,{base64.b64encode(b"PNG").decode()}"' in html_block("Thing", {}, (), b"PNG")


def test_what_nobody_has_said_how_to_show():
    assert to_html(3) is None  # the notebook shows its repr then
    with pytest.raises(OutputError, match="a int has no PyVista data"):
        to_pyvista(3)
