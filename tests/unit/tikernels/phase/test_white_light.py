"""What pixels show under white: by the equations, and whatever phase and contrast are off by."""

import numpy as np
import pytest
import reference

from tikernels import ShapeError, runtime
from tikernels.phase.channel_template import HARMONICS
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.projector_response import ResponsePrior
from tikernels.phase.surfaces import Surfaces
from tikernels.phase.white_level import white_level
from tikernels.phase.white_light import FrameLight, light_by_white

MATRIX = np.array([[0.9, 0.08, 0.02], [0.1, 0.75, 0.15], [0.02, 0.18, 0.8]])
PAINT = np.array([[0.9, 0.02, 0.0], [0.05, 0.6, 0.05], [0.0, 0.1, 0.5]])
COLOR, AMBIENT, BESIDES = np.array([1.2, 1.0, 0.8]), np.array([3.0, 2.0, 4.0]), np.array([1.0, 0.0, 2.0])
PERIOD_PX, SPACING_PX = 12.0, 8
SHAPE = (64, 90)


def phases(shape=SHAPE):
    y, x = np.indices(shape)
    return 2 * np.pi * y / PERIOD_PX + 0.01 * x + 50.0


def cycle_at(template, phase):
    """Return a template's three channels at a phase and their derivative, (H, W, 3)."""
    n = np.arange(1, HARMONICS + 1)
    angles = phase[..., None] * n
    cosines, sines = template[:, 1 : 1 + HARMONICS].astype(np.float64), template[:, 1 + HARMONICS :].astype(np.float64)
    cycle = 1 + np.cos(angles) @ cosines.T + np.sin(angles) @ sines.T
    return cycle, (np.cos(angles) * n) @ sines.T - (np.sin(angles) * n) @ cosines.T


def frame(shape=SHAPE, *, mixed=False, step_rad=0.0, contrast=0.0, noise=0.0, clipped=1e6, texture=0.2):
    """Return a frame's light, its brightness, and what is to be seen under white."""
    surfaces = Surfaces.of(PAINT, None, BESIDES[None]) if mixed else None
    crosstalk = Crosstalk.of(MATRIX, surfaces=surfaces)
    response = np.broadcast_to(np.linspace(0, 1, 1025) ** 2, (3, 1025))
    template = ResponsePrior(response, None).template(crosstalk.matrix, 0.05)
    rng = np.random.default_rng(3)
    brightness = 60 * np.exp(texture * rng.standard_normal(shape))
    mixing, rest = (PAINT, PAINT @ AMBIENT + BESIDES) if mixed else (np.eye(3), AMBIENT)
    cycle, slope = cycle_at(template, phases(shape))
    shown = cycle + step_rad * slope + contrast * (cycle - 1)
    image = brightness[..., None] * (COLOR * shown @ mixing.T) + rest + noise * rng.standard_normal((*shape, 3))
    grid = tuple(-(-length // SPACING_PX) for length in shape)
    nodes = np.broadcast_to(np.concatenate([COLOR, AMBIENT]), (*grid, 6)).astype(np.float32)
    light = FrameLight(
        image=image.astype(np.float32),
        white=255.0,
        clipped=clipped,
        nodes=nodes.copy(),
        sharpness=np.zeros(grid, np.float32),
        spacing_px=SPACING_PX,
        template=template,
        crosstalk=crosstalk,
        neutral=np.ones(3, np.float32),
        coded=False,
    )
    white = white_level(template, crosstalk).astype(np.float64)
    under_white = brightness[..., None] * (COLOR * (white + contrast * (white - 1)) @ mixing.T) + rest
    return light, under_white


def found(light, mask=None):
    shape = light.image.shape[:2]
    mask = np.ones(shape, np.uint8) if mask is None else mask
    results = light_by_white(light, phases(shape).astype(np.float32), mask, PERIOD_PX)
    return [runtime.to_host(result) for result in results]


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("shape", [SHAPE, (41, 67), (9, 16)])
def test_as_the_twin(arch, shape, mixed):
    light, _ = frame(shape, mixed=mixed, noise=1.0)
    mask = (np.random.default_rng(4).random(shape) > 0.1).astype(np.uint8)
    cycle, slope = cycle_at(light.template, phases(shape))
    mixing, besides = (PAINT, BESIDES) if mixed else (np.eye(3), np.zeros(3))
    model = {"A": COLOR, "B": np.broadcast_to(AMBIENT, (*shape, 3)), "T": mixing, "besides": besides}
    model |= {"cycle": cycle, "slope": slope, "window": (0.25 * PERIOD_PX, 0.4 * PERIOD_PX)}
    white = white_level(light.template, light.crosstalk)
    expected = reference.light_by_white(light.image.astype(np.float64), phases(shape), mask, white, model)
    shown, brightness, _ = found(light, mask)
    # Where brightness and phase are told by hardly any light float32 is right to 0.1 level.
    np.testing.assert_allclose(shown, expected, rtol=2e-3, atol=0.1)
    np.testing.assert_allclose(brightness, shown.sum(axis=-1), rtol=1e-5)


@pytest.mark.parametrize("mixed", [False, True])
def test_neither_a_wrong_phase_nor_a_contrast_leaves_a_stripe(arch, mixed):
    """0.02 rad, and a tenth of the contrast: 1e-3 of the light is left, and 0.02 rad make 0.03 in a channel."""
    light, under_white = frame(mixed=mixed, step_rad=0.02, contrast=-0.1)
    shown, _, _ = found(light)
    inside = (slice(12, -12), slice(16, -16))
    np.testing.assert_allclose(shown[inside], under_white[inside], rtol=2e-3)


def test_a_clipped_channel_is_told_by_the_pixels_around(arch):
    """Otherwise the brightest places of the fringe would be darker by a tenth."""
    light, under_white = frame(texture=0.0, clipped=130.0)
    seen = np.minimum(light.image, 130.0)
    clipped = (seen == 130.0).sum(axis=-1)
    assert (clipped == 1).sum() > 100
    light.image[...] = seen
    shown = found(light)[0]
    np.testing.assert_allclose(shown[clipped == 1], under_white[clipped == 1], rtol=0.01)


def test_nothing_is_shown_off_the_mask(arch):
    light, _ = frame()
    light.image[20:30] = np.nan
    mask = np.ones(SHAPE, np.uint8)
    mask[20:30] = 0
    shown, brightness, _ = found(light, mask)
    assert not shown[20:30].any() and not brightness[20:30].any()
    assert np.isfinite(shown).all() and shown[:20].all()


def test_arguments_are_checked(arch):
    light, _ = frame()
    mask = np.ones(SHAPE, np.uint8)
    with pytest.raises(ShapeError, match="phase has shape"):
        light_by_white(light, np.zeros((3, 4), np.float32), mask, PERIOD_PX)
    with pytest.raises(ShapeError, match="mask has shape"):
        light_by_white(light, np.zeros(SHAPE, np.float32), mask[1:], PERIOD_PX)
