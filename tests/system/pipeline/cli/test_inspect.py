"""`colorphase inspect` as its user meets it; what it finds has tests of its own."""

import json

import cv2
import pytest

from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig


def test_a_table_ends_with_a_verdict(folder, command):
    code, said, complained = command("inspect", str(folder / "frame.png"), "--arch", "cpu")
    assert (code, complained) == (0, "")
    lines = said.strip().splitlines()
    assert "saturation" in said and "costs, rad" in said
    assert lines[-1].startswith("fine")


def test_json_is_for_programs_and_what_spoils_has_its_own_code(folder, command):
    code, said, complained = command("inspect", str(folder / "black.png"), "--json", "--arch", "cpu")
    assert (code, complained) == (3, "")
    found = json.loads(said)
    assert found["grade"] == "spoils"
    code, table, _ = command("inspect", str(folder / "black.png"), "--arch", "cpu")
    assert code == 3
    spoilt = ", ".join(finding["topic"] for finding in found["findings"] if finding["grade"] == "spoils")
    assert table.strip().endswith(f"do not use it as it is ({spoilt})")


def test_footage_that_is_not_there_is_one_line(command):
    code, said, complained = command("inspect", "none.mkv")
    assert (code, said) == (1, "")
    assert "no such file" in complained and complained.count("\n") == 1


def test_with_a_calibration_the_exposure_that_motion_allows_is_that_of_the_plan(tmp_path, command):
    """At 900 mm, and 100 mm/s where nothing shows another speed: 7 px."""
    rig = simulated_rig((320, 240), period_px=2 * 768 / 44)
    rig.write(tmp_path / "rig.json")
    image = simulate_frame(rig, SimulationSettings(scene="plane")).image
    cv2.imwrite(str(tmp_path / "frame.png"), image[..., ::-1])
    (tmp_path / "settings.toml").write_text("row_s = 1e-4")
    options = ("--settings", str(tmp_path / "settings.toml"), "--calibration", str(tmp_path / "rig.json"))
    code, said, complained = command("inspect", str(tmp_path / "frame.png"), *options, "--json", "--arch", "cpu")
    assert (code, complained) == (0, "")
    found = {finding["topic"]: finding["found"] for finding in json.loads(said)["findings"]}
    mm_per_px = 900 / rig.camera.matrix[0, 0]
    assert float(found["longest exposure"].split()[0]) == pytest.approx(7 * 10 * mm_per_px, rel=0.05)
    assert found["rows in turn"] == "1.2 mm in the first and the last row at 100 mm/s: 0.012 mm per mm/s"
