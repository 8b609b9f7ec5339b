"""Depth in 16 bits, read back by programs that are not ours."""

import io
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from PIL import Image
from support.tilted_sheets import tilted_grid

from pipeline.errors import OutputError
from pipeline.output.formats import Heading
from pipeline.output.formats.camera_grids import decode_depth, depth_step_mm, encode_depth_png
from pipeline.output.formats.table import FORMATS, encode_as


@pytest.mark.parametrize("kind", ["png", "tiff"])
def test_depth_is_levels_times_the_step(tmp_path, kind):
    grid = tilted_grid()
    path = tmp_path / f"depth.{kind}"
    path.write_bytes(encode_as(FORMATS[kind], grid, "depth", 546)[f".{kind}"])
    levels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    with Image.open(path) as picture:
        said = picture.text if kind == "png" else json.loads(picture.tag_v2[270])
    assert levels.dtype == np.uint16 and levels.shape == grid.depth.shape
    step = float(said["depth_step_mm"])
    assert step == 0.01
    known = np.isfinite(grid.depth)
    np.testing.assert_array_equal(levels == 0, ~known)
    np.testing.assert_allclose(levels[known] * step, grid.depth[known], atol=step / 2 + 1e-4)


@pytest.mark.parametrize(
    ("farthest_mm", "step_mm"), [(655.35, 0.01), (655.36, 0.02), (1310, 0.02), (3000, 0.05), (9e4, 2.0), (0.0, 2e-8)]
)
def test_the_step_is_the_finest_round_one(farthest_mm, step_mm):
    assert depth_step_mm(farthest_mm) == pytest.approx(step_mm)
    assert depth_step_mm(farthest_mm) * 65535 >= farthest_mm


@pytest.mark.parametrize("kind", ["png", "tiff"])
def test_read_back_it_has_the_points_that_its_camera_saw(kind):
    grid = tilted_grid()
    read = decode_depth(encode_as(FORMATS[kind], grid, "depth", 546)[f".{kind}"])
    np.testing.assert_allclose(read.depth, grid.depth, atol=0.006)  # NaN where it is NaN
    known = np.isfinite(grid.depth)
    np.testing.assert_allclose(read.points[known][:, :2] / read.depth[known][:, None], grid.camera.rays()[known])
    assert read.camera is not None and read.camera.model_dump_json() == grid.camera.model_dump_json()


def remarks(**changed):
    grid = tilted_grid()
    said = {"depth_step_mm": "0.01", "camera": grid.camera.model_dump_json(), **changed}
    return encode_depth_png(grid, Heading("d", {name: value for name, value in said.items() if value}))[".png"]


def png_of(values):
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG")
    return file.getvalue()


def lens_of(width, height):
    return tilted_grid().camera.model_copy(update={"size_px": (width, height)}).model_dump_json()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (lambda: b"no picture", "it is no PNG and no TIFF picture"),
        (lambda: remarks()[:-60], "it is damaged"),
        (lambda: png_of(np.zeros((4, 4, 3), np.uint8)), "it is no picture of depth: that has one channel of 16 bits"),
        (
            lambda: png_of(np.zeros((4, 4), np.uint16)),
            "it says no depth_step_mm or no camera: give one that colorphase",
        ),
        (lambda: remarks(camera=""), "it says no depth_step_mm or no camera: give one that colorphase"),
        (lambda: remarks(camera="{}"), "its depth_step_mm or its camera cannot be read"),
        (lambda: remarks(camera=lens_of(7, 5)), "its camera is of another size than the picture"),
    ],
)
def test_other_pictures_are_refused_in_a_line(content, message):
    with pytest.raises(ValueError, match=message):
        decode_depth(content())


def test_a_picture_larger_than_allowed_is_refused_before_it_is_unpacked(monkeypatch):
    monkeypatch.setenv("COLORPHASE_MAX_PIXELS", "100")
    with pytest.raises(ValueError, match="COLORPHASE_MAX_PIXELS"):
        decode_depth(remarks())


def test_what_does_not_fit_is_refused():
    grid = tilted_grid()
    with pytest.raises(OutputError, match=r"depth reaches 546 mm, which 16 bits of 0\.001 mm do not hold"):
        encode_depth_png(grid, Heading("d", {"depth_step_mm": "0.001"}))


def test_nothing_measured_is_all_zero():
    grid = tilted_grid()
    empty = replace(grid, points=np.full_like(grid.points, np.nan))
    content = encode_as(FORMATS["png"], empty, "d", 0.0)[".png"]
    assert not cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED).any()
