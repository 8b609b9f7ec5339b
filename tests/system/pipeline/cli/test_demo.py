"""`colorphase demo` as its user meets it."""

import json


def test_the_demo_is_measured_against_the_truth(folder, command):
    done = command("demo", "--out", "demo", "--arch", "cpu", cwd=folder)
    assert done.returncode == 0, done.stderr
    report = json.loads((folder / "demo" / "report.json").read_text())
    truth = report["against_truth"]
    assert truth["phase_rms_rad"] < 0.05
    assert truth["depth_rms_mm"] < 0.25  # every pixel where it is, no order given back
    assert truth["depth_p999_mm"] < 1.5
    assert truth["coverage"] > 0.97
    assert truth["absolute"] > 0.97
    assert f"{truth['depth_rms_mm']:.3f} mm" in done.stdout
    assert (folder / "demo" / "shaded.png").exists()
    assert (folder / "demo" / "render.png").exists() or "install" in done.stderr
