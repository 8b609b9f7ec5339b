"""Every cause that a message can name: what has it, and what looks like it and has it not."""

import pickle
import warnings
from dataclasses import replace
from functools import cache
from typing import get_args

import cv2
import numpy as np
import pytest
from support.exposures_off_cycle import FIELDS
from support.posed_boards import CAMERA_PX, PATTERN, PROJECTOR_PX, exact_poses, scaled

from pipeline import Decoder, DecodeSettings
from pipeline.calibration.rig_geometry import solve_geometry
from pipeline.causes import Cause, Key
from pipeline.decoding.light_model import LightModel
from pipeline.diagnosis.rig_check import check_surface
from pipeline.models import CameraState, SensorPart
from pipeline.orders.order_finder import OrderFinder
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig
from tikernels.phase.color_fields import ColorFields

CROSSTALK = np.array(TYPICAL_CROSSTALK)
PERIODS = {None: 2 * 768 / 44, "contrast": 768 / 44, "contrast2": 2 * 768 / 44}


@cache
def rig(code=None, period_px=None, size_px=(320, 240), stripes="horizontal"):
    return simulated_rig(size_px, code=code, period_px=period_px or PERIODS[code], stripes=stripes)


def known(**values):
    """Return a rig of which more is known, or something else."""
    return rig(values.pop("code", None)).model_copy(update=values)


@cache
def photographed(code=None, scene="waves", period_px=None, **fault):
    return simulate_frame(rig(code, period_px), SimulationSettings(**{"scene": scene, "gamma": 1.0, **fault})).image


def said(call):
    """Return the keys of what a call warns of, or of what it raises."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        try:
            call()
        except ValueError as error:
            return {error.args[0].key}
    return {warning.message.args[0].key for warning in found}


def decoded(image, calibration=None, previous=None, elapsed=1.0, **settings):
    decoder = Decoder(DecodeSettings(**settings), calibration, arch="cpu")
    before = None
    if previous is not None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            before = decoder.decode(previous)
    return said(lambda: decoder.decode(np.ascontiguousarray(image), previous=before, elapsed=elapsed))


#: Settings of colours one after another, in an unknown order, before a rolling shutter.
FREE = {"frame_s": 1 / 30, "fields": {"cycle_s": 1 / 60}, "row_s": 0.02 / 240}


def rest():
    return photographed(scene="bust")


def moving(z_mm):
    return photographed(crosstalk_matrix=((1, 0, 0), (0, 1, 0), (0, 0, 1)), object_motion_mm=(0, 0, z_mm))


def rolling():
    """Return a frame whose colours a rolling shutter sees as they come nearer by 8 mm from frame to frame."""
    times = np.linspace(-1 / 6, 1 / 6, 9)
    positions = np.stack([moving(-8.0 * (1 + time)) for time in times])
    seen = ColorFields(0.5, 1.2 / 240).times(240)[5]
    nearest = np.abs(seen[..., None] - times).argmin(axis=-1)
    return np.stack([positions[nearest[:, k], np.arange(240), :, k] for k in range(3)], axis=-1)


def frame(code=None, **fault):
    """Return what decoding says of a frame, by the rig that has taken it."""
    return decoded(photographed(code, **fault), rig(code))


def turned(change, code=None, **values):
    """Return what decoding says of a frame that was changed."""
    return decoded(change(photographed(code, "bust")), known(code=code, **values))


def plain_for_coded(**fault):
    """Return what decoding says of a frame without the code that the calibration has."""
    return decoded(photographed(None, "waves", 768 / 44, **fault), rig("contrast"))


def by_crosstalk(matrix, **fault):
    return decoded(photographed(None, "plane", **fault), known(crosstalk_matrix=matrix))


def size(width, height):
    return said(lambda: rig(size_px=(32, 24)).geometry().check_frame((width, height)))


def read_out(sensor_px, offset_px):
    """Return what is said of frames of some of a sensor, by a calibration of its upper left."""
    parts = ((64, 48), (0, 0)), (sensor_px, offset_px)
    before, now = (SensorPart(sensor_px=px, offset_px=at, binning=(1, 1)) for px, at in parts)
    calibration = rig(size_px=(32, 24)).model_copy(update={"sensor": before})
    return said(lambda: calibration.as_read_out((16, 12), now))


def lens(*distortion):
    rig = simulated_rig((320, 240), period_px=PERIODS[None], camera_distortion=distortion)
    return decoded(photographed(), rig)


def camera(before, **now):
    path = known(capture=CameraState(**before))
    chosen = {"transfer": now.pop("transfer", None), "capture": CameraState(**now)}
    return said(lambda: LightModel(DecodeSettings(**chosen), path))


def solved(poses):
    return said(lambda: solve_geometry(poses, CAMERA_PX, PROJECTOR_PX, PATTERN, baseline_mm=180.0))


@cache
def poses(factor=1.0, **bent):
    """Return poses of a board whose squares are said to be so many times as large as they are."""
    return scaled(exact_poses(**bent), factor)


def warped(poses, corner_px):
    """Return poses whose projector drags the corners of its picture, as a corner correction does."""
    ends = np.float32([[0, 0], [1024, 0], [1024, 768], [0, 768]])
    dragged = ends + np.float32([[corner_px, 0], [0, corner_px / 2], [-corner_px, 0], [0, 0]])
    by = cv2.getPerspectiveTransform(ends, dragged)
    return [replace(pose, projector_px=cv2.perspectiveTransform(pose.projector_px[None], by)[0]) for pose in poses]


def shape(scene):
    """Return what the check of a plane says of a scene, taken for one surface."""
    seen = Decoder(DecodeSettings(), rig(), arch="cpu").decode(photographed(None, scene))
    seen.region[seen.mask] = 1
    return said(lambda: check_surface(seen, rig(), "plane"))


def view(translation_mm):
    geometry = known(translation_mm=np.array(translation_mm)).geometry()
    return said(lambda: OrderFinder(None, geometry, (500.0, 1500.0)))


def moved(along_px):
    """Return what decoding says where the projector's picture lies elsewhere along the stripe."""
    projector = rig("contrast2").projector
    matrix = projector.matrix + np.array([[0, 0, along_px], [0, 0, 0], [0, 0, 0]])
    elsewhere = known(code="contrast2", projector=projector.model_copy(update={"matrix": matrix}))
    return decoded(photographed("contrast2"), elsewhere)


