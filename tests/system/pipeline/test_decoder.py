"""One frame through the decoder: accuracy against exact truth, inputs of every kind, and what it refuses."""

import threading
from functools import cache

import cv2
import numpy as np
import pytest
from support.exposures_off_cycle import FIELDS
from threadpoolctl import threadpool_info, threadpool_limits

import pipeline
import tikernels
from pipeline import Calibration, Decoder, DecodeSettings, DecodeWarning
from pipeline.calibration import ColorShift
from pipeline.errors import CalibrationError, FootageError, SettingsError
from pipeline.output.report import measure_against_truth
from pipeline.simulation import SKIN, WHITE, SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
from tikernels.errors import DeviceNotReady, ShapeError
from tikernels.scene.scene_shapes import SHAPES
from tikernels.traffic import traffic

pytestmark = pytest.mark.usefixtures("cpu")

SIZE = (320, 240)  # half the usual picture; at twice the pattern's period its fringes are as fine


def simulated(scene="bust", stripes="horizontal", tilt_deg=0.0, distortion=False, **settings):
    """Return a frame with its truth, and the calibration of its rig."""
    lens = {"camera_distortion": (-0.1, 0.05, 1e-3, -1e-3, 0.0), "projector_distortion": (-0.08, 0.02, 1e-3, 5e-4, 0.0)}
    rig = simulated_rig(
        SIZE, period_px=2 * 768 / 44, stripes=stripes, tilt_deg=tilt_deg, **(lens if distortion else {})
    )
    settings = SimulationSettings(scene=scene, **settings)
    frame = simulate_frame(rig, settings)
    return frame, rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})


def test_a_gpu_is_asked_little(arch):
    """The goal for a plain frame: 12 calls of kernels, one wait, the frame sent once and the results read once."""
    truth, _ = simulated("plane")
    decoder = Decoder(DecodeSettings(crosstalk_matrix=SimulationSettings().crosstalk_matrix), arch=arch)
    decoder.decode(truth.image)
    traffic.clear()
    frame = decoder.decode(truth.image)
    results = frame.unwrapped_phase.nbytes + frame.mask.nbytes
    if arch == "cpu":
        assert traffic.calls <= 57  # six turns of one kernel, which is compiled in a sixth of the time
    else:
        assert traffic.calls <= 52
        assert traffic.copied_calls <= 2
        assert traffic.reads <= 22
        assert traffic.sent_bytes < truth.image.nbytes + 30_000
        assert traffic.read_bytes < results + 1_700_000


@pytest.mark.parametrize("scene", SHAPES)
@pytest.mark.parametrize(("gamma", "reflectance"), [(2.0, SKIN), (1.0, WHITE)])
def test_accuracy_on_every_scene(arch, scene, gamma, reflectance):
    truth, calibration = simulated(scene, gamma=gamma, reflectance=reflectance)
    frame = Decoder(DecodeSettings(), calibration, arch=arch).decode(truth.image)
    measured = measure_against_truth(frame, truth)
    assert measured["phase_rms_rad"] < 0.05  # 0.36 mm on this rig at the usual period
    assert abs(measured["phase_constant_rad"]) < 0.015
    # The bust touches the wall at a step of a whole cycle here and there: cells that hold one are left out.
    assert measured["coverage"] > (0.945 if scene == "bust" else 0.95)
    # Where the bust happens to be a whole cycle before the wall, a cell beside it may be in the wrong one's region.
    assert measured["wrong_orders"] <= (0.001 if scene == "bust" else 0) * frame.mask.sum()
    # The period is twice the usual one, so a radian is twice as deep; and a cycle 90 mm.
    assert measured["depth_rms_order_known_mm"] < (3.0 if scene == "bust" else 1.0)


