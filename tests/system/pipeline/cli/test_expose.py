"""`colorphase expose` as its user meets it; what is measured has tests of its own."""

import errno
import tomllib
from dataclasses import replace
from math import inf

import numpy as np
import pytest

from pipeline.acquisition.exposure import ExposureFinder, ExposureReport
from pipeline.acquisition.light_cycle import LightCycle
from pipeline.acquisition.light_fields import MeasuredFields
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
# Red, blue, a dark gap, and green.
FIELDS = MeasuredFields(
    period_s=1 / 120,
    shown_s=np.array([[0.0, 0.0027], [0.0057, 0.0083], [0.0027, 0.0052]]),
    shown_sigma_s=4e-6,
    row_s=2e-5,
    row_sigma_s=1e-8,
    misfit=0.01,
    white=0.0,
)


@pytest.fixture
def found(monkeypatch):
    """Return a function that sets what is found."""

    def find(faults=FAULTS, exposure_s=1 / 60, gain_db=2.5, *, in_turns=True, **changes):
        cycle = LightCycle(1 / 120, in_turns=in_turns)
        fields = replace(FIELDS, **changes)
        report = ExposureReport(faults, exposure_s, gain_db, 0.9, cycle, "srgb", np.array([0.9, 0.95, 0.92]), fields)
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
        "red is on from 0.000 to 2.700 ms, green from 5.700 to 8.300 ms, blue from 2.700 to 5.200 ms of each cycle, to "
        "0.004 ms",
        "the shutter rolls, 20.00 us from row to row, to 0.01 us",
        "exposure 16.6667 ms (2 cycles), gain 2.5 dB: the brightest lit pixels have 90% of full scale",
        "contrast of the fringes: R 0.90, G 0.95, B 0.92",
        'levels are not proportional to light: calibrate and decode with transfer = "srgb"',
        "nothing can be measured: mirrored picture: the picture is mirrored",
        f"{0.1 * per_rad:.2f} mm (0.100 rad): sharpening: edges overshoot",
        f"mm are RMS, at {per_rad:.2f} mm per rad of a usual rig (colorphase plan): this one has no geometry yet",
        "--- rig.toml.old",
        "+++ rig.toml",
        "@@ -9 +9,11 @@",
        "-exposure_s = 0.02  # a guess",
        "+exposure_s = 0.016667  # a guess",
        "+gain_db = 2.5",
        "+row_s = 2e-05",
        "+",
        "+[projector]",
        "+colour_cycle_s = 0.00833333",
        "+",
        "+[projector.fields]",
        "+red_s = [0.0, 0.0027]",
        "+green_s = [0.0057, 0.0083]",
        "+blue_s = [0.0027, 0.0052]",
        "changed rig.toml, the old one is rig.toml.old",
    ]
    assert (tmp_path / "rig.toml.old").read_text() == RIG
    assert 'driver = "simulated"  # no box yet' in rig.read_text()
    # The file that it wrote is one that it needs not change.
    ended, said, _ = command("expose", "--rig", "rig.toml")
    assert said.splitlines()[-1] == "rig.toml is as it should be"
    assert not (tmp_path / "rig.toml.old-2").exists()


def test_fields_that_start_elsewhere_in_the_cycle_are_the_same(command, tmp_path, found):
    """A data sheet may begin with blue, and the time of a free-running camera's first frame is arbitrary."""
    stated = (
        "row_s = 2e-5\n[projector]\ncolour_cycle_s = 0.0083333\n[projector.fields]\n"
        "red_s = [0.0056333, 0.0083333]\ngreen_s = [0.0030, 0.0056]\nblue_s = [0.0, 0.0025]\n"
    )
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG.replace("0.02 ", "0.016667\ngain_db = 2.5 ") + stated)
    found()
    _, said, _ = command("expose", "--rig", "rig.toml")
    assert said.splitlines()[-1] == "rig.toml is as it should be"
    found(shown_s=FIELDS.shown_s - [[0.0], [3e-4], [0.0]])
    _, said, _ = command("expose", "--rig", "rig.toml")
    assert "+green_s = [0.0054, 0.008]" in said.splitlines()


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"white": 0.4}, "projector.fields is not set: white has 40% more light"),
        ({"misfit": 0.2}, "projector.fields is not set: light of colours that go on once per cycle leaves a residual"),
        ({"row_s": 0.0}, "all rows are exposed at once, to 0.01 us from row to row"),
    ],
)
def test_what_is_not_known_is_not_written(command, tmp_path, found, changes, words):
    found(**changes)
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    _, said, _ = command("expose", "--rig", "rig.toml")
    assert words in said
    written = tomllib.loads(rig.read_text())
    assert ("fields" in written["projector"]) is ("row_s" in changes)
    assert ("row_s" in written["camera"]) is ("white" in changes)


def test_colours_at_once_in_a_file_that_states_a_cycle(command, tmp_path, found):
    found(in_turns=False)
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG + "[projector]\ncolour_cycle_s = 0.008\n")
    _, said, complained = command("expose", "--rig", "rig.toml")
    assert "red is on" not in said
    assert "the shutter rolls" in said
    assert "states projector.colour_cycle_s, but all colours come at once" in complained


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
