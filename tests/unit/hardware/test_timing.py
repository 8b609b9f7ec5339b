"""What can never make whole bursts is refused, with a value that would do."""

import pytest
from support.faulty_rigs import Bench, settings

from hardware.errors import RigError
from hardware.pulses import Pulse, PulseTrain
from hardware.timing import train_of


def test_the_burst_that_a_rigs_file_asks_for():
    asked = settings(frames=7, camera_delay_s=3e-4, projector_width_s=2e-4)
    assert train_of(asked) == PulseTrain(6e-3, 7, Pulse(0.0, 2e-4), Pulse(3e-4, 1e-4))


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"period_s": 2e-3}, r"timing.period_s is 0.002, but a frame takes the camera 0.0025 s"),
        ({"frames": 1}, r"make timing.frames 2 or more"),
        ({"projector_delay_s": 5e-4}, r"the camera would expose before the projector's pulse"),
        ({"camera_width_s": 1e-5}, r"the camera's pulse is 1e-05 s wide: make it 5e-05 s or more"),
    ],
)
def test_impossible_timing_is_refused(wrong, message):
    bench = Bench(settings(**wrong))
    with pytest.raises(RigError, match=message):
        bench.rig()
    assert bench.calls[-2:] == ["trigger.close", "camera.close"]
