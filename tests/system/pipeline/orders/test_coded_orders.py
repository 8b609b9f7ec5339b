"""Absolute orders from one frame of a coded pattern, and frames that do not show the code."""

import re
import warnings
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
import reference
from support.piled_objects import plates_before_a_wall

from pipeline import Decoder, DecodeSettings, DecodeWarning
from pipeline.contrast_code import ContrastCode
from pipeline.decoding.rig_state import RigState
from pipeline.errors import SettingsError
from pipeline.orders.stripe_columns import StripeColumns
from pipeline.output.report import frame_report
from pipeline.pattern import CHANNEL_PHASES
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels.scene.scene_shapes import SHAPES

pytestmark = pytest.mark.usefixtures("cpu")

SIZE = (480, 360)  # three quarters of the usual picture, its fringes as fine
FULL = (640, 480)  # objects that show eight cycles or more
each_code = pytest.mark.parametrize("code", ["contrast", "contrast2"])


@cache
def simulated(scene="bust", code="contrast", stripes="horizontal", tilt_deg=0.0, size=SIZE, **settings):
    """Return a frame with its truth, and the calibration of its rig."""
    rig = simulated_rig(size, period_px=640 / size[0] * 768 / 44, code=code, stripes=stripes, tilt_deg=tilt_deg)
    settings = SimulationSettings(scene=scene, **settings)
    frame = simulate_frame(rig, settings)
    return frame, rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})


def said(rig, code):
    """Return a calibration whose pattern is said to have another code."""
    return rig.with_pattern(code=code or "none")


def shares(frame, truth):
    """Return which shares of the lit pixels are absolute and right, and absolute and wrong."""
    lit = reference.eroded(truth.mask, 4) & (truth.image.mean(axis=2) > 20)
    known = lit & frame.absolute
    wrong = known & (np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase) > np.pi)
    return (known & ~wrong).sum() / lit.sum(), wrong.sum() / lit.sum()


@pytest.mark.parametrize("scene", SHAPES)
@pytest.mark.parametrize(
    ("code", "gamma", "reflectance"),
    [("contrast", 2.0, SKIN), ("contrast", 1.0, WHITE), ("contrast2", 2.0, SKIN)],
)
def test_every_scene(arch, scene, code, gamma, reflectance):
    size = FULL if scene == "objects" else SIZE
    truth, calibration = simulated(scene, code, gamma=gamma, reflectance=reflectance, size=size)
    frame = Decoder(DecodeSettings(), calibration, arch=arch).decode(truth.image)
    right, wrong = shares(frame, truth)
    assert right > 0.97
    assert wrong < 0.0005
    assert frame.warnings == ()
    assert np.nanmax(frame.order_error_probability[frame.absolute]) < 1e-3
    np.testing.assert_array_equal(np.isnan(frame.order_error_probability), ~frame.mask)
    known = frame.absolute
    error = np.abs(frame.points[known] - truth.points[known])[:, 2]
    assert np.median(error) < 0.3  # mm


@each_code
@pytest.mark.parametrize(("stripes", "tilt_deg"), [("vertical", 0), ("horizontal", 15)])
def test_other_stripes(code, stripes, tilt_deg):
    truth, calibration = simulated("ball", code, stripes=stripes, tilt_deg=tilt_deg)
    frame = Decoder(DecodeSettings(stripes=stripes), calibration, arch="cpu").decode(truth.image)
    right, wrong = shares(frame, truth)
    assert right > 0.97
    assert wrong < 0.003


def test_without_a_calibration():
    truth, _ = simulated("objects", size=FULL)
    frame = Decoder(DecodeSettings(code="contrast"), arch="cpu").decode(truth.image)
    right, wrong = shares(frame, truth)
    assert right > 0.98
    assert wrong < 0.002
    assert frame.warnings == ()


def phase_error(scene, code, **settings):
    """Return the standard deviation of the phase's error, rad."""
    truth, calibration = simulated(scene, code, **settings)
    frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(truth.image)
    return np.std(np.angle(np.exp(1j * (frame.wrapped_phase - truth.phase)[frame.mask & truth.mask])))