@pytest.mark.parametrize(
    ("stripes", "tilt_deg", "distortion"),
    [("vertical", 0, False), ("horizontal", 20, False), ("vertical", -20, False), ("horizontal", 0, True)],
)
def test_stripes_tilt_and_distortion(stripes, tilt_deg, distortion):
    truth, calibration = simulated("waves", stripes, tilt_deg, distortion)
    frame = Decoder(DecodeSettings(stripes=stripes), calibration, arch="cpu").decode(truth.image)
    measured = measure_against_truth(frame, truth)
    assert measured["phase_rms_rad"] < 0.05
    assert measured["wrong_orders"] == 0
    assert measured["coverage"] > 0.97
    assert measured["depth_rms_order_known_mm"] < 1.0


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_bit_depths(bits):
    truth, calibration = simulated("plane", bits=bits)
    white_level = None if bits in (8, 16) else float(2**bits - 1)
    settings = DecodeSettings(white_level=white_level)
    measured = measure_against_truth(Decoder(settings, calibration, arch="cpu").decode(truth.image), truth)
    assert measured["phase_rms_rad"] < 0.04


def test_float_input_and_srgb():
    truth, calibration = simulated("plane", transfer="srgb", gamma=1.0)
    image = (truth.image / 255).astype(np.float32)
    settings = ({"transfer": "srgb"}, {"transfer": "srgb", "equalize": False}, {"equalize": False})
    good, undone, ignored = (
        measure_against_truth(Decoder(DecodeSettings(**s), calibration, arch="cpu").decode(image), truth)[
            "phase_rms_rad"
        ]
        for s in settings
    )
    assert good < 0.03
    assert undone < 0.03
    assert ignored > 1.5 * undone  # the curve left in bends the phase three times a cycle


def test_narrow_bands_want_the_crosstalk_undone_first():
    truth, calibration = simulated("plane", reflectance_bands="narrow", reflectance=(0.8, 0.5, 0.35), texture=0.0)
    constants = {}
    for bands in ("broad", "narrow"):
        frame = Decoder(DecodeSettings(reflectance_bands=bands), calibration, arch="cpu").decode(truth.image)
        constants[bands] = abs(measure_against_truth(frame, truth)["phase_constant_rad"])
    assert constants["narrow"] < 0.01 < constants["broad"]


def test_fields_agree():
    truth, calibration = simulated("bust")
    frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(truth.image)
    mask = frame.mask
    for field in (frame.wrapped_phase, frame.unwrapped_phase, frame.range_image):
        np.testing.assert_array_equal(np.isnan(field), ~mask)
    assert np.abs(frame.wrapped_phase[mask]).max() <= np.pi + 1e-6
    rebuilt = frame.wrapped_phase + 2 * np.pi * frame.fringe_order
    np.testing.assert_allclose(rebuilt[mask], frame.unwrapped_phase[mask], atol=1e-4)  # float32 of some 300 rad
    assert not frame.fringe_order[~mask].any()
    np.testing.assert_array_equal(frame.region > 0, mask)
    sizes = np.bincount(frame.region.ravel())[1:]
    assert (np.diff(sizes) <= 0).all()
    assert not frame.absolute.any()
    np.testing.assert_array_equal(frame.range_image[mask], frame.points[..., 2][mask])
    assert frame.region.dtype == frame.fringe_order.dtype == np.int32


def test_without_a_calibration_the_range_is_relative():
    truth, _ = simulated("waves")
    plane, _ = simulated("plane")
    settings = DecodeSettings(crosstalk_matrix=SimulationSettings().crosstalk_matrix)
    frame = Decoder(settings, arch="cpu").decode(truth.image)
    assert frame.points is None
    mask = frame.mask
    y, x = np.nonzero(mask)
    ramp = np.linalg.lstsq(np.stack([y, x, np.ones(len(y))], axis=1), frame.unwrapped_phase[mask].astype(float))[0]
    expected = frame.unwrapped_phase[mask] - (ramp[0] * y + ramp[1] * x + ramp[2])
    np.testing.assert_allclose(frame.range_image[mask], expected, atol=1e-3)
    reference = Decoder(settings, arch="cpu").decode(plane.image)
    against = Decoder(settings, reference=reference, arch="cpu").decode(truth.image)
    both = against.mask & reference.mask
    difference = frame.unwrapped_phase[both] - reference.unwrapped_phase[both]
    np.testing.assert_allclose(against.range_image[both], difference, atol=1e-4)


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_where_the_lens_folds_nothing_is_measured(arch, stripes):
    """And that is said; all else is as exact as with any lens, though the corners show a fringe, too."""
    rig = simulated_rig(SIZE, period_px=2 * 768 / 44, stripes=stripes, camera_distortion=(-1.6, 0.0, 0.0, 0.0, 0.0))
    settings = SimulationSettings(scene="waves")
    truth = simulate_frame(rig, settings)
    blind = np.isnan(rig.camera.rays()[..., 0])
    image = truth.image.copy()
    image[:60, :80][blind[:60, :80]] = image[90:150, 120:200][blind[:60, :80]]
    decoder = Decoder(DecodeSettings(stripes=stripes, crosstalk_matrix=settings.crosstalk_matrix), rig, arch=arch)
    with pytest.warns(DecodeWarning, match=rf"^{blind.sum()} pixels \(0.9%\) are left out, .* its lens folds"):
        frame = decoder.decode(image)
    assert not frame.mask[blind].any() and np.isfinite(frame.points[frame.mask]).all()
    measured = measure_against_truth(frame, truth)
    assert measured["wrong_orders"] == 0 and measured["coverage"] > 0.97
    assert measured["depth_rms_order_known_mm"] < 1.0


