"""What a frame tells before its surfaces are known."""

import numpy as np
import pytest
from support.colored_boards import MATRIX, PAINTS, PERIOD_PX, board, surface_matrix

from pipeline.decoding.first_look import FirstLook
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.phase_vector import phase_weights
from tikernels.phase.surface_colors import color_ratios
from tikernels.phase.surfaces import NO_SURFACE

LEVELS = FrameLevels(255.0, 1.0, 0.0, 1.0, 5.0, 5.0)


def look_at(image: np.ndarray) -> FirstLook:
    crosstalk = Crosstalk.of(MATRIX)
    gains = Gains(*image.shape[:2], PERIOD_PX)
    gains.measure(image, crosstalk, LEVELS)
    model = ChannelModel(gains)
    model.recover(crosstalk, LEVELS)
    return FirstLook(image, model, crosstalk, LEVELS)


def test_nodes_have_the_paints_colours(arch):
    image, _, numbers = board(["orange", "blue"], (120, 160), gamma=1.0)
    look = look_at(image)
    assert look.lit.all()
    colors = look.common_colors()
    seen = np.array([240 * 0.5 + 6, 4]) @ np.stack([np.ones(3), np.zeros(3)])
    expected = color_ratios([seen * surface_matrix(PAINTS[paint]).sum(axis=1) + 4 for paint in ("orange", "blue")])
    expected -= color_ratios(MATRIX.sum(axis=1))  # of a grey surface, too, channels differ
    found = colors - color_ratios(MATRIX.sum(axis=1))
    order = [int(np.abs(found - own).max(axis=1).argmin()) for own in expected]
    assert sorted(order) == [0, 1]
    np.testing.assert_allclose(found[order], expected, atol=0.08)
    labels = look.labels(colors)
    assert np.mean(labels == np.array(order)[numbers[::2, 4::8]]) > 0.9


@pytest.mark.parametrize("gamma", [1.0, 2.0])
def test_ambient_light_is_what_the_modulation_does_not_follow(cpu, gamma):
    """Where the projector's light falls off, the fringe fades and the ambient light stays."""
    image, _, _ = board(["white"], (180, 240), gamma=gamma)
    ambient = 6 * surface_matrix(PAINTS["white"]).sum(axis=1) + 4
    shade = np.linspace(1, 0.3, 240)[:, None]
    look = look_at((ambient + (image - ambient) * shade).astype(np.float32))
    assert look.ambient == pytest.approx(ambient.mean(), rel=0.25)
    assert look_at(image).ambient == 0  # without shading nothing tells


def test_where_the_fringe_is_finer_blur_leaves_less_of_it(cpu):
    """Half of the plane turns away: 9 px a cycle instead of 12.3; of the fundamental v / 2 times the slope squared."""
    image, _, _ = board(["white"], (240, 320), gamma=1.0, noise=0.2)
    y = np.arange(240)[:, None]
    phase = np.where(np.arange(320) < 200, 2 * np.pi * y / PERIOD_PX, 2 * np.pi * y / 9.0)
    sent = 0.5 + 0.5 * np.cos(phase[..., None] + np.array([-1, 0, 1]) * 2 * np.pi / 3)
    image = (240 * sent @ surface_matrix(PAINTS["white"]).T + 10).astype(np.float32)
    look = look_at(image)
    usual, fine = look.contrast[8:-8, 5:20], look.contrast[8:-8, -10:-3]
    expected = np.exp(-((2 * np.pi / 9.0) ** 2 - (2 * np.pi / PERIOD_PX) ** 2) / 6)
    assert np.median(usual) == pytest.approx(1, abs=0.005)
    assert np.median(fine) == pytest.approx(expected, abs=0.01)
    np.testing.assert_allclose(look.lattice.contrast[20:-20, 5:20], 1, atol=0.05)


def test_shadow_and_darkness_are_unlit(cpu):
    image, _, _ = board(["white"], (120, 160))
    image[40:80, 60:100] = 30  # light without a fringe
    image[90:110, 20:60] = 2
    unlit = look_at(image).unlit
    assert unlit[46:74, 62:98].all()
    assert unlit[91:109, 21:59].all()
    assert unlit[:30].mean() < 0.001
    assert (look_at(image).labels(np.zeros((1, 3)))[23:37, 8:12] == NO_SURFACE).all()


def test_samples_of_a_surface_have_its_phases(cpu):
    """Means over pixels along a row, along which the phase changes: by 0.02 rad a px."""
    image, phase, _ = board(["blue"], (120, 160), noise=0.0, gamma=1.0)
    look = look_at(image)
    lattice, matrix = look.lattice, surface_matrix(PAINTS["blue"])
    true = phase[:: lattice.rows, lattice.columns // 2 :: lattice.columns].reshape(1, -1)
    light = lattice.light.reshape(1, -1, 3).swapaxes(1, 2).astype(float)
    weights, ambient = phase_weights(np.linalg.inv(matrix)), 6 * matrix.sum(axis=1) + 4
    samples = look.surface_samples(
        light, look.around.reshape(1, -1), np.ones(true.shape), weights[None], ambient[None], np.ones(1), 0.0
    )
    assert np.abs(np.angle(np.exp(1j * (samples.phase - true)))).max() < 1e-3
    assert (samples.variance >= 1).all()


def test_clipped_places_say_nothing(cpu):
    image, _, _ = board(["white"], (120, 160))
    image[40:60, 80:100] = 255
    lattice = look_at(image).lattice
    assert not lattice.says[21:29, 10:12].any()
    assert lattice.says[:, :9].all()


def test_some_samples_come_from_all_columns(cpu):
    image, _, _ = board(["white"], (480, 640), noise=0.0)
    image[:, 320:] *= 0.5
    some = look_at(image).some_samples()
    assert 2000 < len(some) < 4000
    assert 0.35 < np.mean(some.max(axis=1) < 0.5 * some.max()) < 0.75
