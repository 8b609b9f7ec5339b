"""Frames of rigs drawn at random show what is said to be true of them."""

import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks" / "rendered"))

import cv2
import numpy as np
from drawn_figures import decode, deeper, judge_orders
from drawn_frames import Photographer, take
from drawn_rigs import draw_rig
from drawn_scenes import draw_scene
from ray_caster import NOTHING, true_at_centers

from pipeline.pattern import CHANNEL_PHASES


def test_an_ideal_fringe_has_the_true_phase(cpu):
    """Three shifts of a sinusoid on a plane say which phase a pixel's centre sees, to 0.0005 rad."""
    rig = replace(draw_rig(0), gammas=(1.0,) * 3, projector_magnified=(1.0,) * 3, camera_magnified=(1.0,) * 3)
    photographer = Photographer(rig)
    geometry, scene = photographer.geometry, draw_scene("plane", rig, 0)
    per_px = 2 * np.pi / geometry.pattern.period_px
    places = np.arange(geometry.projector.size_px[geometry.phase_axis])[:, None]
    phases = [per_px * places + 2 * np.pi * k / 3 + np.array(CHANNEL_PHASES) for k in range(3)]
    shifts = [photographer.filled(0.5 + 0.5 * np.cos(phase)) for phase in phases]
    waves = sum(np.exp(-2j * np.pi * k / 3) * light for k, light in enumerate(photographer.lights(scene, shifts)))
    truth = true_at_centers(geometry, scene.packed())
    inside = cv2.distanceTransform((truth.lit & (truth.body != NOTHING)).astype(np.uint8), cv2.DIST_L2, 5) > 4
    primaries = waves[inside] @ np.linalg.inv(rig.matrix(scene.paints[0])).T
    error = np.angle(primaries / np.exp(1j * (per_px * truth.place[inside, None] + np.array(CHANNEL_PHASES))))
    assert inside.mean() > 0.5
    assert np.sqrt((error**2).mean()) < 5e-4


def test_both_codes_are_read_on_a_plane(cpu):
    """Orders are right under either code, and phases as good: that of cells costs less modulation."""
    taken = take(Photographer(draw_rig(2)), "plane", 0)
    one, two = (judge_orders(decode(taken, pattern), taken, deeper(taken.lit, 4)) for pattern in ("coded", "coded2"))
    assert min(one["right"], two["right"]) > 0.999
    assert max(one["wrong"], two["wrong"]) == 0
    assert two["rms"] < 1.05 * one["rms"]
