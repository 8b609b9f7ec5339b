"""Surfaces of several colours come out as if they were white: what is one, what is new, and what stays in a video."""

import numpy as np
import pytest
from support.colored_boards import (
    MATRIX,
    PAINTS,
    PERIOD_PX,
    RESPONSE,
    band_matrix,
    board,
    board_decoder,
    light,
    paint_errors,
    surface_matrix,
)

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration
from pipeline.decoding import surface_search
from pipeline.decoding.frame import memory_of
from pipeline.errors import DecodeWarning
from tikernels.phase.surfaces import NO_SURFACE

PAINTED = ["white", "orange", "blue", "skin"]


def test_shadow_shows_no_surface(cpu):
    image, _, _ = board(PAINTED, (240, 320))
    ambient = 6 * surface_matrix(PAINTS["white"]).sum(axis=1) + 4
    image[100:160, 100:220] = ambient + np.random.default_rng(1).standard_normal((60, 120, 3))
    frame = board_decoder().decode(image)
    assert frame.mask[106:154, 106:214].mean() < 0.02
    assert (
        np.asarray(memory_of(frame).surfaces.crosstalk.surfaces.labels)[106:154, 106:214] == NO_SURFACE
    ).mean() > 0.98


@pytest.mark.parametrize("cycles", [2.2, 3.0, 5.0])
@pytest.mark.parametrize("noise", [0.3, 1.0])
def test_a_fine_print_shows_its_paints(cpu, cycles, noise):
    """Squares of two paints, some cycles wide: places that see both are no third one."""
    image, phase, numbers = board(["orange", "blue"], (240, 320), noise=noise, square_px=cycles * PERIOD_PX)
    frame = board_decoder().decode(image)
    constants, rms = paint_errors(frame, phase, numbers)
    assert np.abs(constants).max() < 0.01
    assert rms.max() < 0.03
    assert frame.mask.mean() > 0.94


def test_a_video_keeps_its_surfaces(cpu):
    """The next frame begins with the matrices of the one before, and a new paint is found when it comes in."""
    first, phase, numbers = board(PAINTED[:3], (240, 320))
    rig = board_decoder()
    before = rig.decode(first)
    again = rig.decode(first, previous=before)
    kept = memory_of(again).surfaces.fitted.matrices
    np.testing.assert_allclose(kept, memory_of(before).surfaces.fitted.matrices, atol=2e-3)
    assert (memory_of(again).surfaces.fitted.frames == 2).all()
    constants, _ = paint_errors(again, phase, numbers)
    assert np.ptp(constants) < 0.02
    then, phase, numbers = board([*PAINTED[:2], "skin", "blue"], (240, 320))
    after = rig.decode(then, previous=again)
    assert len(memory_of(after).surfaces.fitted.matrices) > len(kept)
    constants, _ = paint_errors(after, phase, numbers)
    assert np.ptp(constants) < 0.03


def test_a_paint_of_nearly_the_same_colour_is_found_by_what_is_left_over(cpu):
    """A patch that has the wall's colour, but acts elsewhere on the light, as another pigment does."""
    image, phase, numbers = board(["skin"], (240, 320))
    patch = np.zeros(numbers.shape, bool)
    patch[60:180, 100:220] = True
    wall = surface_matrix(PAINTS["skin"])
    other = surface_matrix(PAINTS["skin"], 0.9)
    other *= (wall.sum(axis=1) / other.sum(axis=1))[:, None]
    noise = np.random.default_rng(2).standard_normal(image.shape)
    image[patch] = (240 * light(phase) @ other.T + 6 * other.sum(axis=1) + 4 + noise)[patch]
    frame = board_decoder().decode(image)
    labels = np.asarray(memory_of(frame).surfaces.crosstalk.surfaces.labels)
    inside, outside = labels[70:170, 110:210], labels[:50]
    assert np.bincount(inside.ravel()).argmax() != np.bincount(outside.ravel()).argmax()
    constants, _ = paint_errors(frame, phase, patch.astype(int))
    assert np.abs(constants).max() < 0.03


def test_a_wrong_calibration_is_left_to_the_balance(cpu):
    """Surfaces cannot make good what is wrong everywhere: the frame's own waves do, and the warning says so."""
    image, phase, numbers = board(PAINTED, (240, 320))
    wrong = Calibration(crosstalk_matrix=np.eye(3), response=RESPONSE)
    with pytest.warns(DecodeWarning, match="fringes differ by .* calibrate check"):
        frame = Decoder(DecodeSettings(white_level=255), wrong, arch="cpu").decode(image)
    assert memory_of(frame).surfaces is None
    constants, _ = paint_errors(frame, phase, numbers)
    assert np.abs(constants).max() < 3 * frame.constant_sigma


def test_light_that_no_matrix_explains_is_said(cpu):
    """Half of each frame's light is another fringe, as from a mirror: no matrix makes that of one phase."""
    image, phase, _ = board(["skin"], (240, 320), noise=0.5)
    other = light(2.2 * phase + 1.0) @ surface_matrix(PAINTS["orange"]).T
    frame_image = np.clip(0.6 * image + 120 * other, 0, 255).astype(np.float32)
    with pytest.warns(DecodeWarning, match="no matrix explains"):
        frame = board_decoder().decode(frame_image)
    assert memory_of(frame).surfaces is None
    assert frame.constant_sigma > 0.03


