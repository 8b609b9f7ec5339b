"""What a frame gives reason to doubt is said in one line that names the cure."""

import numpy as np
import pytest

from pipeline.decoding.doubts import few_pixels_doubt, fringe_doubt, light_doubts, motion_doubts, over_exposure_doubt
from pipeline.decoding.frame_reader import LinearFrame
from pipeline.decoding.surface_search import NoModelFits
from tikernels.phase.color_fields import ColorFields
from tikernels.phase.field_motion import FieldMotion, RowMotion
from tikernels.phase.frame_statistics import FrameLevels


def fringes(axis, period_px=12):
    """Three sinusoids of some px a cycle along an axis."""
    place = np.indices((96, 96))[axis] * (2 * np.pi / period_px)
    waves = 120 + 80 * np.cos(place[..., None] + np.array([-1, 0, 1]) * 2 * np.pi / 3)
    return LinearFrame(waves.astype(np.uint8), 255.0)


def test_stripes_the_other_way_are_named(cpu):
    assert "a vertical one does: set stripes to 'vertical'" in fringe_doubt(fringes(axis=1), "horizontal", 253.0)


@pytest.mark.parametrize("period_px", [2.4, 3, 3.6])
def test_fringes_that_are_too_fine_are_named(cpu, period_px):
    said = fringe_doubt(fringes(axis=0, period_px=period_px), "horizontal", 253.0)
    assert f"the fringe has {period_px:.1f} px a cycle in this frame, and 4 are the least" in said


def test_a_fine_fringe_on_a_curved_surface_is_not_taken_for_the_other_direction(cpu):
    """Its period goes from 2.9 to 3.2 px down the frame, and it beats with the pixels."""
    y, x = np.indices((240, 320))
    phase = 2 * np.pi * (y / 3.2 + 0.00007 * y**2 + 0.0004 * x**2)
    waves = 120 + 80 * np.cos(phase[..., None] + np.array([-1, 0, 1]) * 2 * np.pi / 3)
    said = fringe_doubt(LinearFrame(waves.astype(np.uint8), 255.0), "horizontal", 253.0)
    assert "the fringe has 3.0 px a cycle" in said


def test_a_picture_of_next_to_nothing_says_what_it_lacks(cpu):
    levels = FrameLevels(255.0, 1.0, 0.0, 1.0, 5.0, 8.0, 10.0)
    grey = np.full((100, 100, 3), 120, np.uint8)
    over, dim = grey.copy(), grey // 8
    over[:40] = 255
    for image, cause in (
        (over, "40% of it is over-exposed"),
        (dim, "its brightest places reach 6% of full scale only"),
        (grey, "too little of a fringe stands out of the noise, 0.4% of full scale; the exposure is right"),
    ):
        frame = LinearFrame(image, 255.0)
        assert cause in few_pixels_doubt(frame, levels, 0.5, 100)
        assert "only 1.0% of this frame could be measured" in few_pixels_doubt(frame, levels, 0.5, 100)
        assert "nothing of this frame could be measured" in few_pixels_doubt(frame, levels, 0.5, 0)
        assert few_pixels_doubt(frame, levels, 0.5, 500) is None


def test_over_exposure_is_told_where_it_matters():
    assert over_exposure_doubt(0.08) is None
    assert over_exposure_doubt(0.171).startswith("17% of what is lit has a colour at full scale")


def test_a_small_thing_before_a_black_curtain_is_not_doubted(cpu):
    image = np.zeros((100, 100, 3), np.uint8)
    image[40:60, 40:50] = 120
    levels = FrameLevels(255.0, 1.0, 0.0, 1.0, 5.0, 8.0, 10.0)
    assert few_pixels_doubt(LinearFrame(image, 255.0), levels, 0.5, 180) is None
    assert "only 0.5%" in few_pixels_doubt(LinearFrame(image, 255.0), levels, 0.5, 50)


def test_noise_is_no_fine_fringe(cpu):
    noise = np.random.default_rng(0).integers(60, 180, (96, 96, 3)).astype(np.uint8)
    assert fringe_doubt(LinearFrame(noise, 255.0), "horizontal", 253.0).key == "no fringe"


@pytest.mark.parametrize(
    "contrast, mismatch, misfit, known, said",
    [
        (0.4, 0.01, 0.0, True, []),
        (0.05, 0.01, 0.0, True, ["contrast is only 5%"]),
        (0.4, 0.3, 0.02, True, ["differ by 30%"]),
        (0.4, 0.3, 0.0, False, []),  # nothing is known that it could contradict
        (0.05, 0.3, 0.0, True, ["contrast is only 5%", "differ by 30%"]),
        (
            0.4,
            0.01,
            0.03,
            True,
            ["colours of 40% of the surface, yellow above all, where phases may be off by about 0.06 rad"],
        ),
    ],
)
def test_the_light(contrast, mismatch, misfit, known, said):
    odd = NoModelFits(misfit, 0.4, "yellow") if misfit else None
    doubts = light_doubts(contrast, mismatch, odd, lambda: None, constant_known=known)
    assert len(doubts) == len(said)
    for doubt, part in zip(doubts, said, strict=True):
        assert part in doubt
    held = {"low contrast": contrast < 0.1, "other crosstalk": known and mismatch > 0.2}
    held["odd colours"] = odd is not None and not held["other crosstalk"]
    assert {doubt.key for doubt in doubts} == {key for key, holds in held.items() if holds}


@pytest.mark.parametrize(
    "change, unsure, too_fast, keys",
    [
        (0.3, 0.0, 0.0, set()),
        (0.3, 0.1, 0.0, {"fields unknown"}),
        (0.01, 0.1, 0.0, set()),  # nearly at rest
        (0.3, 0.0, 0.2, {"too fast"}),
    ],
)
def test_motion_between_colours(change, unsure, too_fast, keys):
    times = np.array([[[-0.1, 0.0, 0.1]]], np.float32)
    changes, unsures = np.full((8, 8), change, np.float32), np.full((1, 1), unsure, np.float32)
    motion = FieldMotion(changes, times, unsures, np.ones(64) / 64, too_fast)
    assert motion.guessed == 0 and motion._replace(doubt=1.0).guessed == (change > 0.1)
    doubts = motion_doubts(motion, None, ColorFields(0.5, shown=np.array([[0, 1], [1, 2], [2, 3]]) / 3), None)
    assert {doubt.key for doubt in doubts} == keys


@pytest.mark.parametrize("too_fast", [0.0, 0.2])
def test_motion_between_rows(too_fast):
    motion = RowMotion(np.zeros((8, 8), np.float32), np.zeros((8, 1), np.float32), too_fast)
    doubts = [str(doubt) for doubt in motion_doubts(None, motion, None, None)]
    assert len(doubts) == (too_fast > 0)
    assert all("20% of the surface" in doubt and "its rows, one after another" in doubt for doubt in doubts)


def test_what_it_costs_is_said_in_mm(cpu):
    said = [
        light_doubts(0.4, mismatch, odd, lambda: 7.0, constant_known=True)[0]
        for mismatch, odd in ((0.3, None), (0.0, NoModelFits(0.03, 1.0, "red")))
    ]
    assert "phases may be off by as much, 0.30 rad (2.1 mm): colorphase inspect" in said[0]
    assert "may be off by about 0.06 rad (0.42 mm). The frame does not show why: it is not the cross" in said[1]