def test_the_depth_range_chooses_the_order():
    truth, calibration = simulated("plane")
    depth = truth.points[..., 2]
    middle = float(np.nanmedian(depth))
    for offset in (-200.0, 0.0, 200.0):
        ranged = calibration.model_copy(update={"depth_range_mm": (middle + offset - 250, middle + offset + 250)})
        frame = Decoder(DecodeSettings(), ranged, arch="cpu").decode(truth.image)
        # A cycle is some 90 mm here: the order nearest to the middle lies within half of it.
        assert abs(np.nanmedian(frame.range_image) - middle - offset) < 60


def test_out_is_used_again_and_frames_are_fresh():
    first, calibration = simulated("plane", seed=1)
    second, _ = simulated("bust", seed=2)
    decoder = Decoder(DecodeSettings(), calibration, arch="cpu")
    one = decoder.decode(first.image)
    kept = one.unwrapped_phase.copy()
    two = decoder.decode(second.image)
    np.testing.assert_array_equal(one.unwrapped_phase, kept)
    assert two.mask.sum() != one.mask.sum()
    again = decoder.decode(second.image, out=one)
    assert again is one
    np.testing.assert_array_equal(one.unwrapped_phase, two.unwrapped_phase)
    np.testing.assert_array_equal(one.region, two.region)


def test_input_is_left_alone_and_may_be_any_layout(arch):
    truth, calibration = simulated("plane")
    decoder = Decoder(DecodeSettings(), calibration, arch=arch)
    expected = decoder.decode(truth.image).unwrapped_phase
    frozen = truth.image.copy()
    frozen.setflags(write=False)
    bgr = np.ascontiguousarray(truth.image[..., ::-1])
    for image in (frozen, bgr[..., ::-1], np.asfortranarray(truth.image)):
        np.testing.assert_array_equal(decoder.decode(image).unwrapped_phase, expected)
    np.testing.assert_array_equal(frozen, truth.image)


def test_two_runs_are_bit_identical(arch):
    truth, calibration = simulated("bust")
    runs = [Decoder(DecodeSettings(), calibration, arch=arch).decode(truth.image) for _ in range(2)]
    for name in ("wrapped_phase", "fringe_order", "mask", "region", "points"):
        np.testing.assert_array_equal(getattr(runs[0], name), getattr(runs[1], name))


@pytest.mark.parametrize("level", [0, 90, 255])
def test_no_fringe_gives_an_empty_mask_and_a_warning(level):
    image = np.full((64, 80, 3), level, np.uint8)
    with pytest.warns(DecodeWarning, match="no fringe stands out"):
        frame = Decoder(DecodeSettings(), arch="cpu").decode(image)
    assert not frame.mask.any()
    assert np.isnan(frame.unwrapped_phase).all()
    assert np.isnan(frame.range_image).all()
    assert frame.period_px is None


