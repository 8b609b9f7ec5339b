"""Guided captures: what is kept, what is refused, and how they go on after they were stopped."""

import itertools
import json

import cv2
import numpy as np
import pytest
from support.flat_studio import FlatStudio
from support.posed_boards import PATTERN

from hardware.errors import CameraError
from pipeline.acquisition.guided_capture import LIGHT, POSES, GuidedCapture
from pipeline.acquisition.simulated_camera import WEBCAM
from pipeline.acquisition.simulated_studio import SimulatedStudio, StudioFaults
from pipeline.calibration.board import Board
from pipeline.calibration.captures import CapturedFolder
from pipeline.calibration.pose_guide import PoseGuide
from pipeline.calibration.radiometry import measure_radiometry, radiometry_sequence
from pipeline.diagnosis.artefacts import BallBar, Plate, Volume
from pipeline.errors import CalibrationError, OutputError
from pipeline.models import SensorPart
from pipeline.pattern import make_pattern
from pipeline.simulation import simulated_rig

NAMES = radiometry_sequence(FlatStudio.projector_px).names
SMALL = simulated_rig((320, 240))
BOARD = Board(kind="chessboard", squares=(9, 6), square_mm=34.0)


def capture_of(studio, folder, identity=None):
    """Return a guided capture, and the lines that it reports."""
    lines = []
    return GuidedCapture(studio, folder, identity or {"camera": "one"}, lines.append, lines.append), lines


def light_of(studio, folder):
    capture, lines = capture_of(studio, folder)
    capture.check_rig()
    return capture.take_light(), lines


def test_the_pictures_of_the_light_measure_it(tmp_path):
    folder, lines = light_of(FlatStudio(), tmp_path / "new" / "captures")
    captures = CapturedFolder(folder, NAMES)
    found = measure_radiometry(captures)
    np.testing.assert_allclose(found.crosstalk_matrix, 0.08 * np.array([[9, 1, 0], [1, 8, 1], [0, 1, 9]]), atol=2e-3)
    np.testing.assert_allclose(found.response[1], np.linspace(0, 1, 256) ** 2, atol=4e-3)
    assert "picture 33 of 33: 32-grey-255" in lines and "put up a white sheet that fills the picture" in lines


def test_a_picture_is_taken_when_it_is_on_the_screen_however_long_that_takes(tmp_path):
    for latency_s in (0.0, 0.3, 0.9):
        folder, _ = light_of(FlatStudio(latency_s), tmp_path / f"{latency_s}")
        assert measure_radiometry(CapturedFolder(folder, NAMES)).additivity < 0.01


class Dropping(FlatStudio):
    """Now and then its projector does not show a picture at first."""

    n_shown = n_dropped = 0

    def show(self, picture):
        """Send a picture, or not."""
        self.n_shown += 1
        if self.n_shown > 30 and self.n_shown % 9 == 0:
            self.n_dropped += 1
        else:
            super().show(picture)


def test_a_picture_that_is_not_shown_is_repeated(tmp_path):
    studio = Dropping()
    folder, _ = light_of(studio, tmp_path / "captures")
    assert studio.n_dropped >= 2
    assert measure_radiometry(CapturedFolder(folder, NAMES)).additivity < 0.01


class Interrupted(Exception):
    """Something ends the capture."""


@pytest.mark.parametrize("kind", [Interrupted, KeyboardInterrupt, CameraError])
def test_a_capture_that_is_stopped_anywhere_goes_on_there(tmp_path, kind):
    """Fifty interruptions in one capture: no picture is lost, taken twice or another one."""
    rng, folder, taken, stops = np.random.default_rng(4), tmp_path / "captures", {}, 0
    while True:
        studio = FlatStudio(seed=stops)
        left = int(rng.integers(20, 80)) if stops < 50 else 10**6

        def count(name, left=[left]):  # noqa: B006 - one a studio
            left[0] -= 1
            if left[0] < 0:
                raise kind("stopped")

        studio.before_each = count
        try:
            done, _ = light_of(studio, folder)
            break
        except kind:
            stops += 1
        kept = {path.name: path.read_bytes() for path in folder.glob(f".{LIGHT}/*.png")}
        assert taken.items() <= kept.items()
        taken = kept
        assert not (folder / LIGHT).exists() and not list(folder.glob(f".{LIGHT}/*.part"))
    assert stops == 50 and {path.stem for path in done.iterdir()} == set(NAMES)
    assert all((done / name).read_bytes() == content for name, content in taken.items())
    assert measure_radiometry(CapturedFolder(done, NAMES)).additivity < 0.01


def test_a_scene_that_is_another_one_is_taken_from_the_start(tmp_path):
    studio, folder = FlatStudio(), tmp_path / "captures"
    capture, _ = capture_of(studio, folder)
    capture.check_rig()
    n_before = len(studio.sent)

    def stop(name):
        if len(studio.sent) > n_before + 20:
            raise Interrupted

    studio.before_each = stop
    with pytest.raises(Interrupted):
        capture.take_light()
    other = FlatStudio()
    other.ambient = 0.06
    done, lines = light_of(other, folder)
    assert any("the sheet or the room's light is not as it was" in line for line in lines)
    assert measure_radiometry(CapturedFolder(done, NAMES)).ambient.min() > 0.05


