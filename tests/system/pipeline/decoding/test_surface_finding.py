"""Surfaces of several colours come out as if they were white."""

import numpy as np
import pytest
from support.colored_boards import MATRIX, PAINTS, RESPONSE, band_matrix, board, board_decoder, paint_errors

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration
from pipeline.decoding.surface_finding import SurfaceFinder

PAINTED = ["white", "orange", "blue", "skin"]


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
    assert found.memory.surfaces is None


def test_a_colour_that_acts_after_the_crosstalk_stays_so(cpu):
    image, _, _ = board(["skin"], broad=1.0)
    found, broad = (board_decoder(reflectance_bands=bands).decode(image) for bands in (None, "broad"))
    np.testing.assert_array_equal(found.wrapped_phase, broad.wrapped_phase)


def test_in_a_video_an_only_colour_is_asked_once(cpu, monkeypatch):
    """Until it changes, or another one joins it."""
    image, _, _ = board(["skin"], broad=1.0)
    asked, acts_after = [], SurfaceFinder._acts_after
    monkeypatch.setattr(SurfaceFinder, "_acts_after", lambda *of: asked.append(1) or acts_after(*of))
    decoder = board_decoder(code="none")  # nor is a code looked for in the first frame
    first = decoder.decode(image)
    second = decoder.decode(image, previous=first)
    assert len(asked) == 1
    np.testing.assert_array_equal(second.memory.surfaces.ratios, first.memory.surfaces.ratios)
    other, _, _ = board(["orange"], broad=1.0)
    third = decoder.decode(other, previous=second)
    assert len(asked) == 2
    broad = board_decoder(reflectance_bands="broad")
    np.testing.assert_array_equal(second.wrapped_phase, broad.decode(image, previous=broad.decode(image)).wrapped_phase)
    assert np.abs(third.memory.surfaces.ratios - second.memory.surfaces.ratios).max() > 0.1


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
