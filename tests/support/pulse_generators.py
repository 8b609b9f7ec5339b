"""What the tests of the pulse generators share."""

import time
from collections.abc import Callable

import pytest

from hardware.protocols import Trigger, TriggerStatus
from hardware.pulses import Pulse, PulseTrain
from hardware.trigger import _dialogue

TRAIN = PulseTrain(0.005, 6, Pulse(0.0, 0.0001), Pulse(0.001, 0.00025))


@pytest.fixture(autouse=True)
def little_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing comes with pauses in it that are longer."""
    monkeypatch.setattr(_dialogue, "QUIET_S", 0.03)


def impatient(generator: Trigger) -> None:
    """Let silence be found soon."""
    generator._dialogue.link.timeout_s = 0.1


def wait(condition: Callable[[], bool]) -> None:
    while not condition():
        time.sleep(0.005)


def run(generator: Trigger) -> TriggerStatus:
    """Fire and wait for the end."""
    generator.arm()
    generator.fire()
    wait(lambda: not generator.status().running)
    return generator.status()
