"""Range images as pictures: colours, scale and shading."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pipeline.output.pictures.picture_overlay import ColorScale
from pipeline.output.range_image import depth_colors, shade_range, write_range_image

GREY = 48


def colored(values: np.ndarray, mask: np.ndarray) -> np.ndarray:
    return depth_colors(values, mask, ColorScale.over(values[mask & np.isfinite(values)], "", ""))


def read_png(path: Path) -> np.ndarray:
    return cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def dome(size: int = 200) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the depth in mm, the mask and the points of a 70 mm half ball on a wall, seen from far away."""
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    inside = np.hypot(x, y) < 70
    depth = np.where(inside, 500 - np.sqrt(np.maximum(70**2 - x**2 - y**2, 0)), 600).astype(np.float32)
    mask = np.ones(depth.shape, bool)
    mask[:10] = False
    depth[~mask] = np.nan
    return depth, mask, np.stack([x, y, depth], axis=-1).astype(np.float32)


@pytest.mark.parametrize("unit", ["mm", "rad"])
def test_range_image_shows_values_and_scale(tmp_path: Path, unit: Any) -> None:
    depth, mask, _ = dome()
    path = tmp_path / "Körper.png"
    write_range_image(path, depth, mask, unit)
    picture = read_png(path)
    assert picture.shape[0] == 200
    assert picture.shape[1] > 250
    assert (picture[:10, :200] == GREY).all()
    near, rim, far = (picture[100, x].astype(int) for x in (100, 33, 5))
    assert near[2] > near[0] + 50, "near is blue"
    if unit == "mm":
        assert rim[0] > rim[2] + 50, "the object's far rim is red"
        assert np.ptp(far) == 0, "the wall behind it has no colour"
    else:
        np.testing.assert_array_equal(picture[:, :200], colored(depth, mask))
        assert far[0] > far[2] + 50, "far is red"
    assert (picture[:, 200:] > 200).all(axis=-1).sum() > 30, "numbers in white"


def test_outliers_do_not_take_the_colors() -> None:
    values = np.linspace(0, 1, 10_000, dtype=np.float32).reshape(100, 100)
    spiked = values.copy()
    spiked[0, 0], spiked[-1, -1] = -1e6, np.inf
    usual, whole = colored(values, values >= 0), np.ones((100, 100), bool)
    # Two of 10,000 pixels move the limits by a level of the map at most.
    np.testing.assert_allclose(colored(spiked, whole)[1:-1].astype(float), usual[1:-1], atol=6)


@pytest.mark.parametrize("shape", [(1, 7), (9, 1), (480, 640)])
def test_all_masked_pictures_are_grey(tmp_path: Path, shape: tuple[int, int]) -> None:
    nothing, mask = np.full(shape, np.nan, np.float32), np.zeros(shape, bool)
    write_range_image(tmp_path / "range.png", nothing, mask, "mm")
    assert (read_png(tmp_path / "range.png") == GREY).all()
    assert (shade_range(nothing, mask) == GREY).all()
    assert shade_range(nothing, mask, np.full((*shape, 3), np.nan, np.float32)).shape == (*shape, 3)


def test_a_constant_range_has_one_color(tmp_path: Path) -> None:
    flat, mask = np.full((30, 40), 812.5, np.float32), np.ones((30, 40), bool)
    assert len(np.unique(colored(flat, mask).reshape(-1, 3), axis=0)) == 1
    assert len(np.unique(shade_range(flat, mask).reshape(-1, 3), axis=0)) == 1
    write_range_image(tmp_path / "range.png", flat, mask, "mm")


@pytest.mark.parametrize("true_normals", [False, True])
def test_a_dome_is_lit_from_the_upper_left(true_normals: bool) -> None:
    depth, mask, points = dome()
    picture = shade_range(depth, mask, points if true_normals else None)
    assert picture.shape == (200, 200, 3)
    assert (picture[:10] == GREY).all()
    upper_left, middle, lower_right = (int(picture[at, at, 0]) for at in (75, 100, 140))
    assert upper_left > middle > lower_right
    # The wall is flat right up to the step that the dome casts on it, and to the mask.
    wall = picture[mask & (depth == 600)]
    assert np.ptp(wall.astype(int), axis=0).max() <= 2


def test_shading_does_not_depend_on_the_unit() -> None:
    depth, mask, _ = dome()
    first, second = (shade_range((depth * unit).astype(np.float32), mask).astype(int) for unit in (0.005, 0.0025))
    assert abs(first - second).max() <= 2


def test_shading_shows_the_surface_and_not_its_noise() -> None:
    """A plane under noise of half a pixel's width is shaded evenly, to 8 levels."""
    depth = np.random.default_rng(1).normal(600, 0.5, (100, 100)).astype(np.float32)
    y, x = np.mgrid[:100, :100].astype(np.float32)
    picture = shade_range(depth, np.ones((100, 100), bool), np.stack([x, y, depth], axis=-1))
    assert picture[10:-10, 10:-10, 0].std() < 8
