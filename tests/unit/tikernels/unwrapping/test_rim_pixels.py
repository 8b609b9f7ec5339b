"""Pixels at a rim that are another surface's are left out, and the last pixel of every surface, and no others."""

import numpy as np
import pytest

import tikernels
from tikernels import runtime
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.unwrapping.rim_pixels import leave_out_strangers

SHAPE = (60, 96)
RAYS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]


def surfaces() -> tuple[np.ndarray, np.ndarray]:
    """Return brightness and surfaces: a bright wall, a dim body before it, and nothing between them further down."""
    noise = 1 + 0.02 * np.random.default_rng(2).standard_normal(SHAPE)
    region = np.ones(SHAPE, np.int32)
    region[:, 48:] = 2
    region[40:, 44:52] = 0
    return (np.where(region == 2, 50, 80) * noise).astype(np.float32), region


def without_rims(region: np.ndarray) -> np.ndarray:
    """Return the surfaces without the pixels in which they end, in any of eight directions, for three pixels."""
    height, width = region.shape
    kept = region.copy()
    for y, x in np.argwhere(region > 0):
        for dy, dx in RAYS:
            beyond = [(y + far * dy, x + far * dx) for far in (1, 2, 3)]
            beyond = [region[p] for p in beyond if 0 <= p[0] < height and 0 <= p[1] < width]
            if beyond and all(number != region[y, x] for number in beyond):
                kept[y, x] = 0
    return kept


