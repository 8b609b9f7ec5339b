"""Figures beside what they should be."""

import pytest

from pipeline.diagnosis.rig_check import BLIND_SPOTS, CheckResult, Measure


@pytest.mark.parametrize("measured, fine", [(0.0, True), (0.2, True), (0.201, False)])
def test_twice_the_prediction_is_fine_and_more_is_not(measured, fine):
    assert Measure("flatness", measured, 0.1, "mm").fine == fine


def test_one_figure_that_is_not_spoils_the_check():
    good, bad = Measure("flatness", 0.1, 0.1, "mm"), Measure("scale", 0.5, 0.1, "mm")
    assert CheckResult((good, good), None, None).fine
    assert not CheckResult((good, bad), None, None).fine


def test_every_kind_of_check_says_what_shows_more():
    assert BLIND_SPOTS.keys() == {"plane", "ball", "epipolar"}
    assert all("radius" in text for text in BLIND_SPOTS.values())
