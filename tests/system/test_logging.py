"""What is logged, and that nothing is where nobody asks for it."""

import logging
import subprocess
import sys

import numpy as np
import pytest

from hardware.errors import BurstError
from hardware.protocols import FrameFormat
from hardware.rig import Rig
from hardware.settings import RigSettings
from hardware.simulated import MemoryCamera, SimulatedTrigger
from pipeline import DecodeSettings
from pipeline.decoder import Decoder
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

SETTINGS = RigSettings(
    trigger={"driver": "simulated"},
    timing={"period_s": 0.02, "frames": 3},
    camera={"driver": "simulated", "exposure_s": 1e-3},
)


def test_a_warning_is_silent_until_a_program_configures_logging():
    program = (
        "import logging, sys\n"
        "import colorphase\n"
        "colorphase.Rig\n"
        "logging.getLogger('colorphase.rig').warning('a cable is out')\n"
    )
    for configure, said in (("", ""), ("logging.basicConfig()\n", "WARNING:colorphase.rig:a cable is out\n")):
        command = [sys.executable, "-c", program.replace("colorphase.Rig\n", f"colorphase.Rig\n{configure}")]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
        assert (done.stdout, done.stderr) == ("", said)


def test_a_first_frame_logs_that_it_prepares(cpu, caplog):
    caplog.set_level(logging.INFO, "colorphase")
    truth = simulate_frame(simulated_rig((320, 240)), SimulationSettings(scene="plane"))
    decoder = Decoder(DecodeSettings(), truth.rig, arch="cpu")
    frame = decoder.decode(truth.image)
    assert [record.message.partition(";")[0] for record in caplog.records if record.name == "colorphase.decoder"] == [
        "buffers for 320x240 px"
    ]
    caplog.clear()
    decoder.decode(truth.image, previous=frame)
    assert not caplog.records


def test_bursts_that_are_thrown_away_are_warnings(caplog):
    """Here of a camera whose cap is on."""
    caplog.set_level(logging.INFO, "colorphase")
    trigger = SimulatedTrigger()
    camera = MemoryCamera(lambda time_s: np.zeros((4, 6, 3), np.uint8), (6, 4), FrameFormat("rgb"), 1e-3)
    trigger.camera = camera.pulse
    with pytest.raises(BurstError, match="cap"), Rig(SETTINGS, lambda: (trigger, camera)) as rig:
        next(rig.bursts())
    lines = [record.message for record in caplog.records if record.levelno == logging.WARNING]
    assert [line.partition(": ")[0] for line in lines] == [f"burst 0 is thrown away, try {n} of 3" for n in (1, 2, 3)]
    assert "pulses are set: " in caplog.text and "trigger source and camera are closed" in caplog.text