def left(brightness: np.ndarray, region: np.ndarray, phase: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """Return the unwrapped phase, the mask and the surfaces that are left."""
    unwrapped = np.where(region > 0, np.float32(1), np.float32(np.nan))
    out = (unwrapped, (region > 0).astype(np.uint8), region.copy())
    phase = np.zeros(SHAPE, np.float32) if phase is None else phase
    leave_out_strangers(brightness, brightness, phase, out)
    return tuple(runtime.to_host(part) for part in out)


def cut_off(brightness: np.ndarray, region: np.ndarray, y: int, x: int) -> bool:
    """Return what the rule says of one pixel, with light everywhere."""
    met = []
    for dy, dx in RAYS:
        at = [(y + far * dy, x + far * dx) for far in range(0, 25, 2)]
        inside = [0 <= row < SHAPE[0] and 0 <= column < SHAPE[1] for row, column in at]
        meets = "nothing"
        for k in range(1, len(at)):
            if not inside[k]:
                meets = "end"
            elif region[at[k]] != region[y, x]:
                places = [(at[k][0] + gap * dy, at[k][1] + gap * dx) for gap in range(-1, 3)]
                places = [p for p in places if 0 <= p[0] < SHAPE[0] and 0 <= p[1] < SHAPE[1]]
                light = any(region[p] != region[y, x] and brightness[p] > 0.5 * brightness[y, x] for p in places)
                behind = [(at[k][0] + gap * dy, at[k][1] + gap * dx) for gap in range(4)]
                behind = [p for p in behind if 0 <= p[0] < SHAPE[0] and 0 <= p[1] < SHAPE[1]]
                light = light and all(region[p] != region[y, x] for p in behind)
                meets = "other" if 2 * k <= 12 and light else "end"
            elif k > 1:
                ends = brightness[at[k - 2]], brightness[at[k]]
                meets = "edge" if max(ends) > 1.4 * min(ends) else meets
            if meets != "nothing":
                break
        met.append(meets)
    return "nothing" not in met and "edge" in met and "other" in met


def test_a_surface_keeps_its_own(arch):
    brightness, region = surfaces()
    unwrapped, mask, kept = left(brightness, region)
    np.testing.assert_array_equal(kept, without_rims(region))
    np.testing.assert_array_equal(mask, kept > 0)
    np.testing.assert_array_equal(np.isfinite(unwrapped), kept > 0)


def test_a_corner_that_the_wrong_side_has_claimed_is_left_out(arch):
    """A corner of the body in the wall's surface, but for the two px that lie on the edge of brightness themselves."""
    brightness, region = surfaces()
    claimed = region.copy()
    claimed[10:22, 48:60] = 1
    unwrapped, mask, kept = left(brightness, claimed)
    assert (kept[10:22, 50:60] == 0).all() and (mask[10:22, 50:60] == 0).all()
    assert np.isnan(unwrapped[10:22, 50:60]).all()
    claimed[10:22, 50:60] = 0
    on_edge = np.zeros(SHAPE, np.bool_)
    on_edge[10:22, 47:50] = True
    np.testing.assert_array_equal(np.where(on_edge, 0, kept), np.where(on_edge, 0, without_rims(claimed)))


def test_the_rule_is_that_of_eight_rays(arch):
    brightness, region = surfaces()
    claimed = region.copy()
    claimed[10:22, 48:60] = 1
    claimed[30:36, 40:48] = 2
    expected = claimed.copy()
    for y, x in np.argwhere(claimed > 0):
        if cut_off(brightness, claimed, y, x):
            expected[y, x] = 0
    assert (expected != claimed).sum() > 100
    np.testing.assert_array_equal(left(brightness, claimed)[2], without_rims(expected))


def test_a_shadow_is_no_stranger_where_its_surface_goes_on(arch):
    """Dim, and far from any other surface; along its border with one; and where nothing but darkness is beside it."""
    brightness, region = (np.repeat(part[:1], SHAPE[0], axis=0) for part in surfaces())
    brightness[20:30, 10:20] *= 0.3
    brightness[:, 44:48] *= 0.5
    np.testing.assert_array_equal(left(brightness, region)[2], without_rims(region))
    alone = np.where(region == 2, 0, region)
    brightness[10:22, 36:48] *= 0.6
    dark = np.where(alone > 0, np.float32(0), np.float32(NO_PHASE))
    np.testing.assert_array_equal(left(brightness, alone, dark)[2], without_rims(alone))
    assert (left(brightness, alone)[2] != without_rims(alone)).sum() > 50


@pytest.mark.parametrize(("edge_px", "stays"), [(1, True), (6, False)])
def test_a_print_edge_is_no_other_surface(arch, edge_px, stays):
    """Checks of two paints, between which some pixels are of no surface."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    inside = ((y - 8) % 20 >= edge_px) & ((x - 8) % 20 >= edge_px)
    brightness = np.where(((y + 12) // 20 + (x + 12) // 20) % 2 == 0, np.float32(80), np.float32(50))
    brightness[:, ::3] *= 0.5  # print inside the checks
    region = inside.astype(np.int32)
    cut = (left(brightness, region)[2] != without_rims(region)).sum()
    assert cut < 0.01 * region.sum() if stays else cut > 0.5 * region.sum()


def test_the_last_pixel_of_a_surface_goes(arch):
    """Whatever its shape, and not where the image ends."""
    region = np.zeros(SHAPE, np.int32)
    region[10:40, :60] = 1
    region[20:22, 60:70] = 1
    region[9, 30] = 1
    region[30, 20] = 0
    region[50:53, 20:23] = 2
    kept = left(np.full(SHAPE, 50, np.float32), region)[2]
    np.testing.assert_array_equal(kept, without_rims(region))
    assert kept[20, 0] == 1 and kept[51, 21] == 2 and not kept[20:22, 60:].any()
    assert (kept[29:32, 19:22] == region[29:32, 19:22]).all()  # a hole is no end


def test_other_shapes_are_refused(cpu):
    brightness, region = surfaces()
    out = (np.zeros(SHAPE, np.float32), np.ones(SHAPE, np.uint8), region)
    with pytest.raises(tikernels.ShapeError, match="mask has shape"):
        leave_out_strangers(brightness, brightness, brightness, (out[0], out[1][1:], out[2]))
    with pytest.raises(tikernels.ShapeError, match="region"):
        leave_out_strangers(brightness, brightness, brightness, (out[0], out[1], region.astype(np.int64)))
    with pytest.raises(tikernels.ShapeError, match="phase"):
        leave_out_strangers(brightness, brightness, brightness[1:], out)
