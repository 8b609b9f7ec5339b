"""Basler cameras, against the emulator that comes with Basler's library: its triggers, our images, failed buffers."""

import subprocess
import sys
import time

import cv2
import numpy as np
import pytest

from hardware.camera import open_camera
from hardware.camera.basler import BaslerCamera, list_basler_cameras
from hardware.errors import CameraError, RigError
from hardware.protocols import FrameFormat
from hardware.settings import CameraSettings

pytestmark = pytest.mark.usefixtures("emulator")
SERIAL = "0815-0000"
SETTINGS = CameraSettings(
    driver="basler", serial=SERIAL, exposure_s=2e-3, trigger="software", pixel_format="RGB8Packed", size_px=(96, 64)
)


@pytest.fixture
def opened():
    """Open cameras, and close them whatever happens."""
    cameras = []

    def open_one(**change):
        cameras.append(BaslerCamera(SETTINGS.model_copy(update=change)))
        return cameras[-1]

    yield open_one
    for camera in cameras:
        camera.close()
        camera.close()


def nodes(camera):
    return camera._camera.GetNodeMap()


def show(camera, images, folder):
    """Let the emulator see our own pictures, one after another."""
    for number, image in enumerate(images):
        cv2.imwrite(str(folder / f"{number}.png"), image[..., ::-1])
    nodes(camera).GetNode("TestImageSelector").Value = "Off"
    nodes(camera).GetNode("ImageFilename").Value = str(folder)
    nodes(camera).GetNode("ImageFileMode").Value = "On"


def test_opened_as_asked():
    camera = open_camera(SETTINGS.model_copy(update={"strobe_line": "Line2", "gain_db": 1.5, "trigger": "Line1"}))
    try:
        assert str(camera.identity) == f"Basler Emulation {SERIAL}"
        assert camera.limits.size_px == (96, 64)
        assert camera.limits.format == FrameFormat("rgb", 8)
        assert camera.limits.triggered
        assert camera.limits.exposure_s == (1e-6, 10.0)
        assert camera.limits.min_period_s >= camera.exposure_s == 2e-3
        assert camera.unlocked == ()
        found = {name: nodes(camera).GetNode(name).Value for name in ("TriggerMode", "TriggerSource", "ExposureAuto")}
        assert found == {"TriggerMode": "On", "TriggerSource": "Line1", "ExposureAuto": "Off"}
        assert nodes(camera).GetNode("Gain").Value == pytest.approx(1.5, abs=0.01)
        nodes(camera).GetNode("LineSelector").Value = "Line2"
        assert nodes(camera).GetNode("LineMode").Value == "Output"
        assert nodes(camera).GetNode("LineSource").Value == "ExposureActive"
    finally:
        camera.close()


@pytest.mark.parametrize("pixel_format", ["RGB8Packed", "BGR8Packed", "BayerRG8", "BayerGB8"])
def test_own_images_byte_by_byte(opened, tmp_path, pixel_format):
    images = np.random.default_rng(3).integers(0, 256, (3, 64, 96, 3), np.uint8)
    camera = opened(pixel_format=pixel_format)
    show(camera, images, tmp_path)
    row, column = {"BayerRG8": (0, 0), "BayerGB8": (1, 0)}.get(pixel_format, (0, 0))
    camera.arm(3)
    frames = []
    for _ in images:
        camera.trigger()
        frames.append(camera.frame(2.0))
    for frame, image in zip(frames, images, strict=True):
        if "Bayer" not in pixel_format:
            np.testing.assert_array_equal(frame.image, image)
            continue
        channel = np.array([[0, 1], [1, 2]])  # red where red is first
        rows, columns = np.mgrid[:64, :96]
        seen = image[rows, columns, channel[(rows + row) % 2, (columns + column) % 2]]
        np.testing.assert_array_equal(frame.image, seen)
    assert [frame.frame_id for frame in frames] == [0, 1, 2]
    assert all(frame.fault is None and frame.device_time_s is None for frame in frames)  # its clock always says 0
    assert frames[0].host_time_s < frames[1].host_time_s < frames[2].host_time_s <= time.monotonic()


def test_deep_mosaic_is_right_aligned(opened, tmp_path):
    """The emulator makes 12 bits of a picture's 8 by a factor of 16."""
    image = np.random.default_rng(4).integers(0, 256, (64, 96, 3), np.uint8)
    camera = opened(pixel_format="BayerRG12")
    show(camera, [image], tmp_path)
    camera.arm(1)
    camera.trigger()
    frame = camera.frame(2.0)
    assert camera.limits.format == FrameFormat("bayer", 12, "rggb")
    assert frame.image.dtype == np.uint16
    np.testing.assert_array_equal(frame.image[::2, ::2], image[::2, ::2, 0].astype(np.uint16) * 16)


def test_frames_stay_as_they_were(opened, tmp_path):
    """Buffers are used again; frames handed out are not."""
    images = np.random.default_rng(5).integers(0, 256, (12, 64, 96, 3), np.uint8)
    camera = opened()
    show(camera, [images[k] for k in (0, 1)], tmp_path)
    camera.arm(None)
    kept = []
    for _ in range(300):
        camera.trigger()
        kept.append(camera.frame(2.0).image)
    for number in (0, 1, 256, 299):
        np.testing.assert_array_equal(kept[number], images[number % 2])


