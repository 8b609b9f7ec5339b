import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.front_side import RimVotes, ask_rims
from pipeline.errors import SettingsError
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig

HEIGHT, WIDTH = 240, 320


def ball(towards, middle=(120, 160), radius=80.0):
    """Return phase and region of a ball on a ramp; towards: whether its phase grows towards the camera."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    squared = radius**2 - (y - middle[0]) ** 2 - (x - middle[1]) ** 2
    phase = 0.5 * y + 0.02 * x + (1 if towards else -1) * 0.1 * np.sqrt(np.maximum(squared, 0))
    return np.where(squared > 0, phase, np.nan).astype(np.float32), (squared > 0).astype(np.int32)


def simulated(stripes="horizontal", *, opposite=False, **settings):
    """Return a frame of a projector above or on the left; or opposite, below or on the right."""
    rig = simulated_rig((320, 240), stripes=stripes)
    if opposite:
        # Turned by half a turn about the camera's axis: the projector stands on the other side, upside down.
        turn = np.diag([-1.0, -1.0, 1.0])
        rig = rig.model_copy(update={"rotation": rig.rotation @ turn})
    return simulate_frame(rig, SimulationSettings(**settings))


def nearness(frame, truth):
    """Return by how many mm depth grows a rad of the range image, ramps left out."""
    region = frame.region == 1
    seen = region & np.isfinite(truth.points[..., 2])
    y, x = np.nonzero(seen)
    columns = np.stack([np.ones(len(y)), y, x, frame.range_image[seen]], axis=1)
    return np.linalg.lstsq(columns, truth.points[..., 2][seen])[0][3]


@pytest.mark.parametrize("towards", [False, True])
def test_balls_turn_away_at_their_rims(towards):
    votes = ask_rims(*ball(towards))
    assert votes.clear
    assert (votes.falls > 50 * votes.grows) if towards else (votes.grows > 50 * votes.falls)
    # In part outside the frame, whose edge says nothing.
    cut = ask_rims(*ball(towards, middle=(20, 20)))
    assert cut.clear and (cut.falls > cut.grows) == towards


def test_what_is_flat_or_ends_with_the_frame_says_nothing():
    phase = np.repeat(np.linspace(0, 60, HEIGHT, dtype=np.float32)[:, None], WIDTH, axis=1)
    everywhere = np.ones((HEIGHT, WIDTH), np.int32)
    assert ask_rims(phase, everywhere) == RimVotes()
    assert not ask_rims(phase, 0 * everywhere).clear
    plate = everywhere.copy()
    plate[:40] = plate[:, 250:] = 0
    votes = ask_rims(phase, plate)
    assert (votes.falls, votes.grows) == (0, 0) and not votes.clear
    bowl = (0.001 * (np.arange(HEIGHT) - HEIGHT / 2) ** 2).astype(np.float32)[:, None] + 0 * phase
    assert ask_rims(phase + bowl, everywhere) == RimVotes()
    # What is narrower than the reach has no inside.
    strip = np.where(np.arange(WIDTH) % 12 < 8, everywhere, 0)
    assert not ask_rims(phase, strip).clear


def test_a_clear_side_has_a_lead():
    assert RimVotes(falls=80, grows=10, needed=60).clear
    assert not RimVotes(falls=50, grows=0, needed=60).clear
    assert not RimVotes(falls=1000, grows=950, needed=10).clear


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
@pytest.mark.parametrize("opposite", [False, True])
@pytest.mark.parametrize("scene", ["bust", "ball", "objects"])
def test_larger_is_farther_on_either_side_of_the_projector(cpu, scene, stripes, opposite):
    truth = simulated(stripes, opposite=opposite, scene=scene)
    settings = {"stripes": stripes, "crosstalk_matrix": TYPICAL_CROSSTALK}
    frame = Decoder(DecodeSettings(**settings), arch="cpu").decode(truth.image)
    assert frame.front_known and nearness(frame, truth) > 0
    sides = ("above", "below") if stripes == "horizontal" else ("left", "right")
    for side, right in zip(sides, (not opposite, opposite), strict=True):
        stated = Decoder(DecodeSettings(**settings, projector_side=side), arch="cpu").decode(truth.image)
        assert stated.front_known and (nearness(stated, truth) > 0) == right


def test_the_side_stays_as_the_first_clear_frame_shows_it(cpu):
    """A wall says nothing, and is left as it is; a bust says it for all frames after it."""
    wall, bust = simulated(scene="plane"), simulated(scene="bust")
    decoder = Decoder(arch="cpu")
    before = decoder.decode(wall.image)
    assert not before.front_known and "rims" in decoder.state.asks
    decoder.decode(bust.image)
    assert "rims" not in decoder.state.asks
    after = decoder.decode(wall.image)
    assert after.front_known
    both = before.mask & after.mask
    np.testing.assert_allclose(after.range_image[both], -before.range_image[both], atol=0.1)


def test_it_is_asked_less_often_while_it_stays_unclear(cpu, monkeypatch):
    wall, asked = simulated(scene="plane"), []
    monkeypatch.setattr("pipeline.decoder.ask_rims", lambda *surface: asked.append(surface) or RimVotes())
    decoder = Decoder(arch="cpu")
    for _ in range(40):
        decoder.decode(wall.image)
    assert len(asked) == 16 + 2


def test_a_calibrated_frame_asks_no_rims(cpu):
    truth = simulated(scene="bust")
    decoder = Decoder(calibration=truth.rig, arch="cpu")
    assert decoder.decode(truth.image).front_known
    assert "rims" not in decoder.state.asks and decoder.state.rims == RimVotes()


def test_a_side_along_the_stripes_tells_no_depth():
    with pytest.raises(SettingsError, match="determine depth only with a projector above or below"):
        DecodeSettings(projector_side="left")
    with pytest.raises(SettingsError, match="determine depth only with a projector left or right"):
        DecodeSettings(stripes="vertical", projector_side="above")