@pytest.mark.parametrize("color", [(9, 13.5, 11.6), (20, 28, 24)])
def test_beyond_the_projectors_picture_nothing_is_measured(color):
    """Even light in a lit room; a few pixels at the border may be taken."""
    rig = simulated_rig((480, 360))
    frame = simulate_frame(rig, SimulationSettings(scene="plane", noise_levels=0.8))
    image, noise = frame.image.astype(float), np.random.default_rng(0).normal(0, 0.8, (72, 480, 3))
    image[288:] = color + noise
    mask = Decoder(DecodeSettings(), rig, arch="cpu").decode(np.clip(np.rint(image), 0, 255).astype(np.uint8)).mask
    assert mask[304:].mean() < 0.02 and mask[10:284].mean() > 0.99


def test_noise_is_no_fringe():
    image = np.random.default_rng(3).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    with pytest.warns(DecodeWarning, match="no fringe stands out"):
        assert not Decoder(DecodeSettings(), arch="cpu").decode(image).mask.any()


def test_the_other_direction_is_named():
    truth, _ = simulated("plane", "vertical")
    with pytest.warns(DecodeWarning, match="set stripes to 'vertical'"):
        Decoder(DecodeSettings(), arch="cpu").decode(truth.image)


def test_a_given_period_is_used():
    truth, _ = simulated("plane")
    frame = Decoder(DecodeSettings(camera_period_px=11.0), arch="cpu").decode(truth.image)
    assert frame.period_px == 11.0
    assert frame.mask.mean() > 0.9


def good_image():
    return np.random.default_rng(0).random((32, 40, 3)).astype(np.float32)


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (good_image()[..., 0], ShapeError, "grey"),
        (good_image()[..., :1], ShapeError, "grey"),
        (np.dstack([good_image(), good_image()[..., :1]]), ShapeError, "transparency"),
        (good_image()[:0], ShapeError, "at least 16x16"),
        (good_image()[:1, :1], ShapeError, "1x1"),
        (good_image().astype(np.int32), ShapeError, "int32"),
        (good_image().tolist(), ShapeError, "list"),
        (np.where(good_image() > 0.9, np.nan, good_image()).astype(np.float32), FootageError, "NaN"),
        (good_image() * 255, FootageError, r"outside 0\.\.1"),
        (good_image() - 1, FootageError, r"outside 0\.\.1"),
    ],
)
def test_bad_images_get_one_line(image, error, message):
    with pytest.raises(error, match=message) as raised:
        Decoder(DecodeSettings(), arch="cpu").decode(image)
    assert "\n" not in str(raised.value)


def test_values_above_the_white_level():
    image = np.full((32, 32, 3), 2000, np.uint16)
    with pytest.raises(FootageError, match=r"outside 0\.\.1023"):
        Decoder(DecodeSettings(white_level=1023), arch="cpu").decode(image)


def test_a_calibration_of_another_size():
    _, calibration = simulated("plane")
    with pytest.raises(CalibrationError, match="640x480 but the calibration is for 320x240: its sides are 2x2 times"):
        Decoder(DecodeSettings(), calibration, arch="cpu").decode(np.zeros((480, 640, 3), np.uint8))


def test_settings_and_calibration_that_contradict():
    _, calibration = simulated("plane", "vertical")
    with pytest.raises(SettingsError, match="vertical"):
        Decoder(DecodeSettings(), calibration, arch="cpu")


def test_parallel_axes_need_a_depth_range():
    _, calibration = simulated("plane")
    parallel = calibration.model_copy(update={"rotation": np.eye(3), "translation_mm": np.array([0.0, 180.0, 0.0])})
    with pytest.raises(CalibrationError, match="depth_range_mm"):
        Decoder(DecodeSettings(), parallel, arch="cpu")
    Decoder(DecodeSettings(), parallel.model_copy(update={"depth_range_mm": (500.0, 900.0)}), arch="cpu")


def test_an_out_of_another_size():
    truth, _ = simulated("plane")
    decoder = Decoder(DecodeSettings(), arch="cpu")
    frame = decoder.decode(truth.image)
    with pytest.raises(ShapeError, match="another size"):
        decoder.decode(np.ascontiguousarray(truth.image[:-8]), out=frame)


def test_an_arch_that_the_machine_lacks():
    missing = next(arch for arch in ("cuda", "metal") if arch not in tikernels.supported_archs())
    with pytest.raises(DeviceNotReady, match="cannot be started here"):
        Decoder(DecodeSettings(), arch=missing)
    tikernels.init("cpu")  # what failed to start has ended what ran


