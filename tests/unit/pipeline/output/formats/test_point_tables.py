"""Points as text and as NumPy's archive: what each line and array is."""

import csv
import io
from dataclasses import replace

import numpy as np
from support.tilted_sheets import HEIGHT, WIDTH, tilted_grid

from pipeline.output.formats.table import FORMATS, encode_as


def content(kind, grid):
    return encode_as(FORMATS[kind], grid, "points")[f".{kind}"]


def test_xyz_is_a_line_of_numbers_for_each_point_y_up():
    lines = content("xyz", tilted_grid()).decode().splitlines()
    assert len(lines) == np.isfinite(tilted_grid().depth).sum()
    assert lines[0] == "-8 20 -500 200 30 20"
    plain = content("xyz", replace(tilted_grid(), texture=None)).decode().splitlines()
    assert plain[0] == "-8 20 -500"


def test_csv_names_its_columns_and_keeps_the_cameras_axes():
    rows = list(csv.DictReader(io.StringIO(content("csv", tilted_grid()).decode())))
    assert len(rows) == np.isfinite(tilted_grid().depth).sum()
    assert rows[WIDTH + 2] == {
        **{"row": "1", "column": "2", "x_mm": "-4", "y_mm": "-18", "z_mm": "502"},
        **{"red": "200", "green": "30", "blue": "20", "sigma_mm": "0.1"},
    }


def test_npz_has_the_grid_the_lens_and_how_it_was_made():
    grid = tilted_grid()
    with np.load(io.BytesIO(content("npz", grid)), allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["points"], grid.points)
        np.testing.assert_array_equal(arrays["texture"], grid.texture)
        np.testing.assert_array_equal(arrays["camera_matrix"], grid.camera.matrix)
        assert arrays["sigma_mm"].shape == (HEIGHT, WIDTH) and str(arrays["unit"]) == "mm"
        assert str(arrays["source"]) == grid.provenance["source"]
    assert content("npz", grid) == content("npz", grid)  # which an export that was stopped goes by
