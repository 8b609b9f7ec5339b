"""What a rig's file names is opened together, or not at all."""

import re
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from hardware import Rig, open_instruments
from hardware.errors import RigError
from hardware.settings import RigSettings


def rig_settings(trigger="simulated", camera="simulated", **more):
    return RigSettings.model_validate(
        {
            "trigger": {"driver": trigger, "strobe": True},
            "timing": {"period_s": 0.02, "frames": 4},
            "camera": {"driver": camera, "exposure_s": 1 / 120, "size_px": [64, 48]},
            **more,
        }
    )


def test_the_example_in_the_docs_runs_with_nothing_attached(tmp_path, monkeypatch):
    text = (Path(__file__).resolve().parents[3] / "docs" / "rig.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    sections = "[trigger]\ndriver = 'simulated'\n[camera]\ndriver = 'simulated'\nexposure_s = 0.001\nsize_px = [64, 48]"
    (tmp_path / "rig.toml").write_text(f"{sections}\n[timing]\nperiod_s = 0.005\nframes = 2\n", encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    found = {}
    exec(program, found)
    assert found["burst"].number == 9 and found["paired"].pulse == 1


def test_a_simulated_rig_is_opened_as_a_real_one():
    settings = rig_settings()
    with Rig(settings, lambda: open_instruments(settings), notify=print) as rig:
        numbers = [
            (burst.number, [paired.pulse for paired in burst.frames], [paired.image.shape for paired in burst.frames])
            for burst in islice(rig.bursts(), 2)
        ]
    assert numbers == [(0, [0, 1, 2, 3], [(48, 64, 3)] * 4), (1, [0, 1, 2, 3], [(48, 64, 3)] * 4)]


def test_its_two_pictures_are_told_apart():
    settings = rig_settings(projector={"alternating": True})
    with Rig(settings, lambda: open_instruments(settings)) as rig:
        means = [paired.image.mean() for paired in next(rig.bursts()).frames]
    steps = np.diff(np.log(means))
    assert (np.sign(steps[:-1]) == -np.sign(steps[1:])).all()
    assert np.abs(steps) == pytest.approx(-np.log(0.85), abs=0.01)


@pytest.mark.parametrize(
    ("trigger", "camera"), [("simulated", "basler"), ("software", "simulated"), ("box", "simulated")]
)
def test_half_a_simulated_rig_is_refused(trigger, camera):
    with pytest.raises(RigError, match='set driver = "simulated" for both'):
        open_instruments(rig_settings(trigger, camera))
