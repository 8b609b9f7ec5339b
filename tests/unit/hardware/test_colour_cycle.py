"""Exposures against the projector's colour cycle: what is refused, what is named, and why that much."""

import re

import numpy as np
import pytest

from hardware.colour_cycle import TOLERANCE, check_exposure, phase_error_limit
from hardware.errors import RigError

CYCLES_S = (1 / 60, 1 / 59.94, 1 / 120, 1 / 240, 1 / 720, 0.0123456)


@pytest.mark.parametrize("cycle_s", CYCLES_S)
def test_whole_numbers_pass_and_others_do_not(cycle_s):
    for count in (1, 2, 3, 7, 50):
        for off in (-0.9, 0, 0.9):
            check_exposure(count * cycle_s * (1 + off * TOLERANCE), cycle_s)
        for off in (-1.1, 1.1):
            with pytest.raises(RigError):
                check_exposure(count * cycle_s * (1 + off * TOLERANCE), cycle_s)


@pytest.mark.parametrize("cycle_s", CYCLES_S)
@pytest.mark.parametrize("cycles", [0.01, 0.4, 0.6, 0.99, 1.01, 1.5, 2.2, 9.7, 100.45])
def test_the_nearest_good_ones_are_named_and_pass_as_they_are_typed(cycle_s, cycles):
    with pytest.raises(RigError) as fault:
        check_exposure(cycles * cycle_s, cycle_s)
    named = [float(text) for text in re.findall(r"([0-9.e-]+) s", str(fault.value).partition("exposure_s to")[2])]
    below = int(cycles)
    np.testing.assert_allclose(named, [n * cycle_s for n in (below, below + 1) if n > 0], rtol=1e-5)
    for exposure_s in named:
        check_exposure(exposure_s, cycle_s)
        # Cameras set whole microseconds, or rows of some 10 us; a cycle is rarely under 4 ms.
        if exposure_s > 4e-3:
            check_exposure(exposure_s + 8e-6, cycle_s)


def test_the_message():
    with pytest.raises(RigError) as fault:
        check_exposure(0.02, 1 / 60)
    assert str(fault.value) == (
        "an exposure of 0.02 s is 1.2 colour cycles of 0.0166667 s, and costs up to 0.8 rad: set exposure_s to "
        "0.0166667 s or 0.0333333 s"
    )


@pytest.mark.parametrize("contrast", [1.0, 0.6])
@pytest.mark.parametrize("share", [1 / 3, 0.2])
def test_the_limit_is_kept_and_reached(contrast, share):
    """Of the arctangent, whatever a colour's mirrors do in the part that is seen once too often."""
    deviation = 0.002
    phase = np.linspace(0, 2 * np.pi, 3601)[:, None]
    steps = np.array([-2, 0, 2]) * np.pi / 3
    straight = 0.5 + 0.5 * contrast * np.cos(phase + steps)
    rng = np.random.default_rng(0)
    limit = phase_error_limit(deviation, share, contrast)
    reached = 0.0
    for channel in range(3):
        for on in (np.ones(len(phase)), straight[:, channel], straight[:, channel] > 0.5, rng.random(len(phase))):
            exposed = straight.copy()
            exposed[:, channel] += deviation / share * on
            measured = np.angle(exposed @ np.exp(-1j * steps))
            error = np.abs(np.angle(np.exp(1j * (measured - phase[:, 0]))))
            assert error.max() <= 1.01 * limit  # the rest is of second order
            reached = max(reached, error.max())
    assert reached > 0.95 * limit


def test_the_tolerance_keeps_a_hundredth_of_a_radian():
    assert phase_error_limit(TOLERANCE) < 0.01
    assert abs((1 / 59.94) / (1 / 60) - 1) < TOLERANCE  # either of the two rates may be written for the other
