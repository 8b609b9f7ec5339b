"""Beat and motion over frames, on fringes whose every change is known."""

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.diagnosis.frame_sequence import SequenceDiagnosis, diagnose_sequence
from pipeline.pattern import make_pattern
from pipeline.simulation import SKIN, SimulationSettings, simulate_frame, simulated_rig

# Frames of rigs that differ from what their settings say.
pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore:the colours' fringes differ")]

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
    assert diagnose_sequence(*frames()) == SequenceDiagnosis((), ())
    # Lateral colour is the same at every speed, and one frame's business.
    assert diagnose_sequence(*frames(lateral=0.05)) == SequenceDiagnosis((), ())


@pytest.mark.parametrize("beat", [0.1, 0.05])
def test_a_beat(beat):
    (found,) = diagnose_sequence(*frames(beat=beat)).findings
    assert found.causes == ("colour-cycle beat",)
    assert "0.2" in found.size


@pytest.mark.parametrize("share", [0.3, 0.15])
def test_motion_between_fields(share):
    """To a tenth, also beside lateral colour; its bias in mm where the rig is known."""
    geometry = simulated_rig().geometry()
    (found,) = diagnose_sequence(*frames(field_share=share, lateral=0.02), geometry).findings
    assert found.causes == ("motion between colour fields",)
    assert float(found.size.split()[1]) == pytest.approx(share, rel=0.1)
    assert float(found.size.split()[4]) == pytest.approx(2 * share, rel=0.1)
    assert f"{share * 0.28 / geometry.rad_per_mm(geometry.working_distance_mm()):.1f}"[:2] in found.size


def test_a_seventh_of_a_radian_a_millimetre():
    geometry = simulated_rig().geometry()
    assert geometry.rad_per_mm(geometry.working_distance_mm()) == pytest.approx(0.138, abs=0.002)


def test_too_few_frames():
    images, white, phases, masks = frames()
    few = diagnose_sequence(images[:5], white, phases[:5], masks[:5])
    assert not few.findings and "at least 12" in few.notes[0]
    masks = [*masks[:3], np.zeros_like(masks[0]), *masks[4:]]
    assert "frame 3 shows no fringes" in diagnose_sequence(images, white, phases, masks).notes[0]


def rendered(scene, share, swing_mm, direction, count=14):
    """Return frames of our simulator: an object that swings to and fro, each colour where it was at its time."""
    rig = simulated_rig((320, 240), period_px=1.5 * 768 / 44)
    pattern = make_pattern((1024, 768), rig.pattern)
    rng = np.random.default_rng(1)
    images = []
    for t in range(count):
        light = []
        for k in range(3):
            # The projector's blue field comes two steps of motion after the first.
            codes = np.zeros_like(pattern)
            codes[..., 2] = pattern[..., k]
            step = np.array(direction) * swing_mm * np.sin(0.35 * (t + k * share)) / 2 + 1e-9
            settings = SimulationSettings(
                scene=scene, gamma=1.0, crosstalk_matrix=np.eye(3), reflectance=(SKIN[k],) * 3, ambient=0.0,
                noise_levels=0.0, bits=16, exposure=1.0, field_motion_mm=tuple(step),
            )  # fmt: skip
            light.append(simulate_frame(rig, settings, codes=codes).image[..., 2] / 65535)
        image = np.stack(light, axis=-1)
        image = 0.9 * image / np.quantile(image, 0.995) + 1.5 / 255 * rng.standard_normal(image.shape)
        images.append(np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8))
    decoder = Decoder(DecodeSettings(crosstalk_matrix=np.eye(3)), arch="cpu")
    decoded = []
    for image in images:  # bust and wall keep their orders from frame to frame
        decoded.append(decoder.decode(image, decoded[-1] if decoded else None))
    return images, 255, [frame.unwrapped_phase for frame in decoded], [frame.mask for frame in decoded]


@pytest.mark.parametrize("scene", ["plane", "bust"])
def test_rendered_motion(scene):
    """A bust before a wall that stands still tells the time between two fields as well as a plane does."""
    (found,) = diagnose_sequence(*rendered(scene, 0.3, 4.0, (0, 0, 1))).findings
    assert found.causes == ("motion between colour fields",)
    assert float(found.size.split()[1]) == pytest.approx(0.3, rel=0.15)
    assert not diagnose_sequence(*rendered(scene, 0.0, 4.0, (0, 0, 1))).findings


@pytest.mark.parametrize("scene", ["ball", "bust"])
def test_what_only_moves_is_no_beat(scene):
    """A coloured object that swings by more than a tile, all colours at once."""
    assert not diagnose_sequence(*rendered(scene, 0.0, 40.0, (1, 0, 0))).findings


def test_what_stands_still_tells_nothing_of_motion():
    still = diagnose_sequence(*rendered("plane", 0.3, 0.0, (0, 0, 1)))
    assert not still.findings and "to and fro" in still.notes[0]
