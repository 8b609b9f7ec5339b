"""`colorphase expose` as its user meets it; what is measured has tests of its own."""

import errno
from math import inf

import numpy as np
import pytest

from pipeline.acquisition.exposure import ExposureFinder, ExposureReport
from pipeline.acquisition.light_cycle import LightCycle
from pipeline.acquisition.rig_faults import RigFault
from pipeline.planning.rig_plan import plan_rig

RIG = """[trigger]
driver = "simulated"  # no box yet

[timing]
period_s = 0.04

[camera]
driver = "simulated"
exposure_s = 0.02  # a guess
"""
FAULTS = (RigFault("mirrored picture", "the picture is mirrored", inf), RigFault("sharpening", "edges overshoot", 0.1))


@pytest.fixture
def found(monkeypatch):
    """Return a function that sets what is found."""

    def find(faults=FAULTS, exposure_s=1 / 60, gain_db=2.5):
        cycle = LightCycle(1 / 120, in_turns=True)
        report = ExposureReport(faults, exposure_s, gain_db, 0.9, cycle, "srgb", np.array([0.9, 0.95, 0.92]))
        monkeypatch.setattr(ExposureFinder, "find", lambda self: report)

    return find


def test_the_file_is_changed_and_the_old_one_kept(command, tmp_path, found):
    found()
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    ended, said, complained = command("expose", "--rig", "rig.toml")
    assert (ended, complained) == (0, "")
    per_rad = plan_rig().fringe.depth_per_rad_mm
    assert said.splitlines() == [
        "simulated: 1 manual acts, 0 s by the rig's clock",
        "the projector's light repeats every 8.3333 ms (120.00 Hz), one colour after another, 360.0 fields per s",
        "exposure 16.6667 ms (2 cycles), gain 2.5 dB: the brightest lit pixels have 90% of full scale",
        "contrast of the fringes: R 0.90, G 0.95, B 0.92",
        'levels are not proportional to light: calibrate and decode with transfer = "srgb"',
        "nothing can be measured: mirrored picture: the picture is mirrored",
        f"{0.1 * per_rad:.2f} mm (0.100 rad): sharpening: edges overshoot",
        f"mm are RMS, at {per_rad:.2f} mm per rad of a usual rig (colorphase plan): this one has no geometry yet",
        "--- rig.toml.old",
        "+++ rig.toml",
        "@@ -9 +9,5 @@",
        "-exposure_s = 0.02  # a guess",
        "+exposure_s = 0.016667  # a guess",
        "+gain_db = 2.5",
        "+",
        "+[projector]",
        "+colour_cycle_s = 0.00833333",
        "changed rig.toml, the old one is rig.toml.old",
    ]
    assert (tmp_path / "rig.toml.old").read_text() == RIG
    assert 'driver = "simulated"  # no box yet' in rig.read_text()
    # The file that it wrote is one that it needs not change.
    ended, said, _ = command("expose", "--rig", "rig.toml")
    assert said.splitlines()[-1] == "rig.toml is as it should be"
    assert not (tmp_path / "rig.toml.old-2").exists()


def test_a_simulated_rig_without_faults(command, tmp_path, found):
    found(faults=())
    ended, said, complained = command("expose", "--rig", "simulated")
    assert (ended, complained) == (0, "")
    assert said.splitlines()[-1] == "no fault was found"
    assert list(tmp_path.iterdir()) == []


def test_focus_is_shown_before(command, found):
    found(faults=())
    ended, said, _ = command("expose", "--rig", "simulated", "--focus-s", "5")
    assert ended == 0
    assert said.startswith("focus: fringes R 0.9")


@pytest.mark.parametrize(
    "text, message",
    [
        (None, "cannot read rig.toml"),
        ("[camera", "rig.toml is not what it should be"),
        (RIG.replace("exposure_s", "exposure"), "camera.exposure_s"),
    ],
)
def test_what_is_no_rig_is_one_line(command, tmp_path, text, message):
    if text is not None:
        (tmp_path / "rig.toml").write_text(text)
    ended, said, complained = command("expose", "--rig", "rig.toml")
    assert (ended, said, complained.count("\n")) == (1, "", 1)
    assert message in complained


def test_a_file_that_cannot_be_written_is_one_line(command, tmp_path, found, monkeypatch):
    found()
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    monkeypatch.setattr("pipeline.files.replace_file", _refuse)
    ended, _, complained = command("expose", "--rig", "rig.toml")
    assert (ended, complained.count("\n")) == (1, 1)
    assert "rig.toml.old: the disk is full: free some space" in complained
    assert rig.read_text() == RIG


def _refuse(path, content):
    raise OSError(errno.ENOSPC, "full", str(path))