@pytest.mark.parametrize(("scene", "gamma", "reflectance"), [("plane", 2.0, SKIN), ("waves", 1.0, WHITE)])
@pytest.mark.parametrize("blur_px", [0.0, 2.0])
def test_the_phase_stays_as_good(scene, gamma, reflectance, blur_px):
    """With a code the phase's error is at most 1.25 times that without it, or 0.008 rad, blur or not."""
    settings = {"gamma": gamma, "reflectance": reflectance, "projector_blur_px": (blur_px,) * 3}
    plain, *coded = (phase_error(scene, code, **settings) for code in (None, "contrast", "contrast2"))
    assert max(coded) < max(1.25 * plain, 0.008)


def test_the_second_codes_phase_is_at_least_as_good():
    assert phase_error("plane", "contrast2") <= phase_error("plane", "contrast")


def test_a_reused_frame_forgets():
    coded, calibration = simulated("plane")
    decoder = Decoder(DecodeSettings(), calibration, arch="cpu")
    frame = decoder.decode(coded.image)
    assert frame.absolute.any()
    with pytest.warns(DecodeWarning, match="no fringe"):
        decoder.decode(np.zeros_like(coded.image), out=frame)
    assert not frame.absolute.any()
    assert np.isnan(frame.order_error_probability).all()


@pytest.mark.parametrize(
    ("shown", "code"),
    [(None, "contrast"), (None, "contrast2"), ("contrast", "contrast2"), ("contrast2", "contrast")],
)
def test_a_frame_without_the_code(shown, code):
    """Under a plain pattern, and under the other code."""
    truth, calibration = simulated("bust", shown)
    with pytest.warns(DecodeWarning, match=r"does not show the contrast code|too little of the code"):
        frame = Decoder(DecodeSettings(), said(calibration, code), arch="cpu").decode(truth.image)
    assert {doubt.key for doubt in frame.warnings} & {"code not seen", "orders guessed"}
    assert not frame.absolute.any()
    assert frame.order_error_probability[frame.mask].min() > 1e-3


@pytest.mark.parametrize(
    ("code", "calibrated", "wrong"),
    [
        *product(["contrast"], [True, False], ["reversed", "inverted", "permuted"]),
        *product(["contrast2"], [True], ["reversed", "inverted", "permuted", "turned"]),
    ],
)
def test_a_sequence_that_is_not_the_codes(wrong, code, calibrated):
    """Whatever fits by chance is not believed."""
    truth, calibration = simulated("plane", code)
    own = ContrastCode.of(calibration.pattern).contrasts
    contrasts = {
        "reversed": own[::-1],
        "inverted": own.min() + own.max() - own,
        "permuted": np.random.default_rng(1).permutation(own),
        "turned": own[::-1, ::-1],
    }[wrong]
    image = simulate_frame(truth.rig, SimulationSettings(scene="plane"), coded_by(truth.rig, contrasts)).image
    settings = DecodeSettings(code=code, crosstalk_matrix=calibration.crosstalk_matrix)
    with pytest.warns(DecodeWarning, match="contrast code|of the code|along the stripe"):
        frame = Decoder(settings, calibration if calibrated else None, arch="cpu").decode(image)
    assert not frame.absolute.any()
    assert frame.order_error_probability[frame.mask].min() > 0.002  # twice what is believed


SHOWN = r'shows a contrast code, which is used: set code = "none" \(--code none\) to decode it as plain'


def same(frame, other):
    """Whether two frames were decoded alike, bit by bit."""
    names = ("unwrapped_phase", "mask", "region", "absolute", "order_error_probability", "phase_sigma", "modulation")
    return all(np.array_equal(getattr(frame, name), getattr(other, name), equal_nan=True) for name in names)


@pytest.mark.parametrize("calibrated", [True, False])
def test_a_code_that_the_frame_shows(calibrated):
    """It is used as if it were stated, also where the calibration's pattern is plain or the light is unknown."""
    truth, rig = simulated("bust")
    calibration = said(rig, None) if calibrated else None
    decoder = Decoder(DecodeSettings(), calibration, arch="cpu")
    with pytest.warns(DecodeWarning, match=SHOWN):
        frame = decoder.decode(truth.image)
    assert decoder.state.code == "contrast" and shares(frame, truth)[0] > 0.97
    assert same(frame, Decoder(DecodeSettings(code="contrast"), calibration, arch="cpu").decode(truth.image))
    assert decoder.decode(truth.image).warnings == ()  # it is said once


