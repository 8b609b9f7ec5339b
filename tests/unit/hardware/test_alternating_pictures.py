"""Two pictures that take turns, seen by the frames' brightness."""

import numpy as np
import pytest

from hardware.alternating_pictures import Alternation
from hardware.protocols import CameraFrame


def pictures(levels: list[float]) -> list[CameraFrame]:
    random = np.random.default_rng(2)
    return [
        CameraFrame(random.poisson(level, (64, 96, 3)).clip(0, 255).astype(np.uint8), 0.0, frame_id)
        for frame_id, level in enumerate(levels)
    ]


@pytest.mark.parametrize("light", [0.3, 0.5, 2.0])
def test_a_scene_that_changes_between_bursts_is_no_fault(light):
    """The object went away, or came near: both pictures change by the same factor."""
    alternation = Alternation()
    assert alternation.start(pictures([100, 85, 100, 85])) == []
    assert alternation.check(pictures([100 * light, 85 * light] * 3), 0) == []
    (fault,) = alternation.check(pictures([85 * light, 100 * light] * 3), 0)
    assert fault.pulse == 0 and "the picture before" in fault.reason


def test_black_frames_show_no_pictures():
    (fault,) = Alternation().start(pictures([0, 0, 0, 0]))
    assert "show no two pictures" in fault.reason