def test_no_pulse_no_frame(opened):
    """A trigger cable that is not there: nothing comes, and the deadline holds."""
    camera = opened(trigger="Line1")
    camera.arm(1)
    began = time.monotonic()
    assert camera.frame(0.2) is None
    assert 0.19 < time.monotonic() - began < 2.0
    with pytest.raises(RigError, match='waits for a line: set trigger = "software"'):
        camera.trigger()


def test_failed_buffers_come_in_order(opened):
    camera = opened()
    camera.arm(4)
    nodes(camera).GetNode("ForceFailedBufferCount").Value = 2
    nodes(camera).GetNode("ForceFailedBuffer").Execute()
    frames = []
    for _ in range(4):
        camera.trigger()
        frames.append(camera.frame(2.0))
    assert [frame.image is None for frame in frames] == [True, True, False, False]
    assert [frame.fault for frame in frames] == ["The buffer was incompletely grabbed."] * 2 + [None] * 2
    assert [frame.frame_id for frame in frames] == [0, 1, 2, 3]


def test_triggers_that_come_too_fast_are_lost(opened):
    """As a line's would be, and without a gap in the frames' numbers: only their count tells. Ours wait."""
    camera = opened(exposure_s=0.05)
    camera.arm(10)
    for _ in range(5):
        nodes(camera).GetNode("TriggerSoftware").Execute()
    assert camera.frame(2.0).frame_id == 0
    assert camera.frame(0.3) is None
    for _ in range(5):
        camera.trigger()
    assert [camera.frame(2.0).frame_id for _ in range(5)] == [1, 2, 3, 4, 5]


def test_arming_empties_the_queue(opened):
    camera = opened()
    camera.arm(1)
    camera.trigger()
    time.sleep(0.1)
    camera.disarm()
    camera.disarm()
    camera.arm(1)
    assert camera.frame(0.1) is None
    camera.trigger()
    assert camera.frame(2.0).frame_id is not None


def test_unplugged_in_a_burst(opened):
    """The emulator can report that it was pulled out."""
    camera = opened()
    camera.arm(2)
    camera.trigger()
    assert camera.frame(2.0).fault is None
    nodes(camera).GetNode("FirePnPCallback").Execute()
    with pytest.raises(CameraError, match=f"camera {SERIAL} is gone: look for its power"):
        camera.frame(0.5)
    began = time.monotonic()
    camera.close()
    assert time.monotonic() - began < 6.0


@pytest.mark.parametrize(
    "change, error, said",
    [
        ({"serial": "12345"}, CameraError, r"serial number 12345; there is 0815-0000 \(Emulation\), 0815-0001"),
        ({"serial": None}, CameraError, "2 cameras are there: say which one with serial"),
        ({"pixel_format": "BayerRG12p"}, RigError, r"no pixel_format BayerRG12p .* it has .*RGB8Packed"),
        ({"exposure_s": 100.0}, RigError, "exposure_s is 100 s: this camera exposes for 1e-06 to 10 s"),
        ({"trigger": "Line7"}, RigError, "no trigger Line7; it has Software, Line1"),
        ({"strobe_line": "Line7"}, RigError, "no strobe_line Line7; it has Line1, Line2, Line3"),
    ],
)
def test_refused_in_one_line(change, error, said):
    with pytest.raises(error, match=said) as refused:
        BaslerCamera(SETTINGS.model_copy(update=change))
    assert "\n" not in str(refused.value)


def test_in_use(opened, monkeypatch):
    """What pylon says then is told in one line; its emulator would let two programs in."""
    from pypylon import genicam, pylon

    def refuse(self):
        raise genicam.RuntimeException(
            "Failed to open device.\nThe device is controlled by another application. Err: 3774873636 : "
            "RuntimeException thrown (file 'deviceimpl.h', line 12)"
        )

    monkeypatch.setattr(pylon.InstantCamera, "Open", refuse)
    with pytest.raises(
        CameraError, match=r"cannot be opened; close what else uses it: .*another application"
    ) as refused:
        opened()
    assert "\n" not in str(refused.value)
    assert "deviceimpl" not in str(refused.value)


def test_not_armed(opened):
    camera = opened()
    for call in (camera.trigger, lambda: camera.frame(0.1)):
        with pytest.raises(CameraError, match=f"camera {SERIAL} is not armed"):
            call()
    camera.close()
    camera.disarm()
    for call in (camera.trigger, lambda: camera.frame(0.1), lambda: camera.arm(1)):
        with pytest.raises(CameraError):
            call()


def test_listed():
    assert [identity.serial for identity in list_basler_cameras()] == ["0815-0000", "0815-0001"]


def test_without_the_library():
    program = (
        "import sys; sys.modules['pypylon'] = None\n"
        "from hardware.camera import list_cameras, open_camera\n"
        "from hardware.settings import CameraSettings\n"
        "print([row.note for row in list_cameras() if row.driver == 'basler'])\n"
        "try: open_camera(CameraSettings(driver='basler', exposure_s=1e-3))\n"
        "except ConnectionError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.count("Basler cameras need pypylon: pip install 'colorphase[basler]'") == 2
