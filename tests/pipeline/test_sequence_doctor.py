"""Beat and motion over frames, on fringes whose every change is known."""

import numpy as np
import pytest

from pipeline.calibration.sequence_doctor import diagnose_sequence, rad_per_mm
from pipeline.simulate import simulated_rig

COUNT = 16


def frames(*, beat=0.0, rate=0.23, field_share=0.0, lateral=0.0, seed=0):
    """Return frames of a plane that swings to and fro, with their phases: what each colour saw, and when."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:180, :240].astype(float)
    still = 2 * np.pi / 12 * y + 0.01 * x
    place = 0.8 * np.sin(0.35 * np.arange(COUNT))  # rad
    images, phases = [], []
    for t in range(COUNT):
        speed = 0.8 * 0.35 * np.cos(0.35 * t)
        channels = []
        for j in range(3):
            seen = still + place[t] + (j - 1) * (speed * field_share + lateral)
            strength = 1 + (beat * np.cos(2 * np.pi * rate * t + 2.0 * j) if j != 1 else 0.0)
            channels.append(strength * (100 + 60 * np.cos(seen + (j - 1) * 2 * np.pi / 3)))
        image = np.stack(channels, axis=-1) + 1.5 * rng.standard_normal((*y.shape, 3))
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
        phases.append((still + place[t] + 0.02 * rng.standard_normal(y.shape)).astype(np.float32))
    masks = [np.ones(y.shape, bool)] * COUNT
    return images, 255, phases, masks


def test_frames_without_a_fault():
    assert diagnose_sequence(*frames()) == ()
    # Lateral colour is the same at every speed, and one frame's business.
    assert diagnose_sequence(*frames(lateral=0.05)) == ()


@pytest.mark.parametrize("beat", [0.1, 0.05])
def test_a_beat(beat):
    (found,) = diagnose_sequence(*frames(beat=beat))
    assert found.causes == ("colour-cycle beat",)
    assert "0.2" in found.size


@pytest.mark.parametrize("share", [0.3, 0.15])
def test_motion_between_fields(share):
    """To a tenth, also beside lateral colour; its bias in mm where the rig is known."""
    geometry = simulated_rig().geometry()
    (found,) = diagnose_sequence(*frames(field_share=share, lateral=0.02), geometry)
    assert found.causes == ("motion between colour fields",)
    assert float(found.size.split()[0]) == pytest.approx(share, rel=0.1)
    assert f"{share * 0.28 / rad_per_mm(geometry):.1f}"[:2] in found.size


def test_a_seventh_of_a_radian_a_millimetre():
    assert rad_per_mm(simulated_rig().geometry()) == pytest.approx(0.138, abs=0.002)


def test_too_few_frames():
    images, white, phases, masks = frames()
    assert diagnose_sequence(images[:5], white, phases[:5], masks[:5]) == ()
