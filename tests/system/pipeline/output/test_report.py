"""What a result is worth, in numbers: against a truth that is known, and in `report.json`."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.output.report import depth_in_words, frame_report, measure_against_truth
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.depth.triangulation import triangulate

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.fixture(scope="module")
def truth(cpu):
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    return simulate_frame(rig, SimulationSettings(scene="plane", noise_levels=0.0))


def result(truth, error_rad=0.0, calibrated=False):
    """Return what a decoder would give that is off by some phase."""
    phase = np.where(truth.mask, truth.phase + error_rad, np.nan).astype(np.float32)
    found = SimpleNamespace(unwrapped_phase=phase, mask=truth.mask, region=truth.mask.astype(int), points=None)
    if calibrated:
        geometry = truth.rig.geometry()
        points = triangulate(phase, geometry.camera.rays(), geometry.for_triangulation())
        found.points, found.absolute = runtime.to_host(points), truth.mask & (np.arange(128) < 64)
    return found


def test_the_truth_itself_has_no_error(truth):
    measured = measure_against_truth(result(truth, calibrated=True), truth)
    assert measured["coverage"] == 1 and measured["wrong_orders"] == 0
    assert measured["phase_rms_rad"] < 1e-4
    assert max(measured[name] for name in ("depth_rms_mm", "depth_p999_mm", "depth_rms_order_known_mm")) < 0.01
    assert measured["absolute"] == pytest.approx(0.5, abs=0.05)


def test_a_constant_is_told_and_is_no_error(truth):
    measured = measure_against_truth(result(truth, 0.2), truth)
    assert measured["phase_constant_rad"] == pytest.approx(0.2, abs=1e-4)
    assert measured["phase_rms_rad"] < 1e-4 and "depth_rms_mm" not in measured


def test_noise_is_an_rms_and_whole_cycles_are_orders(truth):
    noise = 0.05 * np.random.default_rng(0).standard_normal(truth.phase.shape)
    noise[40:44, 40:44] += 2 * np.pi
    measured = measure_against_truth(result(truth, noise), truth)
    assert measured["phase_rms_rad"] == pytest.approx(0.05, rel=0.03)
    assert measured["wrong_orders"] == 16


def test_no_order_is_given_back(truth):
    """A surface that is a whole cycle off is as far off as that makes it; beside it stands the rest of its error."""
    measured = measure_against_truth(result(truth, 2 * np.pi, calibrated=True), truth)
    assert measured["wrong_orders"] == 0 and measured["depth_rms_order_known_mm"] < 0.01
    assert measured["depth_rms_mm"] > 50 and measured["depth_p999_mm"] > measured["depth_rms_mm"]


class Shown:
    """A frame that lacks some fields, or has others."""

    def __init__(self, frame, lacks=(), **others):
        self._frame, self._others = frame, others
        self.fields = {name: entry for name, entry in frame.fields.items() if name not in lacks}

    def __getattr__(self, name):
        return self._others.get(name, getattr(self._frame, name))


def test_depth_that_is_only_relative_is_said(truth):
    """Without a calibration, without the code, and with a depth range."""
    rig = truth.rig

    def words(frame, lacks=()) -> str | None:
        return depth_in_words(Shown(frame, lacks), front_known=frame.front_known)

    plain = Decoder(DecodeSettings(projector_side="above"), arch="cpu").decode(truth.image)
    relative = "depth is relative, in rad of phase and not in mm: give a --calibration with the rig's geometry"
    assert words(plain) == relative
    guess = "; which side is in front is a guess: projector_side in the settings states it"
    assert words(Decoder(arch="cpu").decode(truth.image)) == relative + guess
    calibrated = Decoder(calibration=rig, arch="cpu").decode(truth.image)
    said = words(calibrated)
    assert "relative on 100% of the pixels: the surface there may be off by whole cycles, about" in said
    # The plane stands 900 mm away; the period is twice the usual one, of 45 mm a cycle.
    assert 80 < float(said.split("about ")[1].split(" mm")[0]) < 110
    assert "each surface there may be off by whole cycles; a" in words(calibrated, ("region", "point_sigma"))
    assert words(calibrated, ("absolute",)) is None

    known = np.ones_like(calibrated.mask)
    known[np.unravel_index(np.argmax(calibrated.mask), known.shape)] = False
    few = depth_in_words(Shown(calibrated, absolute=known), front_known=True)
    assert "relative on less than 1% of the pixels: the surface there" in few
    waves = simulate_frame(rig, SimulationSettings(scene="waves", noise_levels=0.0))
    ranged = rig.model_copy(update={"depth_range_mm": (880.0, 920.0)})
    assert words(Decoder(calibration=ranged, arch="cpu").decode(waves.image)) is None
    with pytest.warns(DecodeWarning, match="no fringe"):
        assert words(Decoder(arch="cpu").decode(np.zeros_like(truth.image))) is None


def test_what_is_missing_of_the_lit_pixels_is_coverage(truth):
    half = result(truth)
    half.mask = truth.mask & (np.arange(truth.mask.shape[1]) < 64)
    assert measure_against_truth(half, truth)["coverage"] == pytest.approx(0.5, abs=0.05)
    nothing = replace(truth, mask=np.zeros_like(truth.mask))
    assert measure_against_truth(result(nothing), nothing) == {"coverage": 0.0}


def test_a_report_is_json_whatever_was_decoded(truth):
    rig = truth.rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    frame = Decoder(calibration=rig, arch="cpu").decode(truth.image)
    report = frame_report(frame, "a.png")
    assert report["image_px"] == [128, 96] and report["arch"] == "cpu" and report["range_unit"] == "mm"
    assert report["stripe_shift_px"] is None
    low, middle, high = report["range_percentiles_1_50_99"]
    assert low < middle < high and sum(report["regions_px"]) == frame.mask.sum()
    json.dumps(report, allow_nan=False)
    with pytest.warns(UserWarning, match="no fringe"):
        dark = Decoder(arch="cpu").decode(np.zeros_like(truth.image))
    report = frame_report(dark, "a.png")
    assert report["valid_fraction"] == 0 and report["range_percentiles_1_50_99"] is None
    json.dumps(report, allow_nan=False)