def test_it_is_used_into_the_buffers_of_the_frame_before():
    truth, rig = simulated("bust")
    frames = []
    for code in (None, "contrast"):
        before = Decoder(DecodeSettings(code="none"), rig, arch="cpu").decode(truth.image)
        decoder = Decoder(DecodeSettings(code=code), said(rig, None), arch="cpu")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DecodeWarning)
            frames.append(decoder.decode(truth.image, previous=before, out=before))
    assert frames[0].absolute.any() and same(*frames)


def test_a_coded_frame_decoded_as_plain():
    truth, rig = simulated("bust")
    frame = Decoder(DecodeSettings(code="none"), rig, arch="cpu").decode(truth.image)
    assert frame.warnings == () and not frame.absolute.any()


@pytest.mark.parametrize("code", [None, "contrast2"])
def test_frames_that_show_no_first_code(code):
    """Plain ones, and those under the second code, which nobody can read who has not been told."""
    for scene in SHAPES:
        truth, calibration = simulated(scene, code=code)
        calibration = said(calibration, None)
        decoder = Decoder(DecodeSettings(), calibration, arch="cpu")
        frame = decoder.decode(truth.image)
        assert decoder.state.code is None and not frame.absolute.any(), scene
        assert same(frame, Decoder(DecodeSettings(code="none"), calibration, arch="cpu").decode(truth.image)), scene