def test_device_arrays_are_taken(arch):
    truth, calibration = simulated("plane")
    decoder = Decoder(DecodeSettings(), calibration, arch=arch)
    from tikernels._taichi import ti

    on_device = ti.ndarray(ti.f32, truth.image.shape)
    on_device.from_numpy((truth.image / 255).astype(np.float32))
    frame = decoder.decode(on_device)
    expected = decoder.decode((truth.image / 255).astype(np.float32))
    np.testing.assert_array_equal(frame.unwrapped_phase, expected.unwrapped_phase)


def test_exported_names():
    """The names of the contract."""
    assert {"Calibration", "DecodeSettings", "Decoder"} <= set(pipeline.__all__)
    assert Calibration.model_fields.keys() >= {"camera", "projector", "rotation", "translation_mm", "pattern"}


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_sigma_is_what_the_errors_are(stripes):
    """Of the errors 68 % lie within one sigma and 95 % within two, to a few per cent; in mm as in rad."""
    truth, calibration = simulated("plane", stripes)
    for smoothing in (0, 5):
        settings = DecodeSettings(
            stripes=stripes, smoothing_px=smoothing, crosstalk_matrix=SimulationSettings().crosstalk_matrix
        )
        frame = Decoder(settings, calibration, arch="cpu").decode(truth.image)
        error = np.angle(np.exp(1j * (frame.wrapped_phase - truth.phase)))[frame.mask]
        pull = np.abs(error - np.median(error)) / frame.phase_sigma[frame.mask]
        assert 0.60 < (pull < 1).mean() < 0.78
        assert 0.89 < (pull < 2).mean() < 0.98
        along = np.linalg.norm(frame.points - truth.points, axis=-1)[frame.mask]
        if np.median(along) < 5:  # the order is right
            assert 0.5 < np.median(along / frame.point_sigma[frame.mask]) / 0.6745 < 2
    assert np.isnan(frame.phase_sigma[~frame.mask]).all()


@pytest.mark.filterwarnings("ignore:no matrix explains")  # it is at the limit of what is named
def test_lateral_colour_is_undone():
    """Half a pixel in the camera and one in the projector bend the phase by 0.2 rad; known, they do not."""
    camera = np.array([[0.1, -0.5], [0.0, 0.0], [-0.1, 0.5]])
    projector = np.array([[0.3, -0.6], [0.0, 0.0], [-0.3, 0.6]])
    rig = simulated_rig()
    settings = SimulationSettings(scene="plane", gamma=1.0, camera_shift_px=camera, projector_shift_px=projector)
    truth = simulate_frame(rig, settings)
    errors = []
    for shift in (None, ColorShift(camera=camera, projector=projector)):
        known = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix, "color_shift_px": shift})
        # Equalisation would hide it.
        frame = Decoder(DecodeSettings(equalize=False), known, arch="cpu").decode(truth.image)
        inside = (slice(8, -8), slice(8, -8))
        error = np.exp(1j * (frame.wrapped_phase - truth.phase)[inside][frame.mask[inside]])
        errors.append(np.sqrt((np.angle(error / error.mean()) ** 2).mean()))
    assert errors[0] > 0.1
    assert errors[1] < 0.03


def test_motion_between_colours_in_turns_is_undone():
    """A ball that comes 0.7 mm nearer from colour to colour, in the third frame, against the same ball at rest."""
    step = -0.7

    def photograph(nearer: float, moving: float = 0.0):
        moved = {"object_motion_mm": (0, 0, nearer), "field_motion_mm": (0, 0, moving)}
        return simulated("ball", noise_levels=0.0, **moved)[0]

    rig = simulated()[1]
    film, rest = [photograph(3 * step * k, step).image for k in range(3)], photograph(7 * step)
    truth = Decoder(calibration=rig, arch="cpu").decode(rest.image)
    moves = np.abs(rest.phase - photograph(0.0).phase) > 0.2
    ball = cv2.erode(moves.astype(np.uint8), np.ones((15, 15))) > 0
    errors = []
    for fields in ({}, FIELDS):
        decoder, seen = Decoder(DecodeSettings(**fields), rig, arch="cpu"), None
        for image in film:
            seen = decoder.decode(image, previous=seen)
        error = np.angle(np.exp(1j * (seen.wrapped_phase - truth.wrapped_phase)))[ball & seen.mask & truth.mask]
        errors.append(error.std())
    assert errors[0] > 0.02
    assert errors[1] < 0.3 * errors[0]


