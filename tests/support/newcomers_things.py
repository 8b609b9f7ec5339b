"""What a reader of the documentation has at hand, under the names that its pages use."""

import shutil
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from support.command_line import colorphase
from support.video_files import encode

from pipeline.acquisition.practice_set import PLANE, POSES, practice_poses
from pipeline.calibration.board import Board
from pipeline.output.range_image import write_png
from pipeline.recording.recorder import Recorder
from pipeline.recording.video_export import export_video
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels.raw.pixel_format import PixelFormat

_RIG = """calibration = "calibration.json"
[trigger]
driver = "simulated"
strobe = true
[timing]
period_s = 0.05
frames = 4
camera_delay_s = 0.001
[camera]
driver = "simulated"
exposure_s = 0.008333
"""
#: The board of the README.
_BOARD = Board(kind="charuco", squares=(11, 8), square_mm=20.0)


def make_things(folder: Path) -> None:
    """Write pictures, footage, a rig, and captures to calibrate with into a folder."""
    rig = simulated_rig(code="contrast")
    light = SimulationSettings()
    images = [
        simulate_frame(rig, SimulationSettings(seed=k, object_motion_mm=(2.0 * k, 0.0, 0.0))).image for k in range(4)
    ]
    response = np.tile(np.linspace(0, 1, 256) ** light.gamma, (3, 1))
    calibrated = rig.model_copy(update={"crosstalk_matrix": light.crosstalk_matrix, "response": response})
    calibrated.write(folder / "calibration.json")
    stereo = cv2.FileStorage(str(folder / "stereo.yml"), cv2.FILE_STORAGE_WRITE)
    for number, lens in enumerate((rig.camera, rig.projector), start=1):
        stereo.write(f"cameraMatrix{number}", lens.matrix)
        stereo.write(f"distCoeffs{number}", lens.distortion)
    stereo.write("R", rig.rotation)
    stereo.write("T", rig.translation_mm.reshape(3, 1))
    stereo.release()
    for name in ("picture.png", "frame.png"):
        write_png(folder / name, np.asarray(images[0], np.uint8))
    for number, name in enumerate(("calibrated.png", "now.png")):  # of a sheet that holds still
        write_png(folder / name, simulate_frame(rig, SimulationSettings(scene="plane", seed=number)).image)
    cv2.imwrite(str(folder / "wide.tif"), np.ascontiguousarray(images[0][..., ::-1]))
    (folder / "settings.toml").write_text("smoothing_px = 5\n")
    (folder / "rig.toml").write_text(_RIG)
    with Recorder(folder / "film.zarr", PixelFormat("rgb")) as recorder:
        for image in images:
            recorder.add(np.asarray(image, np.uint8))
    export_video(folder / "film.zarr", folder / "film.mkv")
    shutil.copytree(folder / "film.zarr", folder / "face" / "recording.zarr")
    done = colorphase("decode", "film.mkv", "--out", "film", "--calibration", "calibration.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    planes = [_yuv(np.asarray(image, np.uint8)) for image in (*images, *images, *images)]
    encode(folder / "film.mp4", planes, "libx264", "yuv420p", {"crf": "10"})
    done = colorphase("calibrate", "simulate", "--out", "practice", cwd=folder)
    assert done.returncode == 0, done.stderr
    shutil.copytree(folder / "practice" / "light", folder / "captures")
    shutil.copy(folder / "practice" / PLANE, folder / "plane.png")
    for number, captures in enumerate(islice(practice_poses(_BOARD, 8, 5), 8)):
        pose = folder / POSES / f"pose-{number}"
        pose.mkdir(parents=True)
        for name, picture in captures.items():
            cv2.imwrite(str(pose / f"{name}.png"), np.ascontiguousarray(picture[..., ::-1]))


def _yuv(image: np.ndarray) -> list[np.ndarray]:
    """Return a picture's luma and subsampled chroma, BT.601, limited range."""
    whole = cv2.cvtColor(image, cv2.COLOR_RGB2YUV_I420)
    height, width = image.shape[:2]
    luma, u, v = np.split(whole.ravel(), [height * width, height * width * 5 // 4])
    return [luma.reshape(height, width), *(plane.reshape(height // 2, width // 2) for plane in (u, v))]
