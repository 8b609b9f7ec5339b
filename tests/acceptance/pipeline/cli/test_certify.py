"""`colorphase certify` leads the simulated rig's operator through all positions, and goes on where it was stopped."""

import json
import subprocess

import numpy as np
import pytest
from support.command_line import command as command_line


@pytest.mark.timeout(1200)
def test_the_simulated_rig_is_certified_from_its_own_pictures(tmp_path):
    def run():
        options = ("--diameter-mm", "60", "--spacing-mm", "160", "--reference-mm", "0", "--relief", "--arch", "cpu")
        words = ("certify", "pictures", "--rig", "simulated", *options, "--out", "certificate.json", "--force")
        done = subprocess.run(
            command_line(*words), cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False
        )
        assert done.returncode == 0, done.stderr
        return done, json.loads((tmp_path / "certificate.json").read_text())

    done, found = run()
    assert all(f"{last} is taken" in done.stderr for last in ("bar-7", "plane-7", "relief-2"))
    for lateral in found["lateral"].values():
        assert lateral["limit_mm"] == pytest.approx(lateral["predicted_mm"], rel=0.2)
    assert np.abs(found["spacing_errors_mm"]).max() < min(0.15, found["uncertainty_mm"])
    (tmp_path / "pictures" / "plane-7.png").unlink()
    done, again = run()
    assert "bar-" not in done.stderr and "plane-7 is taken" in done.stderr
    assert again["spacing_errors_mm"] == found["spacing_errors_mm"]