class Fading(FlatStudio):
    """Its lamp loses a twentieth of its light once, while the pictures are taken."""

    def frame(self, picture):
        """Return a frame in the light that there is now."""
        if len(self.lines) and self.light == 0.8 and len(self.sent) - self.before > 20:
            self.light = 0.76
        return super().frame(picture)

    def guide(self, guidance):
        """Note the line, and when it came."""
        super().guide(guidance)
        self.before = len(self.sent)


def test_light_that_changes_meanwhile_is_found_and_taken_again(tmp_path):
    folder, lines = light_of(Fading(), tmp_path / "captures")
    assert any("changed by -" in line and "all pictures of the light are taken again" in line for line in lines)
    assert measure_radiometry(CapturedFolder(folder, NAMES)).additivity < 0.01


class Drifting(FlatStudio):
    """Its lamp loses light with every frame."""

    def frame(self, picture):
        """Return a frame in the light that there is now."""
        self.light *= 0.9997
        return super().frame(picture)


def test_light_that_never_rests_ends_it_with_what_to_do(tmp_path):
    with pytest.raises(CalibrationError, match=r"changed by -.* of the projector's .*: let the projector warm up"):
        light_of(Drifting(), tmp_path / "captures")
    assert not (tmp_path / "captures" / LIGHT).exists()


def test_captures_of_another_camera_are_not_mixed(tmp_path):
    capture_of(FlatStudio(), tmp_path / "captures", {"camera": "one"})
    capture_of(FlatStudio(), tmp_path / "captures", {"camera": "one", "board": "mine"})
    with pytest.raises(OutputError, match=r"holds captures with another board .*: choose another folder"):
        capture_of(FlatStudio(), tmp_path / "captures", {"board": "other"})
    assert json.loads((tmp_path / "captures" / "session.json").read_text())["camera"] == "one"
    (tmp_path / "captures" / "session.json").write_text("[")
    with pytest.raises(OutputError, match=r"session\.json cannot be read"):
        capture_of(FlatStudio(), tmp_path / "captures")


def test_captures_of_another_part_of_the_sensor_are_not_mixed(tmp_path):
    """Of the same size, which pictures do not show."""
    studio = FlatStudio()
    studio.sensor = SensorPart(sensor_px=(99, 80), offset_px=(4, 0), binning=(1, 1))
    capture_of(studio, tmp_path)[0].check_rig()
    assert CapturedFolder(tmp_path / POSES, ()).sensor == studio.sensor
    studio.sensor = studio.sensor.model_copy(update={"offset_px": (8, 0)})
    with pytest.raises(OutputError, match="holds captures with another part of the sensor"):
        capture_of(studio, tmp_path)[0].check_rig()


@pytest.mark.parametrize(
    ("faults", "exposure_s", "message"),
    [
        (StudioFaults(mirrored=True), 1 / 60, "the picture is mirrored: "),
        (StudioFaults(scale=0.93), 1 / 60, "does not show the picture pixel for pixel"),
        (StudioFaults(keystone=0.08), 1 / 60, "does not show the picture pixel for pixel"),
        (StudioFaults(swapped=True), 1 / 60, "the camera's frames are B, G, R"),
        (StudioFaults(colour_cycle_s=1 / 119), 1 / 47, "white flickers by .* from frame to frame: colorphase ex"),
    ],
)
def test_a_fault_of_the_rig_is_named_within_a_minute(tmp_path, faults, exposure_s, message):
    studio = SimulatedStudio(None, exposure_s, truth=SMALL, faults=faults, seed=1)
    capture, _ = capture_of(studio, tmp_path / "captures")
    with pytest.raises(CalibrationError, match=message):
        capture.check_rig()
    assert studio.now_s() < 60


@pytest.mark.parametrize("faults", [StudioFaults(), StudioFaults(colour_cycle_s=1 / 120)])
def test_a_rig_without_faults_passes(tmp_path, faults):
    studio = SimulatedStudio(None, 1 / 60, truth=SMALL, faults=faults, seed=1)
    capture_of(studio, tmp_path / "captures")[0].check_rig()
    assert studio.now_s() < 60


def test_a_camera_that_is_binned_since_the_pictures_before_is_named(tmp_path):
    """A cropped one, too: frames of one size are gone on with."""
    for size_px in ((320, 240), (320, 240)):
        capture_of(SimulatedStudio(None, truth=simulated_rig(size_px)), tmp_path)[0].check_rig()
    with pytest.raises(
        OutputError, match=r"another size of frames \(320x240, now 160x120\): choose another folder, or"
    ):
        capture_of(SimulatedStudio(None, truth=simulated_rig((160, 120))), tmp_path)[0].check_rig()