def test_a_fluorescent_paint_is_said(cpu):
    """It sends blue back as green and red, which no reflectance does: half of the board, off by 0.07 rad."""
    matrices = [surface_matrix(PAINTS[paint]) for paint in ("white", "skin")]
    matrices[1][:2, 2] += 0.1, 0.16
    image, phase, numbers = board(["white", "skin"], (240, 320), matrices=matrices)
    with pytest.warns(DecodeWarning, match="no matrix explains the colours of (4.|50)% of the surface"):
        frame = board_decoder().decode(image)
    constants, rms = paint_errors(frame, phase, numbers)
    assert np.abs(constants).max() < 2 * frame.constant_sigma
    assert rms[1] < 1.5 * np.nanmedian(frame.phase_sigma[numbers == 1])
    assert memory_of(frame).surfaces is not None


@pytest.mark.parametrize("response", [True, False])
def test_a_flat_board_of_four_colours_is_flat(arch, response):
    """Steps of 0.15 rad if the colours are taken to act after the crosstalk; 0.015 at most as they are found."""
    image, phase, numbers = board(PAINTED, (240, 320))
    constants, rms = paint_errors(board_decoder(response=response, arch=arch).decode(image), phase, numbers)
    assert np.ptp(constants) < 0.015
    assert (rms < [0.015, 0.06, 0.06, 0.03]).all()
    plain, rough = paint_errors(
        board_decoder(response=response, arch=arch, reflectance_bands="broad").decode(image), phase, numbers
    )
    assert np.ptp(plain) > 0.06
    assert (rough[1:] > 1.5 * rms[1:]).all()


def test_the_constant_is_covered_by_what_is_said_of_it(cpu):
    image, phase, numbers = board(PAINTED, (240, 320))
    frame = board_decoder().decode(image)
    constants, _ = paint_errors(frame, phase, numbers)
    assert np.abs(constants).max() < 2.5 * frame.constant_sigma < 0.1


def test_neutral_paint_costs_nothing(cpu):
    """A grey board is decoded as if no surfaces were looked for."""
    image, _, _ = board(["white"])
    found, broad = (board_decoder(reflectance_bands=bands).decode(image) for bands in (None, "broad"))
    np.testing.assert_array_equal(found.wrapped_phase, broad.wrapped_phase)
    assert memory_of(found).surfaces is None


def test_a_colour_that_acts_after_the_crosstalk_stays_so(cpu):
    image, _, _ = board(["skin"], broad=1.0)
    found, broad = (board_decoder(reflectance_bands=bands).decode(image) for bands in (None, "broad"))
    np.testing.assert_array_equal(found.wrapped_phase, broad.wrapped_phase)


def test_in_a_video_an_only_colour_is_asked_once(cpu, monkeypatch):
    """Until it changes, or another one joins it."""
    image, _, _ = board(["skin"], broad=1.0)
    asked, acts_after = [], surface_search._acts_after
    monkeypatch.setattr(surface_search, "_acts_after", lambda *of: asked.append(1) or acts_after(*of))
    decoder = board_decoder(code="none")  # nor is a code looked for in the first frame
    first = decoder.decode(image)
    second = decoder.decode(image, previous=first)
    assert len(asked) == 1
    np.testing.assert_array_equal(memory_of(second).surfaces.ratios, memory_of(first).surfaces.ratios)
    other, _, _ = board(["orange"], broad=1.0)
    third = decoder.decode(other, previous=second)
    assert len(asked) == 2
    broad = board_decoder(reflectance_bands="broad")
    np.testing.assert_array_equal(second.wrapped_phase, broad.decode(image, previous=broad.decode(image)).wrapped_phase)
    assert np.abs(memory_of(third).surfaces.ratios - memory_of(second).surfaces.ratios).max() > 0.1


def test_one_colour_alone_is_told_by_what_is_left_over(cpu):
    image, phase, numbers = board(["skin"])
    constants, rms = paint_errors(board_decoder().decode(image), phase, numbers)
    assert abs(constants[0]) < 0.012
    assert rms[0] < 0.03


def test_known_wavelengths_take_the_place_of_what_is_usual(cpu):
    """Where a rig's filters and primaries meet elsewhere than usual, colours that were 0.03 rad apart come out flat."""
    nm = np.array([[625.0, 600, 462], [622, 536, 430], [660, 480, 462]])
    painted = [band_matrix(PAINTS[name], nm) for name in PAINTED]
    image, phase, numbers = board(PAINTED, (240, 320), matrices=painted)
    steps = []
    for known in (None, nm):
        rig = Calibration(crosstalk_matrix=MATRIX, response=RESPONSE, wavelengths_nm=known)
        frame = Decoder(DecodeSettings(white_level=255), rig, arch="cpu").decode(image)
        steps.append(np.ptp(paint_errors(frame, phase, numbers)[0]))
    assert steps[1] < 0.012
    assert steps[1] < 0.6 * steps[0]