def repeated(image):
    """Return an RGB frame that a fast conversion made of 4:2:0."""
    return cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420), cv2.COLOR_YUV2RGB_I420)


GREY = np.full((240, 320, 3), 120, np.uint8)
#: By their keys: what has the cause, and what could be mistaken for it.
CAUSES = {
    "no fringe": (lambda: decoded(GREY), lambda: decoded(GREY // 12)),
    "under-exposed": (lambda: frame(exposure=0.02), lambda: frame(noise_levels=40.0)),
    "over-exposed": (lambda: frame(exposure=6.0), lambda: frame(exposure=0.02)),
    "weak fringe": (lambda: frame(noise_levels=40.0), lambda: frame(ambient=15.0)),
    "low contrast": (lambda: frame(ambient=15.0), lambda: frame(noise_levels=40.0)),
    "too fine": (lambda: decoded(photographed(period_px=8.0)), lambda: decoded(photographed(period_px=16.0))),
    "other stripes": (lambda: decoded(photographed(), stripes="vertical"), lambda: decoded(GREY, stripes="vertical")),
    "repeated-chroma": (lambda: decoded(repeated(photographed()), rig()), frame),
    "code shown": (lambda: decoded(photographed("contrast")), lambda: decoded(photographed())),
    "code not seen": (lambda: plain_for_coded(), lambda: plain_for_coded(ambient=1.0)),
    "code too weak": (lambda: plain_for_coded(ambient=1.0), lambda: plain_for_coded()),
    "orders guessed": (lambda: frame("contrast", scene="bust", ambient=4.0), lambda: frame("contrast", scene="bust")),
    "rig moved": (lambda: moved(16), lambda: moved(1)),
    "other scene": (
        lambda: decoded(photographed(scene="bust"), rig(), photographed(scene="plane")),
        lambda: decoded(photographed(seed=1), rig(), photographed()),
    ),
    "out of range": (
        lambda: decoded(photographed(), known(depth_range_mm=(300.0, 500.0))),
        lambda: decoded(photographed(), known(depth_range_mm=(600.0, 1200.0))),
    ),
    "turned over": (
        lambda: turned(lambda image: image[::-1], crosstalk_matrix=CROSSTALK),
        lambda: turned(lambda image: image[..., ::-1], crosstalk_matrix=CROSSTALK),
    ),
    "colours swapped": (
        lambda: turned(lambda image: image[..., ::-1], "contrast"),
        lambda: turned(lambda image: image[::-1], "contrast"),
    ),
    "reversed": (
        lambda: turned(lambda image: image[::-1]),
        lambda: turned(lambda image: image[::-1], crosstalk_matrix=CROSSTALK),
    ),
    "reversed for another reason": (
        lambda: decoded(photographed(None, "bust")[::-1], rig("contrast")),
        lambda: turned(lambda image: image[::-1], "contrast"),
    ),
    "impossible period": (
        lambda: decoded(photographed(period_px=12 * 768 / 44), rig()),
        lambda: frame(ambient=30.0),
    ),
    "unusual period": (
        lambda: decoded(photographed(period_px=4 * 768 / 44), rig()),
        lambda: decoded(cv2.GaussianBlur(photographed(), (0, 0), 4), rig()),
    ),
    "other crosstalk": (lambda: by_crosstalk(np.eye(3), gamma=2.0), lambda: by_crosstalk(CROSSTALK, gamma=2.0)),
    "odd colours": (lambda: by_crosstalk(np.eye(3)), lambda: by_crosstalk(CROSSTALK)),
    "too fast": (
        lambda: decoded(photographed(scene="plane"), rig(), photographed(scene="bust"), **FIELDS),
        lambda: decoded(photographed(seed=1), rig(), photographed(), **FIELDS),
    ),
    "frames apart": (
        lambda: decoded(photographed(scene="bust", object_motion_mm=(0, 0, -3)), rig(), rest(), 3.0, **FIELDS),
        lambda: decoded(photographed(scene="bust", object_motion_mm=(0, 0, -3)), rig(), rest(), **FIELDS),
    ),
    "fields unknown": (
        lambda: decoded(photographed(scene="bust", object_motion_mm=(0, 0, -3)), rig(), rest(), **FREE),
        lambda: decoded(photographed(scene="bust", seed=1), rig(), rest(), **FREE),
    ),
    "field order shown": (
        lambda: decoded(rolling(), known(crosstalk_matrix=np.eye(3)), moving(0.0), **FREE),
        lambda: decoded(moving(-8.0), known(crosstalk_matrix=np.eye(3)), moving(0.0), **FREE),
    ),
    "exposure_s": (lambda: camera({"exposure_s": 0.01}, exposure_s=0.02), lambda: camera({"gain": 1.0}, gain=2.0)),
    "gain": (lambda: camera({"gain": 1.0}, gain=2.0), lambda: camera({"gain": 1.0}, gain=1.0)),
    "white_balance": (
        lambda: camera({"white_balance": (1.0, 1.0, 1.0)}, white_balance=(1.5, 1.0, 1.0)),
        lambda: camera({}, white_balance=(1.5, 1.0, 1.0)),
    ),
    "transfer": (lambda: camera({"transfer": "srgb"}, transfer="linear"), lambda: camera({"transfer": "srgb"})),
    "on its side": (lambda: size(24, 32), lambda: size(20, 24)),
    "swapped": (lambda: size(1024, 768), lambda: size(128, 96)),
    "binned": (lambda: size(16, 12) & size(32, 12), lambda: size(20, 24)),
    "calibrated binned": (lambda: size(128, 96), lambda: size(40, 30)),
    "cropped": (lambda: size(20, 24), lambda: size(16, 12)),
    "another camera": (lambda: size(40, 30) & size(40, 20), lambda: size(32, 24)),
    "another sensor": (lambda: read_out((128, 96), (0, 0)), lambda: read_out((64, 48), (40, 0))),
    "not calibrated": (lambda: read_out((64, 48), (40, 0)), lambda: read_out((64, 48), (8, 4))),
    "folded lens": (lambda: lens(-1.6, 0, 0, 0, 0), lambda: lens(0.2, 0, 0, 0, 0)),
    "past the pattern": (lambda: view((0.0, 1e8, 0.0)), lambda: view((0.0, 180.0, 0.0))),
    "other shape": (lambda: shape("bust"), lambda: shape("plane")),
    "warped picture": (
        lambda: solved(warped(poses(), 50)) & solved(warped(poses(1.25), 30)),
        lambda: solved(poses(bow_mm=2.0)),
    ),
    "corners off": (lambda: solved(poses(bow_mm=2.0)), lambda: solved(poses(1.25))),
    "other squares": (
        lambda: solved(poses(1.25)),
        lambda: solved(warped(poses(1.25), 30)),
    ),
    "poses do not fit": (lambda: solved(warped(poses(), 300)), lambda: solved(poses())),
}


@pytest.mark.parametrize("key", get_args(Key))
def test_a_cause_is_named_where_it_is_and_nowhere_else(key, cpu):
    there, elsewhere = CAUSES[key]
    assert key in there()
    assert key not in elsewhere()


def test_no_other_cause_is_in_the_table():
    assert CAUSES.keys() == set(get_args(Key))


def test_a_cause_keeps_its_key_on_its_way_to_another_process():
    assert pickle.loads(pickle.dumps(Cause("gain", "words"))).key == "gain"