def test_after_a_dropped_frame_motion_is_that_of_two():
    """The ball of the film above, of which the second frame is missing."""
    step = -0.7

    def photograph(nearer: float, moving: float = 0.0):
        moved = {"object_motion_mm": (0, 0, nearer), "field_motion_mm": (0, 0, moving)}
        return simulated("ball", noise_levels=0.0, **moved)[0]

    rig, rest = simulated()[1], photograph(7 * step)
    ball = np.abs(rest.phase - photograph(0.0).phase) > 0.2
    ball = cv2.erode(ball.astype(np.uint8), np.ones((15, 15))) > 0
    errors = []
    for elapsed in (1.0, 2.0):
        decoder = Decoder(DecodeSettings(**FIELDS), rig, arch="cpu")
        before = decoder.decode(photograph(0.0, step).image)
        seen = decoder.decode(photograph(6 * step, step).image, previous=before, elapsed=elapsed)
        error = np.angle(np.exp(1j * (seen.wrapped_phase - rest.phase)))[ball & seen.mask]
        errors.append(abs((error * np.exp(-2j * rest.phase[ball & seen.mask])).mean()))
    assert errors[0] > 0.005
    assert errors[1] < 0.3 * errors[0]
    with pytest.raises(SettingsError, match="elapsed is 0"):
        decoder.decode(rest.image, previous=before, elapsed=0)


@cache
def approaching(stripes: str) -> list[SimulatedFrame]:
    """Return a bust that comes nearer by 500 mm/s, ten times per frame of 1/60 s."""
    places = [(0, 0, 10 - step / 1.2) for step in range(40)]
    still = {"stripes": stripes, "noise_levels": 0.0, "crosstalk_matrix": np.eye(3)}
    return [simulated(object_motion_mm=place, **still)[0] for place in places]


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
@pytest.mark.parametrize("fields", [None, FIELDS["fields"]], ids=["at once", "in turn"])
def test_rows_of_a_rolling_shutter_are_carried_to_the_time_of_the_middle_one(stripes, fields):
    """The last row is exposed 14 ms after the first, 7 mm nearer; between instants light changes linearly."""
    at, row_s = approaching(stripes), 0.84 / (SIZE[1] - 1)  # frames
    settings = DecodeSettings(stripes=stripes, frame_s=1.0, row_s=row_s, fields=fields)
    rows = row_s * (np.arange(SIZE[1]) - (SIZE[1] - 1) / 2)[:, None]
    seen_at = rows + (0 if settings.fields is None else settings.fields.in_cycles(1.0, row_s).times(SIZE[1])[0])
    light = np.stack([frame.image for frame in at]).astype(np.float32) / 255
    film = []
    for number in (1, 2, 3):
        place = 10 * (number + np.broadcast_to(seen_at, (SIZE[1], 3)))
        film.append(np.zeros(light.shape[1:], np.float32))
        for instant, image in enumerate(light):
            film[-1] += np.clip(1 - np.abs(place - instant), 0, None).astype(np.float32)[:, None] * image
    change = 10 * (at[31].phase - at[30].phase)
    bust = cv2.erode((np.abs(change) > 0.5).astype(np.uint8), np.ones((15, 15))) > 0
    left = []
    for known in ({}, {"frame_s": None, "fields": None}):
        decoder, seen = Decoder(settings.model_copy(update=known), at[0].rig, arch="cpu"), None
        for image in film:
            seen = decoder.decode(image, previous=seen)
        inside, skew = bust & seen.mask, change * rows
        error = np.angle(np.exp(1j * (seen.wrapped_phase - at[30].phase)))[inside]
        left.append((error * skew[inside]).sum() / (skew[inside] ** 2).sum())
    assert abs(left[0]) < 0.1
    assert left[1] > 0.9