def test_a_camera_that_sees_no_light_or_too_much_is_told_what_to_do(tmp_path):
    dark, bright = FlatStudio(), FlatStudio()
    dark.light, bright.light = 0.01, 1.4
    for studio, message in ((dark, "hardly any light of the projector"), (bright, "saturated by white: expose short")):
        with pytest.raises(CalibrationError, match=message):
            capture_of(studio, tmp_path / "captures")[0].check_rig()


class Restless(SimulatedStudio):
    """Its operator moves the second board while its pictures are taken."""

    shown = 0

    def show(self, picture):
        """Send a picture, or not."""
        self.shown += 1
        if self.n_acts == 2 and self.shown == 40:
            before, to, since_s = self._way
            self._way = (before, to + np.array([0, 0, 0, 3.0, 0, 0]), since_s)
        super().show(picture)


class ThreePoses(PoseGuide):
    """A guide that has enough of three."""

    enough = property(lambda self: len(self.poses) >= 3)


def test_poses_are_taken_where_the_guide_says_and_again_where_the_board_moved(tmp_path):
    """Three poses, of which one moves; then another process goes on with them."""
    guide = ThreePoses(BOARD, (320, 240), (1024, 768), PATTERN)
    studio = Restless(BOARD, truth=SMALL, seed=3)
    capture, lines = capture_of(studio, tmp_path)
    capture.check_rig()
    folder = capture.take_poses(BOARD, guide)
    assert [path.name for path in sorted(folder.iterdir())] == ["pose-01", "pose-02", "pose-03"]
    assert sum(line.startswith("again: pose-02: ") for line in lines) == 1
    assert [pose.name for pose in guide.poses] == ["pose-01", "pose-02", "pose-03"]
    again = ThreePoses(BOARD, (320, 240), (1024, 768), PATTERN)
    assert capture_of(studio, tmp_path)[0].take_poses(BOARD, again) == tmp_path / POSES
    np.testing.assert_array_equal(again.poses[2].camera_px, guide.poses[2].camera_px)


def test_a_webcams_poses_are_as_good_as_others(tmp_path):
    """A tone curve, sharpening and MJPEG, which multiply noise in the dark, tell where its corners are, too."""
    studio = SimulatedStudio(BOARD, truth=SMALL, faults=StudioFaults(camera=WEBCAM), seed=5)
    capture, lines = capture_of(studio, tmp_path)
    guide = ThreePoses(BOARD, (320, 240), (1024, 768), PATTERN)
    capture.check_rig()
    capture.take_poses(BOARD, guide)
    assert len(lines) == len([line for line in lines if "again" not in line])
    for pose in guide.poses:
        plane, _ = cv2.findHomography(pose.camera_px, pose.projector_px)
        off = cv2.perspectiveTransform(pose.camera_px[None], plane)[0] - pose.projector_px
        assert np.sqrt((off**2).mean()) < 0.3


def test_a_picture_that_is_refused_is_taken_again(tmp_path):
    geometry = SMALL.geometry()
    codes, bar = make_pattern((1024, 768), geometry.pattern), BallBar(60.0, 160.0)
    first, second = itertools.islice(bar.positions(Volume.before(geometry, None)), 2)
    refused = []

    def check(position, picture):
        assert picture.name == f"{position.name}.png" and picture.exists()
        if position is second or not refused:
            refused.append(position.name)
            raise CalibrationError("it is blurred")

    capture, lines = capture_of(SimulatedStudio(bar, truth=SMALL, seed=4), tmp_path)
    capture.check_rig()
    with pytest.raises(CalibrationError, match=r"^bar-2: it is blurred$"):
        capture.take_positions([first, second], codes, check)
    assert refused == ["bar-1", *3 * ["bar-2"]]
    assert [line for line in lines if "again" in line or "taken" in line] == [
        "again: bar-1: it is blurred",
        "bar-1 is taken",
        "again: bar-2: it is blurred",
        "again: bar-2: it is blurred",
    ]
    assert [path.name for path in tmp_path.glob("*.png") if path.name.startswith("bar")] == ["bar-1.png"]


def test_a_ball_bar_and_a_plate_are_taken_where_they_should_be_once_each(tmp_path):
    geometry = SMALL.geometry()
    volume, codes = Volume.before(geometry, None), make_pattern((1024, 768), geometry.pattern)
    for artefact in (BallBar(60.0, 160.0), Plate.within(volume)):
        studio = SimulatedStudio(artefact, truth=SMALL, seed=4)
        capture, lines = capture_of(studio, tmp_path)
        capture.check_rig()
        first, second = itertools.islice(artefact.positions(volume), 2)
        capture.take_positions([first], codes)
        before = (tmp_path / f"{first.name}.png").read_bytes()
        capture.take_positions([first, second], codes)
        assert studio.n_acts == 2 and lines[-1] == f"{second.name} is taken"
        assert (tmp_path / f"{first.name}.png").read_bytes() == before != (tmp_path / f"{second.name}.png").read_bytes()
        assert f"{second.name}: {second.line}" in lines
