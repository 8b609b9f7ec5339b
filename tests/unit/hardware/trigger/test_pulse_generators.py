"""What laboratory pulse generators have in common, against an emulator of each."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from support.emulators.emulated_dg645 import DG645Emulator
from support.emulators.emulated_quantum_composers import QuantumComposersEmulator
from support.pulse_generators import TRAIN, impatient, little_noise, run, wait

from hardware.errors import TriggerError
from hardware.link import Link
from hardware.protocols import Trigger, TriggerStatus
from hardware.pulses import PulseTrain
from hardware.trigger import dg645, quantum_composers
from hardware.trigger.dg645 import DG645
from hardware.trigger.quantum_composers import QuantumComposers

__all__ = ["little_noise"]
pytestmark = pytest.mark.timeout(30)

ENDLESS = PulseTrain(0.005, None, TRAIN.projector, TRAIN.camera)


@dataclass(frozen=True)
class Kind:
    """A driver, the emulator of its instrument, and what that calls the camera's output."""

    driver: type[Any]
    emulator: type[Any]
    terminator: bytes
    camera_output: str
    boot: int | None  # what its status says of a first life


KINDS = [
    Kind(DG645, DG645Emulator, dg645.TERMINATOR, "CD", 1),
    Kind(QuantumComposers, QuantumComposersEmulator, quantum_composers.TERMINATOR, "B", None),
]


@pytest.fixture(params=KINDS, ids=lambda kind: kind.driver.__name__)
def kind(request: pytest.FixtureRequest) -> Kind:
    found: Kind = request.param
    return found


@pytest.fixture
def device(kind: Kind) -> Iterator[Any]:
    with kind.emulator() as device:
        yield device


@pytest.fixture
def generator(kind: Kind, device: Any) -> Iterator[Trigger]:
    generator = kind.driver(Link(device.url, terminator=kind.terminator))
    yield generator
    generator.close()


def test_an_endless_train_runs_until_it_is_aborted(kind, generator, device):
    generator.configure(ENDLESS)
    generator.arm()
    generator.fire()
    wait(lambda: device.bursts[-1].pulses(kind.camera_output, device.now) > 10)
    assert generator.status() == TriggerStatus(running=True, boot=kind.boot)
    generator.abort()
    assert not device.running
    generator.configure(TRAIN)
    assert run(generator) == TriggerStatus(running=False, boot=kind.boot)


def test_closing_stops_it(generator, device):
    generator.configure(ENDLESS)
    generator.arm()
    generator.fire()
    generator.close()
    assert not device.running
    generator.close()


def test_slow_answers_in_pieces_are_survived(kind, generator, device):
    device.in_pieces = True
    device.delay_s = 0.002
    generator.configure(TRAIN)
    assert run(generator) == TriggerStatus(running=False, boot=kind.boot)


def test_arming_what_was_not_configured(generator):
    with pytest.raises(TriggerError, match=r"configure it before it is armed"):
        generator.arm()


def test_silence_ends_every_method(generator, device):
    generator.configure(TRAIN)
    impatient(generator)
    generator.arm()
    device.silent = True
    generator.fire()
    for method in (generator.status, generator.abort, generator.arm):
        with pytest.raises(TriggerError, match=r"does not answer any more: check its power"):
            method()
    generator.close()