@pytest.mark.parametrize("leak, bound", [(0.0, 0.004), (0.05, 0.08)])
def test_the_constant_says_how_far_it_may_be_off(arch, leak, bound):
    """Crosstalk that is not as calibrated turns the phase, and shows in the channels' waves."""
    truth, calibration = simulated("plane", "horizontal")
    matrix = SimulationSettings().crosstalk_matrix + leak * np.array([[0, 1, 0], [0, 0, 0], [0, 0, 0]])
    known = calibration.model_copy(update={"crosstalk_matrix": matrix})
    frame = Decoder(DecodeSettings(), known, arch=arch).decode(truth.image)
    constant = np.angle(np.exp(1j * (frame.wrapped_phase - truth.phase)[frame.mask]).mean())
    assert abs(constant) < 2 * frame.constant_sigma < bound
    assert (abs(constant) > 0.008) == (leak > 0)


@pytest.mark.parametrize("white", [1.0, 255.0, 2.0**24])
def test_a_frame_said_to_be_free_of_noise_has_a_sigma(white):
    truth, _ = simulated()
    image = (truth.image * np.float32(white / 255)).astype(np.float32)
    frame = Decoder(DecodeSettings(noise=(0, 0), white_level=white), arch="cpu").decode(image)
    assert frame.mask.mean() > 0.5
    sigma = frame.phase_sigma[frame.mask]
    assert np.isfinite(sigma).all() and sigma.min() > 0
    assert np.median(sigma) < 0.02  # rad


def test_what_rims_lose_is_not_counted_as_measured():
    """In noise this strong regions hold a fifth of the frame, nearly all of it rims, which leave the mask."""
    rig = simulated_rig((160, 120), period_px=2 * 768 / 44)
    image = simulate_frame(rig, SimulationSettings(scene="plane", noise_levels=20.0, seed=1)).image
    with pytest.warns(DecodeWarning, match=r"only \d\..% of this frame could be measured: too little of a fringe"):
        frame = Decoder(DecodeSettings(), arch="cpu").decode(image)
    assert frame.measured_px == frame.mask.sum() > 0


def test_a_frame_in_which_nothing_counts_may_follow_another_one():
    truth, _ = simulated()
    decoder = Decoder(DecodeSettings(min_modulation=200.0), arch="cpu")
    with pytest.warns(DecodeWarning, match="nothing of this frame could be measured"):
        first = decoder.decode(truth.image)
    with pytest.warns(DecodeWarning, match="nothing of this frame could be measured"):
        second = decoder.decode(truth.image, previous=first)
    assert not first.mask.any() and not second.mask.any()


def test_without_crosstalk_the_constant_is_open(arch):
    truth, calibration = simulated("plane", "horizontal")
    known = calibration.model_copy(update={"crosstalk_matrix": None})
    settings = DecodeSettings(reflectance_bands="narrow")
    assert Decoder(settings, known, arch=arch).decode(truth.image).constant_sigma > 0.05
    with pytest.warns(DecodeWarning, match="no fringe"):
        assert np.isnan(Decoder(settings, known, arch=arch).decode(np.zeros_like(truth.image)).constant_sigma)


def test_levels_are_those_of_the_input(arch):
    """A frame that the camera has encoded gives its modulation in the same levels as one that it has not."""
    truth, calibration = simulated("plane", "horizontal", gamma=1.0, noise_levels=0.0)
    encoded, _ = simulated("plane", "horizontal", gamma=1.0, noise_levels=0.0, transfer="srgb")
    plain = Decoder(DecodeSettings(), calibration, arch=arch).decode(truth.image)
    linear = Decoder(DecodeSettings(transfer="srgb"), calibration, arch=arch).decode(encoded.image)
    assert np.median(linear.modulation) == pytest.approx(np.median(plain.modulation), rel=0.05)


