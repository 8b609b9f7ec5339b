"""How much brighter white is than the mean of a cycle."""

import numpy as np
import pytest

from tikernels.phase.channel_template import flat_template
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.projector_response import ResponsePrior
from tikernels.phase.white_level import white_level

LEAKS = np.array([[0.9, 0.08, 0.02], [0.1, 0.75, 0.15], [0.02, 0.18, 0.8]])


@pytest.mark.parametrize(
    ("gamma", "expected"),
    # 1 / mean of cos(psi / 2)^(2 gamma): 2, 8/3; four harmonics make 2.9 of gamma 2.4 without 1 %.
    [(1.0, 2.0), (2.0, 8 / 3)],
)
@pytest.mark.parametrize("lag", [None, np.array([0.2, 0.0, -0.1])])
def test_white_is_where_the_fringe_is_brightest(cpu, gamma, expected, lag):
    """And the same in every channel, whatever leaks: its rows sum to one."""
    response = np.broadcast_to(np.linspace(0, 1, 1025) ** gamma, (3, 1025))
    crosstalk = Crosstalk.of(LEAKS, lag=lag)
    template = ResponsePrior(response, lag).template(crosstalk.matrix, 0.0)
    np.testing.assert_allclose(white_level(template, crosstalk), expected, rtol=1e-3)


def test_without_a_fringe_white_is_the_mean(cpu):
    np.testing.assert_allclose(white_level(flat_template(), Crosstalk.of(np.eye(3))), 1.0, rtol=1e-6)