def test_what_another_decoder_has_seen_of_a_code():
    """A code that is stated stays."""
    truth, rig = simulated("bust")
    worker = Decoder(DecodeSettings(), said(rig, None), arch="cpu")
    worker.state = RigState(code="contrast", asks=frozenset({"light", "rims"}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        frame = worker.decode(truth.image)
    assert same(frame, Decoder(DecodeSettings(), rig, arch="cpu").decode(truth.image))
    stated = Decoder(DecodeSettings(), rig, arch="cpu")
    stated.state = RigState(asks=frozenset({"light", "rims"}))
    assert stated.state.code == "contrast"


@pytest.mark.parametrize("gamma", [1.0, 1.7, 2.0])
@pytest.mark.parametrize("rows", [26, 36, 48])
@pytest.mark.filterwarnings("ignore::pipeline.DecodeWarning")
def test_too_few_cycles_are_flagged(rows, gamma):
    """Two cycles do not name their place, however wide; three and four do in some places, and the right one."""
    truth, calibration = simulated("plane", gamma=gamma)
    settings = DecodeSettings(code="contrast", crosstalk_matrix=calibration.crosstalk_matrix)
    absolute = []
    for top in range(12, 300, 48):
        frame = Decoder(settings, arch="cpu").decode(truth.image[top : top + rows])
        off = np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase[top : top + rows]) > np.pi
        assert not (frame.absolute & off).any()
        absolute.append(frame.absolute.any())
        assert absolute[-1] or {doubt.key for doubt in frame.warnings} & {"code not seen", "orders guessed"}
    assert sum(absolute) <= {26: 0, 36: 2, 48: 4}[rows]


def test_two_objects_too_small_for_the_code():
    truth, calibration = simulated("plane")
    image = truth.image.copy()
    image[:, :] = 0
    for top, left in ((60, 50), (200, 300)):
        image[top : top + 40, left : left + 60] = truth.image[top : top + 40, left : left + 60]
    with pytest.warns(DecodeWarning, match="of the code"):
        frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(image)
    assert frame.mask.any()
    assert shares(frame, truth)[1] == 0


@each_code
@pytest.mark.filterwarnings("ignore:.* of the pixels show too little of the code")
def test_half_in_shadow(code):
    truth, calibration = simulated("bust", code)
    image = truth.image.copy()
    image[:, : SIZE[0] // 2] = image[:, : SIZE[0] // 2] // 25
    frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(image)
    right, wrong = shares(frame, truth)
    assert right > 0.4
    assert wrong < 0.002


@each_code
@pytest.mark.filterwarnings("ignore:no matrix explains")
def test_a_texture_with_the_fringes_period(code):
    """It hides part of the code: what is not certain any more is said not to be."""
    truth, calibration = simulated("bust", code)
    rows = np.arange(SIZE[1])[:, None, None]
    image = (truth.image * (0.75 + 0.25 * np.cos(2 * np.pi * rows / 12.3))).astype(np.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)
        frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(image)
    right, wrong = shares(frame, truth)
    said = any("show too little of the code" in warning for warning in frame.warnings)
    assert right > (0.85 if said else 0.97)
    assert wrong < 0.0005


@each_code
def test_a_hidden_step_of_whole_cycles_splits_a_region(arch, code):
    """Half of the plane lies one whole cycle away, which leaves no trace in the wrapped phase."""
    truth, calibration = simulated("plane", code, texture=0.0)
    rig = truth.rig
    moved = simulate_frame(
        rig,
        SimulationSettings(scene="plane", texture=0.0),
        shifted_codes(rig, cycles=1),
    )
    image = truth.image.copy()
    image[:, SIZE[0] // 2 :] = moved.image[:, SIZE[0] // 2 :]
    frame = Decoder(DecodeSettings(), calibration, arch=arch).decode(image)
    cycles = (frame.unwrapped_phase - truth.phase) / (2 * np.pi)
    known = frame.absolute & truth.mask
    expected = np.where(np.arange(SIZE[0]) >= SIZE[0] // 2, 1, 0)
    wrong = known & (np.rint(np.nan_to_num(cycles)) != expected)
    assert known.mean() > 0.95
    assert wrong.mean() < 0.01


def shifted_codes(rig, cycles):
    """Return the rig's pattern with the code moved by whole cycles, the phase staying."""
    return coded_by(rig, np.roll(ContrastCode.of(rig.pattern).contrasts, -cycles, axis=0))


def coded_by(rig, contrasts):
    """Return the rig's pattern with other contrasts of its cycles and cells."""
    width, height = rig.projector.size_px
    cycles, code = np.arange(height)[:, None] / rig.pattern.period_px, ContrastCode.of(rig.pattern)
    modulation = replace(code, contrasts=contrasts).modulation(cycles, np.arange(width))[..., None]
    codes = 1 - modulation + modulation * np.cos(2 * np.pi * cycles[..., None] + np.array(CHANNEL_PHASES))
    return np.ascontiguousarray(np.broadcast_to(codes.astype(np.float32), (height, width, 3)))


def test_a_depth_range_narrows_the_offsets():
    """Seven cycles that alone do not place themselves do within a range of 60 mm, and not outside of it."""
    truth, calibration = simulated("plane")
    rows = slice(150, 150 + 70)
    image = np.zeros_like(truth.image)
    image[rows] = truth.image[rows]
    probability = []
    for depth_range in ((700.0, 1200.0), (870.0, 930.0)):
        told = calibration.model_copy(update={"depth_range_mm": depth_range})
        decoder = Decoder(DecodeSettings(), told, arch="cpu")
        frame = decoder.decode(image)
        assert shares(frame, truth)[1] == 0
        probability.append(float(np.nanmedian(frame.order_error_probability)))
    assert probability[1] <= probability[0]
    elsewhere = calibration.model_copy(update={"depth_range_mm": (300.0, 350.0)})
    with pytest.warns(DecodeWarning, match="of the code"):
        frame = Decoder(DecodeSettings(), elsewhere, arch="cpu").decode(image)
    assert not frame.absolute.any()


@pytest.mark.parametrize(("cycles", "cells"), [(2, 8), (4, 4)])
def test_small_surfaces_by_the_second_code(cycles, cells):
    """Plates before a wall, of 12 px a cycle and 6.2 px a cell: nearly all in linear light, half of them at gamma 2.

    None is wrong.
    """
    for gamma, least in ((1.0, 11), (2.0, 6)):
        truth, which = plates_before_a_wall(0, (6.2 * cells, 12.0 * cycles), gamma=gamma, code="contrast2")
        calibration = truth.rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
        frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(truth.image)
        off = np.abs(np.nan_to_num(frame.unwrapped_phase) - truth.phase) > np.pi
        assert not (frame.absolute & off & truth.mask).any()
        known = [(frame.absolute & (which == plate)).sum() / (which == plate).sum() for plate in range(1, 13)]
        assert sum(share > 0.8 for share in known) >= least


def moved(rig, along_px):
    """Return a calibration whose projector's picture lies so many px further along the stripe than it does."""
    matrix = rig.projector.matrix.copy()
    matrix[0 if rig.pattern.stripes == "horizontal" else 1, 2] += along_px
    return rig.model_copy(update={"projector": rig.projector.model_copy(update={"matrix": matrix})})


@pytest.mark.parametrize(
    ("scene", "stripes", "gamma"),
    [
        ("waves", "horizontal", 2.0),
        ("bust", "horizontal", 2.0),
        ("plane", "horizontal", 1.0),
        ("plane", "vertical", 2.0),
    ],
)
def test_a_pattern_that_lies_elsewhere_than_the_calibration_says(scene, stripes, gamma):
    """Along the stripe, by less than a quarter of a cell of 8.7 px it is read there; by more nothing is absolute."""
    truth, calibration = simulated(scene, "contrast2", stripes=stripes, size=FULL, gamma=gamma)
    settings = DecodeSettings(stripes=stripes)
    for along_px in (1, 2, 2.4, 4, 8, 16, -40):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DecodeWarning)
            frame = Decoder(settings, moved(calibration, along_px), arch="cpu").decode(truth.image)
        right, wrong = shares(frame, truth)
        assert wrong == 0
        if along_px < calibration.pattern.cell_px / 4 and along_px > 0:
            assert right > 0.97 and frame.warnings == ()
        else:
            (cause,) = frame.warnings
            assert cause.key == "rig moved" and not frame.absolute.any()
            said_px = float(re.search(r"lies ([0-9.]+) projector px along", cause)[1])
            assert said_px == pytest.approx(abs(along_px), abs=0.5)
        found_px = frame_report(frame, "a.png")["stripe_shift_px"]
        assert found_px == pytest.approx(-along_px, abs=0.5)


def test_what_was_absolute_is_no_more_after_the_rig_has_moved():
    truth, calibration = simulated("waves", "contrast2", size=FULL)
    decoder = Decoder(DecodeSettings(), calibration, arch="cpu")
    before = decoder.decode(truth.image)
    image = simulate_frame(moved(truth.rig, 16), SimulationSettings(scene="waves")).image
    with pytest.warns(DecodeWarning, match="have moved since"):
        after = decoder.decode(image, previous=before)
    assert before.absolute.any() and not after.absolute.any()


def test_the_second_code_needs_a_geometry_that_states_it():
    _, calibration = simulated("plane", "contrast2")
    light = calibration.model_copy(update=dict.fromkeys(("camera", "projector", "rotation", "translation_mm")))
    for known in (None, light, said(calibration, "contrast"), said(calibration, None)):
        with pytest.raises(SettingsError, match='"contrast2" is read by a geometry whose pattern states it') as error:
            Decoder(DecodeSettings(code="contrast2"), known, arch="cpu")
        assert "\n" not in str(error.value)
    with pytest.raises(SettingsError, match="read by a geometry"):
        Decoder(DecodeSettings(), light, arch="cpu")
    assert Decoder(DecodeSettings(code="none"), light, arch="cpu").state.code is None


def test_rays_that_meet_the_pattern_nowhere():
    """A camera that sees far more than the projector lights: at an eighth of the nodes no order has a column."""
    rig = simulated_rig(SIZE, code="contrast2")
    wide = rig.camera.matrix * np.array([[0.4, 1, 1], [1, 0.4, 1], [1, 1, 1]])
    pattern = rig.pattern.model_copy(update={"period_px": 40.0, "cell_px": 20.0})
    rig = rig.model_copy(update={"camera": rig.camera.model_copy(update={"matrix": wide}), "pattern": pattern})
    rays = rig.geometry().camera.rays().astype(np.float32)
    assert 0.05 < np.isnan(StripeColumns(rig.geometry(), rays).nodes).any(axis=-1).mean() < 0.5
    truth = simulate_frame(rig, SimulationSettings(scene="plane"))
    known = rig.model_copy(update={"crosstalk_matrix": SimulationSettings().crosstalk_matrix})
    right, wrong = shares(Decoder(DecodeSettings(), known, arch="cpu").decode(truth.image), truth)
    assert right > 0.95 and wrong == 0