@pytest.mark.parametrize(("given", "low", "high"), [(False, 0.54, 0.82), (True, 0.6, 0.76)])
def test_sigma_of_photons(arch, given, low, high):
    """Noise that grows with the light: sigma holds for dark pixels as for bright ones."""
    truth, calibration = simulated("ball", "horizontal", noise_levels=0.0, bits=16, ambient=0.02)
    light = truth.image / 257.0
    noisy = light + np.sqrt(0.5**2 + 0.1 * light) * np.random.default_rng(4).standard_normal(light.shape)
    settings = DecodeSettings(smoothing_px=0, noise=(0.58, 0.1) if given else None)
    frame = Decoder(settings, calibration, arch=arch).decode(np.clip(np.rint(noisy), 0, 255).astype(np.uint8))
    inside = cv2.erode((frame.mask & truth.mask).astype(np.uint8), np.ones((9, 9))) > 0
    error = np.angle(np.exp(1j * (frame.wrapped_phase - truth.phase)))
    pull = np.abs(error - np.median(error[inside])) / frame.phase_sigma
    dark = frame.modulation < np.quantile(frame.modulation[inside], 0.25)
    for part in (inside & dark, inside & ~dark):
        assert low < (pull[part] < 1).mean() < high


def test_what_the_light_gives_away(arch):
    truth, calibration = simulated("plane", "horizontal", ambient=8.0)
    with pytest.warns(DecodeWarning, match="contrast is only"):
        Decoder(DecodeSettings(), calibration, arch=arch).decode(truth.image)
    truth, calibration = simulated("plane", "horizontal")
    wrong = calibration.model_copy(update={"crosstalk_matrix": np.eye(3)})
    with pytest.warns(DecodeWarning, match="fringes differ by .* calibrate check"):
        Decoder(DecodeSettings(), wrong, arch=arch).decode(truth.image)


@pytest.mark.parametrize("room", [20, 30])
@pytest.mark.parametrize("calibrated", [False, True])
def test_a_lit_room_around_objects_is_no_surface(arch, room, calibrated):
    """Three quarters of the frame have no fringe but the light of the room, of 255 levels so many."""
    truth, calibration = simulated("objects", "horizontal", noise_levels=1.0)
    image = truth.image * (1 - room / 255) + room * np.array([0.9, 1.1, 1.0])
    image = image + np.random.default_rng(1).normal(0, 0.5, image.shape)
    frame = Decoder(DecodeSettings(), calibration if calibrated else None, arch=arch).decode(
        np.clip(np.rint(image), 0, 255).astype(np.uint8)
    )
    assert frame.mask[truth.mask].mean() > 0.83  # 0.84 to 0.87, by the noise
    assert (frame.mask & ~truth.mask).sum() < 0.01 * (~truth.mask).sum()


def test_one_decoder_may_be_called_from_several_threads(arch):
    """And what it gives may be looked at from any, whenever that is."""
    fields = ("unwrapped_phase", "mask", "modulation", "region", "phase_sigma", "points", "point_sigma")
    rig = simulated_rig((160, 120), period_px=2 * 768 / 44)
    light = SimulationSettings()
    images = [np.roll(simulate_frame(rig, light).image, 9 * number, axis=1) for number in range(3)]
    decoder = Decoder(DecodeSettings(crosstalk_matrix=light.crosstalk_matrix), rig, arch=arch)
    frames = [decoder.decode(image) for image in images]
    alone = [{name: np.array(getattr(frame, name)) for name in fields} for frame in frames]
    count = 8 if arch == "cpu" else 3  # where a frame takes two seconds
    wrong, failures = [], []

    def decode_some(seed):
        rng = np.random.default_rng(seed)
        try:
            for number in rng.integers(len(images), size=count):
                frame = decoder.decode(images[number])
                for name in rng.permutation(fields):
                    if not np.array_equal(getattr(frame, name), alone[number][name], equal_nan=name != "mask"):
                        wrong.append((number, name))
        except Exception as error:
            failures.append(error)

    threads = [threading.Thread(target=decode_some, args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (wrong, failures) == ([], [])


def test_linear_algebra_has_one_thread_while_a_frame_is_decoded(cpu):
    """What it had before it has again, also after an error."""
    seen = []

    def threads():
        return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}

    class Watching:
        def unwrap(self, phase, quality):
            seen.append(threads())
            raise ValueError("seen enough")

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        with pytest.raises(ValueError, match="seen enough"):
            Decoder(arch="cpu", unwrapper=Watching()).decode(simulated("plane")[0].image)
        assert seen == [{1}] and threads() == before
