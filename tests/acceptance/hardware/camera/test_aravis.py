"""GigE Vision cameras through Aravis, against its fake camera: real packets, on the loopback device."""

import subprocess
import sys
import time

import numpy as np
import pytest

from hardware.camera import open_camera
from hardware.camera.aravis import AravisCamera, list_aravis_cameras
from hardware.errors import CameraError, RigError
from hardware.protocols import FrameFormat
from hardware.settings import CameraSettings

pytestmark = [
    pytest.mark.usefixtures("aravis"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the fake camera's helper reads /proc"),
]
FIRST_ID = 65401  # of the fake camera's first frame


@pytest.fixture
def opened():
    """Open cameras, and close them whatever happens."""
    cameras = []

    def open_one(serial, **change):
        asked = {"trigger": "software", "pixel_format": "RGB8", "size_px": (96, 64), **change}
        cameras.append(open_camera(CameraSettings(driver="aravis", serial=serial, exposure_s=2e-3, **asked)))
        return cameras[-1]

    yield open_one
    for camera in cameras:
        camera.close()
        camera.close()


def burst(camera, count, timeout_s=2.0):
    camera.arm(count)
    frames = []
    for _ in range(count):
        camera.trigger()
        frames.append(camera.frame(timeout_s))
    camera.disarm()
    return frames


def test_own_images_and_numbers_that_wrap(start_twin, opened):
    """Each trigger is rendered when it comes; 140 frames go beyond the 16 bits of their numbers."""
    images = np.random.default_rng(6).integers(0, 256, (140, 64, 96, 3), np.uint8)
    rendered = iter(images)
    start_twin("TWIN1", lambda: next(rendered))
    camera = opened("TWIN1")
    assert str(camera.identity) == "Aravis Fake TWIN1"
    assert (camera.limits.size_px, camera.limits.format) == ((96, 64), FrameFormat("rgb", 8))
    assert camera.limits.triggered and camera.exposure_s == 2e-3
    # The fake camera has a gain without a unit, and no word on its frame rate; all else it locks.
    assert [sentence.split(":")[0] for sentence in camera.unlocked] == [
        "its gain has no unit",
        "it does not report its frame rate as it is set up",
    ]
    frames = burst(camera, 140)
    assert [frame.fault for frame in frames] == [None] * 140
    for frame, image in zip(frames, images, strict=True):
        np.testing.assert_array_equal(frame.image, image)
    assert [frame.frame_id for frame in frames] == list(range(FIRST_ID, FIRST_ID + 140))
    assert np.all(np.diff([frame.device_time_s for frame in frames]) > 0)


def test_mosaic_armed_again_and_waiting_in_vain(start_twin, opened):
    images = np.random.default_rng(7).integers(0, 256, (4, 64, 96), np.uint8)
    rendered = iter(images)
    start_twin("TWIN2", lambda: next(rendered))
    camera = opened("TWIN2", pixel_format="BayerGB8")
    assert camera.limits.format == FrameFormat("bayer", 8, "gbrg")
    with pytest.raises(CameraError, match="camera TWIN2 is not armed"):
        camera.trigger()
    with pytest.raises(CameraError, match="camera TWIN2 is not armed"):
        camera.frame(0.1)
    frames = burst(camera, 2)
    camera.arm(None)
    camera.trigger()
    time.sleep(0.2)
    camera.disarm()
    camera.disarm()
    camera.arm(1)
    began = time.monotonic()
    assert camera.frame(0.2) is None  # the queue is empty
    assert 0.19 < time.monotonic() - began < 2.0
    camera.trigger()
    frames.append(camera.frame(2.0))
    for frame, image in zip(frames, images[[0, 1, 3]], strict=True):
        np.testing.assert_array_equal(frame.image, image)
    camera.close()
    camera.disarm()
    with pytest.raises(CameraError, match="camera TWIN2 is closed"):
        camera.arm(1)


def test_lost_packets_are_faults_in_order(start_fake_camera, opened):
    """Of a frame's packets one in 70 is lost: some frames are not whole, and none of those has an image."""
    start_fake_camera("LOSSY", lost_permille=15)
    camera = opened("LOSSY", size_px=(256, 256))
    frames = [frame for frame in burst(camera, 12, timeout_s=1.0) if frame is not None]
    faulty = [frame for frame in frames if frame.fault]
    assert len(faulty) >= 3 and all(frame.fault.startswith("packets are missing") for frame in faulty)
    assert all((frame.image is None) == (frame.fault is not None) for frame in frames)
    numbers = [frame.frame_id for frame in frames if frame.frame_id is not None]
    assert numbers == sorted(set(numbers)) and len(numbers) >= 8
    assert set(numbers) <= set(range(FIRST_ID, FIRST_ID + 12))


def test_over_triggered_in_use_and_unplugged(start_fake_camera, opened):
    process = start_fake_camera("BUSY")
    camera = opened("BUSY")
    assert [str(identity) for identity in list_aravis_cameras()] == ["Aravis Fake BUSY"]
    camera.arm(5)
    for _ in range(5):  # it looks for triggers every 40 ms
        camera.trigger()
    found = [camera.frame(0.3) for _ in range(5)]
    assert found[0] is not None and found[2:] == [None] * 3
    other = subprocess.run(
        [sys.executable, "-c", _OPEN, "BUSY"], capture_output=True, text=True, timeout=60, check=True
    )
    assert other.stdout.strip() == "camera BUSY is in use: close the other program"
    assert camera.frame(0.1) is None  # and it is still ours
    process.kill()
    with pytest.raises(CameraError, match="camera BUSY is gone; look for its power") as refused:
        for _ in range(3):
            camera.frame(0.1)
    assert "\n" not in str(refused.value)
    began = time.monotonic()
    camera.close()
    assert time.monotonic() - began < 5.0


_OPEN = """
import sys
from hardware.camera import open_camera
from hardware.settings import CameraSettings
try:
    open_camera(CameraSettings(driver="aravis", serial=sys.argv[1], exposure_s=1e-3, trigger="software"))
except ConnectionError as error:
    print(error)
"""


def test_cable_that_is_not_there_and_settings_that_are_refused(start_fake_camera, opened):
    start_fake_camera("LINE")
    with pytest.raises(CameraError, match=r"serial number OTHER; there is LINE \(Fake\)"):
        opened("OTHER")
    with pytest.raises(RigError, match=r"no pixel_format BayerRG12 .* it has .*RGB8"):
        opened(None, pixel_format="BayerRG12")
    with pytest.raises(RigError, match="exposure_s"):
        AravisCamera(CameraSettings(driver="aravis", serial="LINE", exposure_s=60.0, trigger="Line0"))
    with pytest.raises(RigError, match=r"no trigger Line1; it has .*Line0"):
        opened("LINE", trigger="Line1")
    camera = opened(None, trigger="Line0")  # the others have let go of it
    camera.arm(1)
    with pytest.raises(RigError, match='waits for a line: set trigger = "software"'):
        camera.trigger()
    assert camera.frame(0.2) is None


def test_without_the_library():
    program = (
        "import ctypes\n"
        "def missing(name): raise OSError(name)\n"
        "ctypes.CDLL = missing\n"
        "from hardware.camera.aravis import list_aravis_cameras\n"
        "try: list_aravis_cameras()\n"
        "except ConnectionError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.startswith("GigE and USB3 Vision cameras need Aravis: ")
    assert len(done.stdout.splitlines()) == 1
