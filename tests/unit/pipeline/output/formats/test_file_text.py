"""Headings and tables as text."""

import numpy as np

from pipeline.output.formats import Heading, text_rows


def test_remarks_are_lines_with_a_mark():
    assert Heading("a", {"unit": "mm", "axes": "x right"}).comments("#") == "# unit mm\n# axes x right\n"


def test_a_table_is_a_row_a_line():
    assert text_rows("v %d %.1f\n", np.array([[1, 2.25], [3, 4]])) == "v 1 2.2\nv 3 4.0\n"
    assert text_rows("v %d\n", np.empty((0, 1))) == ""
