"""Depth pictures and PCD files: what they hold, what comes back, and what is refused."""

import io
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from support.tilted_sheets import HEIGHT, WIDTH, tilted_grid

from pipeline.errors import OutputError
from pipeline.output.formats import Heading
from pipeline.output.formats.camera_grids import decode_depth, decode_pcd, depth_step_mm, encode_depth_png, encode_pcd
from pipeline.output.formats.table import FORMATS, encode_as

FOREIGN = Path(__file__).parents[4] / "support" / "foreign"


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
        (lambda: remarks()[:16] + b"\1" + remarks()[17:], "it is no PNG and no TIFF picture, or damaged"),
        (lambda: png_of(np.zeros((4, 4, 3), np.uint8)), "it is no picture of depth: that has one channel of 16 bits"),
        (
            lambda: png_of(np.zeros((4, 4), np.uint16)),
            "it has no depth_step_mm or no camera: give one that colorphase",
        ),
        (lambda: remarks(camera=""), "it has no depth_step_mm or no camera: give one that colorphase"),
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


def test_the_grid_is_kept_row_by_row():
    grid = tilted_grid()
    content = encode_pcd(grid, Heading("g", {"unit": "m"}))[".pcd"]
    head, _, body = content.partition(b"DATA binary\n")
    assert head.decode().splitlines()[1:] == [
        "# unit m",
        "VERSION 0.7",
        "FIELDS x y z rgb sigma_mm",
        "SIZE 4 4 4 4 4",
        "TYPE F F F F F",
        "COUNT 1 1 1 1 1",
        f"WIDTH {WIDTH}",
        f"HEIGHT {HEIGHT}",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {WIDTH * HEIGHT}",
    ]
    values = np.frombuffer(body, "<f4").reshape(HEIGHT, WIDTH, 5)
    np.testing.assert_allclose(values[..., :3], grid.points / 1000, rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(values[..., 2]), np.isnan(grid.depth))


def test_without_a_texture_there_is_no_color():
    head = encode_pcd(replace(tilted_grid(), texture=None, properties={}), Heading("g", {}))[".pcd"]
    assert b"FIELDS x y z\n" in head


def same(read, grid):
    np.testing.assert_allclose(read.points, grid.points, rtol=1e-5)
    np.testing.assert_array_equal(read.properties["sigma_mm"], grid.properties["sigma_mm"])
    np.testing.assert_array_equal(read.texture, grid.texture)


def test_a_grid_comes_back():
    same(decode_pcd(encode_pcd(tilted_grid(), Heading("g", {}))[".pcd"]), tilted_grid())


def test_ascii_is_read():
    grid = tilted_grid()
    whole = encode_pcd(grid, Heading("g", {}))[".pcd"]
    head, _, body = whole.partition(b"DATA binary\n")
    rows = np.frombuffer(body, "<f4").reshape(-1, 5)
    text = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in rows)
    same(decode_pcd(head + b"DATA ascii\n" + text.encode()), grid)


def test_other_types_are_read():
    head = b"VERSION .7\nFIELDS x y z rgba label\nSIZE 8 8 8 4 2\nTYPE F F F U U\nCOUNT 1 1 1 1 1\nWIDTH 2\nHEIGHT 2\n"
    points = np.zeros((2, 2), "f8,f8,f8,u4,u2")
    points["f2"], points["f3"], points["f4"] = [[1, 2], [-1, 3]], 0xFF010203, 7
    read = decode_pcd(head + b"POINTS 4\nDATA binary\n" + points.tobytes())
    np.testing.assert_array_equal(read.depth, [[1000, 2000], [np.nan, 3000]])  # nothing lies behind a camera
    assert (read.texture == (1, 2, 3)).all() and (read.properties["label"] == 7).all()


@pytest.mark.parametrize("data", ["binary", "ascii"])
def test_what_fills_gaps_and_what_has_several_numbers_is_left_out(data):
    head = "VERSION .7\nFIELDS x y z _ histogram _\nSIZE 4 4 4 1 4 1\nTYPE F F F U F U\nCOUNT 1 1 1 4 2 1\n"
    points = np.zeros((2, 2), "3f4,4u1,2f4,u1")
    points["f0"], points["f2"] = (0.1, 0.2, 0.5), (7, 8)
    rows = "\n".join(["0.1 0.2 0.5 0 0 0 0 7 8 0"] * 4)
    body = points.tobytes() if data == "binary" else rows.encode()
    read = decode_pcd(f"{head}WIDTH 2\nHEIGHT 2\nDATA {data}\n".encode() + body)
    np.testing.assert_allclose(read.points[1, 1], (100, 200, 500), rtol=1e-6)
    assert read.properties == {} and read.texture is None


def test_a_damaged_compression_is_refused():
    whole = (FOREIGN / "pcl_compressed.pcd").read_bytes()
    start = whole.index(b"DATA binary_compressed\n") + len(b"DATA binary_compressed\n") + 8
    for content in (whole[:start] + b"\x3f\xff" + whole[start + 2 :], whole[: start + 9]):
        with pytest.raises(ValueError, match=r"damaged|truncated"):
            decode_pcd(content)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (b"DATA binary\n", b"DATA binary_compressed\n", "truncated"),
        (b"DATA binary\n", b"DATA zip\n", "its data is 'zip': save it as binary"),
        (b"\nHEIGHT 24", b"\nHEIGHT 1", "are no grid"),
        (b"\nHEIGHT 24", b"\nHEIGHT 25", "truncated"),
        (b"\nHEIGHT 24", b"\nHEIGHT 999999999", "set COLORPHASE_MAX_PIXELS"),
        (b"\nHEIGHT 24", b"\nHEIGHT -4", "no HEIGHT"),
        (b"FIELDS x y z", b"FIELDS x y q", "no x, y and z"),
        (b"COUNT 1 1", b"COUNT 33 1", "no x, y and z"),
        (b"TYPE F F", b"TYPE F Q", "no known type"),
        (b"DATA binary\n", b"", "no end"),
    ],
)
def test_what_is_wrong_is_said(old, new, said):
    whole = encode_pcd(tilted_grid(), Heading("g", {}))[".pcd"]
    with pytest.raises(ValueError, match=said):
        decode_pcd(whole.replace(old, new, 1))
