import os
import re
import subprocess
import sys

import pytest
import serial
from support.emulators.emulated_dg645 import DG645Emulator
from support.emulators.emulated_quantum_composers import QuantumComposersEmulator

from hardware.errors import RigError, TriggerError
from hardware.pulses import Pulse, PulseTrain
from hardware.settings import TriggerSettings
from hardware.trigger import _dialogue, dg645, open_trigger, quantum_composers
from hardware.trigger.dg645 import DG645
from hardware.trigger.quantum_composers import QuantumComposers

pytestmark = pytest.mark.timeout(30)

TRAIN = PulseTrain(0.005, 3, Pulse(0.0, 0.0001), Pulse(0.001, 0.00025))


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let silence be found soon."""
    monkeypatch.setattr(_dialogue, "NAME_S", 0.1)
    monkeypatch.setattr(_dialogue, "QUIET_S", 0.03)


@pytest.mark.parametrize(
    "driver, kind, emulator",
    [("quantum-composers", QuantumComposers, QuantumComposersEmulator), ("dg645", DG645, DG645Emulator)],
)
@pytest.mark.parametrize("network", [False, True])
def test_what_the_settings_name_is_opened(driver, kind, emulator, network):
    with emulator(network=network) as device:
        trigger = open_trigger(TriggerSettings(driver=driver, port=device.url))
        assert isinstance(trigger, kind)
        assert trigger.configure(TRAIN) == TRAIN
        trigger.close()


def test_outputs_are_taken_from_the_settings():
    with QuantumComposersEmulator() as device:
        trigger = open_trigger(
            TriggerSettings(driver="quantum-composers", port=device.url, projector_output="C", camera_output="D")
        )
        trigger.configure(TRAIN)
        trigger.arm()
        trigger.fire()
        assert set(device.bursts[0].outputs) == {"C", "D"}
        trigger.close()


@pytest.mark.parametrize(
    "driver, emulator, baud",
    [
        ("quantum-composers", QuantumComposersEmulator, 115200),
        ("quantum-composers", QuantumComposersEmulator, 9600),
        ("dg645", DG645Emulator, 115200),
    ],
)
def test_usual_baud_rates_are_tried(driver, emulator, baud):
    """What the wrong ones left in the instrument spoils the first question at the right one."""
    with emulator() as device:
        device.baud = baud
        trigger = open_trigger(TriggerSettings(driver=driver, port=device.url))
        assert trigger.configure(TRAIN) == TRAIN
        trigger.close()


def test_only_the_baud_rate_that_is_given_is_tried():
    with DG645Emulator() as device:
        device.baud = 115200
        with pytest.raises(TriggerError, match=r"no Stanford DG645 answers: .* baud rate"):
            open_trigger(TriggerSettings(driver="dg645", port=device.url, baud=9600))
        open_trigger(TriggerSettings(driver="dg645", port=device.url, baud=115200)).close()


@pytest.mark.parametrize("driver, module", [("quantum-composers", quantum_composers), ("dg645", dg645)])
def test_where_nothing_answers_all_that_was_tried_is_told(driver, module, monkeypatch):
    monkeypatch.setattr(module, "BAUDS", (19200, 38400))
    with DG645Emulator() as device:
        device.silent = True
        with pytest.raises(TriggerError, match=r"nothing answers at 19200, 38400 baud: check the instrument"):
            open_trigger(TriggerSettings(driver=driver, port=device.url))
        device.silent = False
        serial.Serial(device.url, exclusive=True).close()  # nothing holds it


@pytest.mark.parametrize(
    "driver, emulator, name",
    [("dg645", QuantumComposersEmulator, "QC,9524"), ("quantum-composers", DG645Emulator, "Stanford Research Systems")],
)
def test_the_other_instrument_is_named_and_let_go(driver, emulator, name):
    with emulator() as device:
        with pytest.raises(TriggerError) as told:  # which keeps all that it has seen alive
            open_trigger(TriggerSettings(driver=driver, port=device.url))
        serial.Serial(device.url, exclusive=True).close()
        assert re.search(rf"this is '{name}.*', not a .*: correct the trigger's port or driver", str(told.value))


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"driver": "dg645"}, r"trigger.port: write where"),
        ({"driver": "dg645", "port": "x", "camera_output": "C"}, r"trigger.camera_output: .* dg645 are fixed"),
        ({"driver": "box", "port": "x", "projector_output": "A"}, r"trigger.projector_output: .* box are fixed"),
        ({"driver": "dg645", "port": "x", "strobe": True}, r"dg645 counts neither strobe nor vsync"),
        ({"driver": "software", "port": "x"}, r"software is no instrument with a port"),
        ({"driver": "simulated"}, r"use `colorphase capture --rig simulated`"),
    ],
)
def test_settings_that_contradict_themselves(settings, message):
    with pytest.raises(RigError, match=message):
        open_trigger(TriggerSettings(**settings))


def test_another_program_has_the_port():
    with QuantumComposersEmulator() as device:
        holder = subprocess.Popen(
            [
                sys.executable,
                "-c",
                f"import serial, sys; port = serial.Serial({device.url!r}, exclusive=True); print(flush=True); "
                "sys.stdin.read()",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert holder.stdin is not None and holder.stdout is not None
        with holder:
            holder.stdout.readline()
            with pytest.raises(TriggerError, match=r"is in use: close the other program that has it open"):
                open_trigger(TriggerSettings(driver="quantum-composers", port=device.url))
            holder.stdin.close()
        open_trigger(TriggerSettings(driver="quantum-composers", port=device.url)).close()


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")
def test_what_is_no_terminal_server_is_told():
    with DG645Emulator(network=True) as device, pytest.raises(TriggerError, match=r"does not answer .*RFC2217"):
        url = device.url.replace("socket", "rfc2217") + "?timeout=0.3"
        open_trigger(TriggerSettings(driver="dg645", port=url, baud=9600))


def test_a_descriptor_is_left_open_by_nobody():
    def descriptors() -> int:
        return len(os.listdir("/proc/self/fd"))

    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("this machine does not list descriptors")
    with DG645Emulator() as device:
        before = descriptors()
        for _ in range(2):
            open_trigger(TriggerSettings(driver="dg645", port=device.url)).close()
            with pytest.raises(TriggerError):
                open_trigger(TriggerSettings(driver="quantum-composers", port=device.url))
        assert descriptors() == before
