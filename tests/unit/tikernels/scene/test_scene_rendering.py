"""Simulated frames: the truth agrees with itself, and each fault looks as it should."""

from typing import Any

import numpy as np
import pytest
import reference

from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE, SimulatedFrame, SimulationSettings, simulate_frame
from pipeline.simulation import simulated_rig as rig
from tikernels.scene.scene_shapes import SHAPES

#: A rig without a fault: what is left is the light itself.
IDEAL: dict[str, Any] = {
    "gamma": 1.0,
    "crosstalk_matrix": np.eye(3),
    "reflectance": WHITE,
    "texture": 0.0,
    "noise_levels": 0.0,
    "bits": 16,
}


def photograph(scene: str = "plane", **faults: Any) -> SimulatedFrame:
    return simulate_frame(rig((320, 240)), SimulationSettings(**{**IDEAL, "scene": scene, **faults}))


def linear(frame: SimulatedFrame) -> np.ndarray:
    return frame.image / frame.white_level


def phase_error(frame: SimulatedFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return the plain arctangent's error and the true phase, rad, well inside what is lit, dark pixels left out."""
    inside = reference.eroded(frame.mask, 6) & (linear(frame).mean(axis=-1) > 20 / 255)
    found, _, _ = reference.compute_wrapped_phase(linear(frame))
    return reference.wrapped_difference(found, frame.phase)[inside], frame.phase[inside]


def error_harmonics(**faults: Any) -> np.ndarray:
    """Return a fault's constant, 1st, 2nd and 3rd harmonic on the plane, rad, as the arctangent sees them."""
    return reference.harmonics(*phase_error(photograph(**faults)))


@pytest.mark.parametrize("scene", SHAPES)
@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_an_ideal_frame_shows_its_phase(arch, scene, stripes):
    """The plain arctangent is right to 0.003 rad, 0.02 mm; exposed so that nothing clips."""
    settings = SimulationSettings(**{**IDEAL, "scene": scene, "exposure": 0.5})
    frame = simulate_frame(rig((320, 240), stripes=stripes), settings)
    error, _ = phase_error(frame)
    assert len(error) > 0.1 * frame.mask.size
    assert np.abs(error).max() < 0.003


@pytest.mark.parametrize("scene", SHAPES)
@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_points_project_to_the_phase(arch, scene, stripes):
    """Through both lenses, tilted and distorted, in float64: 1e-3 rad is 7 um."""
    made = rig(
        (160, 120), stripes=stripes, tilt_deg=4, camera_distortion=(0.05, -0.1, 0, 0, 0),
        projector_distortion=(-0.1, 0.05, 0.001, -0.002, 0.01),
    )  # fmt: skip
    frame = simulate_frame(made, SimulationSettings(**{**IDEAL, "scene": scene}))
    seen = ~np.isnan(frame.points[..., 2])
    expected = (
        2
        * np.pi
        / made.geometry().pattern.period_px
        * reference.projector_px(frame.points, made.geometry().for_triangulation())
    )
    np.testing.assert_allclose(frame.phase[seen], expected[seen], atol=1e-3)
    rays = frame.points[seen][:, :2] / frame.points[seen][:, 2:]
    np.testing.assert_allclose(rays, made.geometry().camera.rays()[seen], atol=1e-6)
    assert not frame.mask[~seen].any()


def test_the_plane_is_a_plane(arch):
    """Z = 900 + 0.25 x + 0.2 y; the tracer stops within a micrometre along its normal, float32 adds a tenth of one."""
    x, y, z = np.moveaxis(photograph("plane").points.astype(np.float64), -1, 0)
    assert np.abs(900 + 0.25 * x + 0.2 * y - z).max() < 2e-3


def test_the_wall_is_a_plane(arch):
    """Behind the ball: z = 985 + 0.06 x - 0.04 y."""
    points = photograph("ball").points.astype(np.float64)
    behind = np.hypot(points[..., 0], points[..., 1]) > 100
    x, y, z = np.moveaxis(points[behind], -1, 0)
    assert behind.sum() > 1000
    assert np.abs(985 + 0.06 * x - 0.04 * y - z).max() < 2e-3


def test_the_ball_is_round(arch):
    """85 mm around (0, 0, 880)."""
    points = photograph("ball").points.astype(np.float64)
    in_front = points[..., 2] < 880
    distance = np.linalg.norm(points[in_front] - [0, 0, 880], axis=-1)
    assert np.abs(distance - 85).max() < 2e-3


def test_shadows_and_gaps_are_not_lit(arch):
    """Objects before nothing: unlit pixels show ambient light or nothing at all."""
    frame = photograph("objects", ambient=0.0)
    assert 0.05 < frame.mask.mean() < 0.95
    assert linear(frame)[~frame.mask].max() == 0
    assert np.isnan(frame.points).any()


def test_the_same_seed_is_the_same_frame(arch):
    first, second, other = (photograph(noise_levels=1.5, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.image, second.image)
    assert (first.image != other.image).any()


def test_noise_has_its_deviation(arch):
    """1.5 levels of 255, to 2 %."""
    clean, noisy = photograph("plane"), photograph("plane", noise_levels=1.5)
    assert (linear(noisy) - linear(clean)).std() * 255 == pytest.approx(1.5, rel=0.02)


def test_an_ideal_frame_has_no_harmonics(arch):
    assert np.abs(error_harmonics()).max() < 5e-4


# Constant, 1st, 2nd and 3rd harmonic (rad) that faults are known by at 12 px a cycle. Amplitudes hang on ambient light
# and period, hence a third of freedom; what should be nothing stays below a tenth of what is named.
@pytest.mark.parametrize(
    "faults, expected",
    [
        ({"gamma": 2.0}, (0, 0, 0, 0.225)),
        ({"transfer": "srgb"}, (0, 0, 0, 0.153)),
        ({"gamma": 2.0, "crosstalk_matrix": np.array(TYPICAL_CROSSTALK)}, (None, None, 0.15, None)),
        ({"reflectance": (0.88, 0.8, 0.8), "ambient": 0.0}, (0, 0.072, 0.030, 0.002)),
        ({"exposure": 1.6, "ambient": 0.0}, (0, 0, 0, None)),
        ({"camera_shift_px": np.array([[0, 0.5], [0, 0], [0, -0.5]])}, (0, 0, 0.141, 0)),
        ({"projector_shift_px": np.array([[0, 0.727], [0, 0], [0, -0.727]])}, (0, 0, 0.141, 0)),
        ({"projector_blur_px": (1.86, 0.0, 0.0)}, (0, 0, 0.071, 0)),
    ],
    ids=["gamma", "sRGB", "crosstalk", "gain", "clipping", "camera colour", "projector colour", "defocus"],
)
def test_faults(arch, faults, expected):
    # 640 px across see 12 px a cycle; half the size would see six.
    frame = simulate_frame(rig(), SimulationSettings(**{**IDEAL, "scene": "plane", **faults}))
    found = reference.harmonics(*phase_error(frame))
    named = max((value for value in expected if value), default=0.1)
    for got, want in zip(found, expected, strict=True):
        if want is not None and want > 0.01:
            assert abs(got) == pytest.approx(want, rel=0.35)
        elif want is not None:
            assert abs(got) < 0.1 * named


def test_ambient_light_alone_bends_nothing(arch):
    assert np.abs(error_harmonics(ambient=0.3)).max() < 5e-4


def test_clipping_bends_the_third_harmonic(arch):
    """Peaks cut off at 70 % of full scale's light."""
    found = error_harmonics(exposure=1.6, ambient=0.0)
    assert found[3] > 10 * max(abs(found[0]), found[1], found[2]) > 0
    assert linear(photograph(exposure=1.6)).max() == 1


def test_motion_between_fields_is_a_depth_bias(arch):
    """Red, green and blue see a surface that comes nearer: a constant, what one field moves, and a 2nd harmonic."""
    moved = (0.0, 0.0, -0.7)  # mm a field; 0.138 rad a mm make it 0.1 rad
    constant, first, second, third = error_harmonics(field_motion_mm=moved)
    assert abs(constant) == pytest.approx(0.1, rel=0.35)
    assert second == pytest.approx(0.06, rel=0.35)
    assert max(first, third) < 0.01
    back = error_harmonics(field_motion_mm=(0.0, 0.0, 0.7))
    assert back[0] == pytest.approx(-constant, rel=0.1)


def test_narrow_bands_commute_with_the_crosstalk(arch):
    """Narrow primaries: M, then the reflectance's gains, is exact; broad ones need the gains first."""
    settings = {"crosstalk_matrix": np.array(TYPICAL_CROSSTALK), "reflectance": SKIN, "ambient": 0.0}
    for bands, gains_first in (("narrow", False), ("broad", True)):
        frame = photograph(reflectance_bands=bands, **settings)
        light = linear(frame)
        if gains_first:
            light = light / SKIN
        light = reference.correct_crosstalk(light, TYPICAL_CROSSTALK)
        if not gains_first:
            light = light / SKIN
        found, _, _ = reference.compute_wrapped_phase(light)
        error = reference.wrapped_difference(found, frame.phase)[reference.eroded(frame.mask, 6)]
        assert np.abs(error).max() < 0.003


def test_white_level_and_bits(arch):
    for bits in (8, 10, 12, 16):
        frame = photograph(bits=bits)
        assert frame.white_level == 2**bits - 1
        assert frame.image.dtype == (np.uint8 if bits == 8 else np.uint16)
        # The brightest half per cent reaches 0.9 of full scale.
        assert np.quantile(linear(frame), 0.995) == pytest.approx(0.9, abs=0.01)
