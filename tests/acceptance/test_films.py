"""Frames of films show what is said to be true of them, at rest and in motion."""

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks" / "rendered"))

import numpy as np
import pytest
from drawn_frames import Photographer
from filmed import FILMS, Filming, film_rigs
from films import judge
from ray_caster import true_at_centers

pytestmark = pytest.mark.usefixtures("cpu")
_RIGS = film_rigs(0)


@pytest.fixture(scope="module")
def filming():
    """Film before a rig; the webcams have one photographer."""
    photographers = {}

    def of(rig: str, film: str, speed_mm_s: float) -> Filming:
        drawn, shutter = _RIGS[rig]
        kind = "led" if rig == "led" else "webcam"
        if kind not in photographers:
            photographers[kind] = Photographer(drawn, 4)
        return Filming(photographers[kind], shutter, FILMS[film](drawn, 0), speed_mm_s, 0)

    return of


@pytest.mark.parametrize("rig", _RIGS)
def test_light_and_times_of_the_primaries_add_up(rig):
    """Each primary's weights sum to one, and the mean time of the three is the middle of a row's exposure."""
    _, shutter = _RIGS[rig]
    starts = shutter.row_starts(7, 480)
    instants = np.linspace(starts[0], starts[-1] + shutter.exposure_s, 9)
    weights = shutter.weights(starts, instants)
    assert np.allclose(weights.sum(axis=0), 1, atol=1e-9)
    times = np.einsum("krc,k->rc", weights, instants).mean(axis=1)
    assert np.allclose(times, starts + 0.5 * shutter.exposure_s, atol=1e-9)


@pytest.mark.parametrize(("rig", "most_mm"), [("led", 0.45), ("single-chip webcam 360", 0.7)])
def test_a_still_film_is_decoded_to_its_truth(filming, rig, most_mm):
    """As well as the camera's noise, and the webcam's MJPEG, leave it."""
    verdict = judge(filming(rig, "waving cloth", 0.0), 3, None)
    assert verdict.known.summary()[0] < most_mm
    assert verdict.counts["right"] > 0.9 * verdict.counts["judged"] > 0


@pytest.mark.parametrize("rig", ["single-chip webcam 180", "single-chip webcam 360"])
def test_at_rest_it_does_not_matter_when_the_colours_are_shown(filming, rig):
    in_turn = filming(rig, "rolling ball", 0.0)
    at_once = Filming(in_turn.photographer, replace(in_turn.shutter, cycle_s=None), in_turn.film, 0.0, 0)
    one, other = (film.exposed(0)[0] for film in (in_turn, at_once))
    assert np.abs(one - other).max() < 1e-5 * one.max()


def test_the_truth_of_a_moving_frame_is_that_of_a_still_one_when_its_middle_row_is_exposed(filming):
    moving = filming("single-chip webcam 180", "rolling ball", 200.0)
    _, truth, inside = moving.exposed(2)
    shutter, film = moving.shutter, moving.film
    middle_s = shutter.row_starts(2, len(inside)).mean() + 0.5 * shutter.exposure_s
    still = true_at_centers(moving.photographer.geometry, film.scene(moving.pace * middle_s).packed())
    ball = inside & (truth.body == film.judged)
    assert ball.sum() > 5000
    assert np.abs(still.depth_mm - truth.depth_mm)[ball].max() < 0.05
    assert np.abs(still.place - truth.place)[ball].max() < 0.02
