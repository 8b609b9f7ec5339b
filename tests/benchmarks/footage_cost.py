"""What each way in which a frame can reach us costs in phase: the same simulated frames, stored and read again.

python tests/benchmarks/footage_cost.py [--stripes vertical]
"""

import argparse
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import _tests_path  # noqa: F401 - puts support on the path
import av
import cv2
import numpy as np
import reference
from support.video_files import H264, MJPEG, encode, film

from pipeline import Calibration, Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.footage.footage import StoredFrame
from pipeline.footage.opening import open_footage
from pipeline.output.report import measure_against_truth
from pipeline.recording.recorder import Recorder
from pipeline.simulation import WHITE, SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

SCENES = ("plane", "waves", "bust")
SURFACES = {
    "white, gamma 1": {"gamma": 1.0, "reflectance": WHITE},
    "hard": {},  # gamma 2, skin: SimulationSettings' own
}
CENTRE = PixelFormat("yuv", subsampling=(2, 2), siting="centre", matrix="bt601", full_range=True)
LEFT = PixelFormat("yuv", subsampling=(2, 2), siting="left", matrix="bt601")


def read(path: Path, stripes: str, number: int, **said: Any) -> Any:
    """Return one frame of a source as the decoder takes it."""
    (frame,) = open_footage(path, **said).frames(number, number + 1)
    if not isinstance(frame, StoredFrame):
        raise RuntimeError(frame.reason)
    return np.array(develop(frame.planes, frame.format, stripes=stripes))


def kinds(image: Any, stripes: str, folder: Path) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Yield each way to store a picture, and what comes back."""
    white = np.iinfo(image.dtype).max

    def recorded(name: str, levels: Any, format: PixelFormat) -> Any:
        with Recorder(folder / name, format) as recorder:
            recorder.add(levels)
        return read(folder / name, stripes, 0)

    def picture(name: str, *options: int) -> Path:
        (folder / name).write_bytes(cv2.imencode(Path(name).suffix, image[..., ::-1], options)[1].tobytes())
        return folder / name

    def by_opencv(path: Path) -> Any:
        capture = cv2.VideoCapture(str(path))
        return [capture.read()[1] for _ in range(3)][-1][..., ::-1]

    def by_ffmpeg(codec: tuple[str, str, dict[str, str]]) -> Path:
        frame = av.VideoFrame.from_ndarray(image, "rgb24").reformat(format=codec[1])
        planes = [
            np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[:, : plane.width].copy()
            for plane in frame.planes
        ]
        return encode(folder / "ffmpeg.mkv", 5 * [planes], *codec)

    def mosaic(method: Callable[[Any], Any] | None) -> Any:
        seen = reference.mosaic(image, "rggb")
        return develop((seen,), PixelFormat("bayer"), stripes=stripes) if method is None else method(seen)

    yield "the arrays themselves", lambda: image
    yield "PNG", lambda: read(picture("a.png"), stripes, 0)
    yield "a recording", lambda: recorded("a.zarr", image, PixelFormat("rgb"))
    yield "JPEG 4:2:0, quality 95", lambda: read(picture("a.jpg", cv2.IMWRITE_JPEG_QUALITY, 95), stripes, 0)
    yield "MJPEG 4:2:0, q 2", lambda: read(film(folder / "m.avi", image, CENTRE, MJPEG), stripes, 2)
    yield "H.264 4:2:0, crf 10", lambda: read(film(folder / "h.mp4", image, LEFT, H264), stripes, 2)
    yield (
        "H.264 4:2:0, crf 23",
        lambda: read(film(folder / "h.mp4", image, LEFT, (*H264[:2], {"crf": "23"})), stripes, 2),
    )
    yield (
        "4:2:2, uncompressed",
        lambda: develop(
            tuple(reference.subsample_chroma(image / white, PixelFormat("yuv", subsampling=(2, 1)))),
            PixelFormat("yuv", subsampling=(2, 1)),
        ),
    )
    yield "H.264 as ffmpeg makes it of RGB", lambda: read(by_ffmpeg(H264), stripes, 2)
    yield "the same, with --siting centre", lambda: read(by_ffmpeg(H264), stripes, 2, siting="centre")
    yield "MJPEG by cv2.VideoCapture", lambda: by_opencv(film(folder / "m.avi", image, CENTRE, MJPEG))
    yield "H.264 by cv2.VideoCapture", lambda: by_opencv(film(folder / "h.mp4", image, LEFT, H264))
    yield "Bayer", lambda: mosaic(None)
    yield "Bayer, recorded", lambda: recorded("b.zarr", reference.mosaic(image, "rggb"), PixelFormat("bayer"))
    yield "Bayer, bilinear (OpenCV)", lambda: mosaic(lambda m: cv2.cvtColor(m, cv2.COLOR_BAYER_RGGB2RGB))
    yield "Bayer, edge-aware (OpenCV)", lambda: mosaic(lambda m: cv2.cvtColor(m, cv2.COLOR_BAYER_RGGB2RGB_EA))
    yield "Bayer, variable gradients (OpenCV)", lambda: mosaic(lambda m: cv2.cvtColor(m, cv2.COLOR_BAYER_RGGB2RGB_VNG))


def limits(truth: SimulatedFrame, settings: SimulationSettings) -> dict[str, str]:
    """Return the RMS of the Cramer-Rao bound of the phase, rad, of the arrays and of a Bayer mosaic of them.

    Known is everything but the phase, and how it changes from pixel to pixel; it is told by all samples of a window.
    The window is a pixel, or five along the stripes.
    """
    clean = settings.model_copy(update={"noise_levels": 0.0, "bits": 16})
    light = simulate_frame(truth.rig, clean).image / 65535 * 255
    with np.errstate(invalid="ignore"):
        slope = np.gradient(light, axis=0) / np.gradient(truth.phase, axis=0)[..., None]
    slope *= (np.pi / 6) / np.sin(np.pi / 6)  # what a central difference loses of a period of 12 px
    every = np.where(np.isfinite(slope), slope, 0.0) ** 2 / (settings.noise_levels**2 + 1 / 12)
    arrays, mosaic = every.sum(axis=-1), reference.mosaic(every, "rggb")
    lit = reference.eroded(truth.mask & (light.mean(axis=-1) > 20), 4)
    windows = {
        "limit of the arrays, unsmoothed": (arrays, 1, 1),
        "limit of the arrays": (arrays, 5, 1),
        "limit of a mosaic, unsmoothed: a cell of 2x2": (mosaic, 2, 2),
        "limit of a mosaic: five pixels of one row": (mosaic, 5, 1),
        "limit of a mosaic: five pixels of three rows": (mosaic, 5, 3),
    }
    told = {
        name: cv2.boxFilter(info, -1, size, normalize=False, borderType=cv2.BORDER_REFLECT_101)
        for name, (info, *size) in windows.items()
    }
    return {name: f"{np.sqrt((1 / info[lit]).mean()):.4f}" for name, info in told.items()}


def phase_error(
    image: Any,
    truth: SimulatedFrame,
    calibration: Calibration,
    stripes: Literal["horizontal", "vertical"],
    smoothing_px: int,
) -> str:
    """Decode a picture, and return its phase error, rad."""
    decoder = Decoder(DecodeSettings(stripes=stripes, smoothing_px=smoothing_px), calibration)
    return f"{measure_against_truth(decoder.decode(image), truth)['phase_rms_rad']:.4f}"


def main() -> None:
    """Print one row a kind of footage: phase error of each surface and scene, rad."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stripes", choices=("horizontal", "vertical"), default="horizontal")
    stripes = parser.parse_args().stripes
    warnings.simplefilter("ignore", DecodeWarning)
    runtime.init("cpu")
    rig = simulated_rig(stripes=stripes)
    table: dict[str, list[str]] = {}
    for settings_of in SURFACES.values():
        for scene in SCENES:
            settings = SimulationSettings.model_validate({"scene": scene, **settings_of})
            truth = simulate_frame(rig, settings)
            calibration = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})

            column = {}
            with tempfile.TemporaryDirectory() as name:
                for kind, make in kinds(truth.image, stripes, Path(name)):
                    for old in Path(name).iterdir():
                        shutil.rmtree(old) if old.is_dir() else old.unlink()
                    image = np.ascontiguousarray(make())
                    column[kind] = phase_error(image, truth, calibration, stripes, 5)
                    if kind in ("Bayer", "the arrays themselves"):
                        column[f"{kind}, unsmoothed"] = phase_error(image, truth, calibration, stripes, 0)
            if stripes == "horizontal":
                column.update(limits(truth, settings))
            for kind, value in column.items():
                table.setdefault(kind, []).append(value)
    heads = [f"{surface}: {scene}" for surface in SURFACES for scene in SCENES]
    print(f"| phase error, rad | {' | '.join(heads)} |")
    print("|---" * (1 + len(heads)) + "|")
    for kind, values in table.items():
        print(f"| {kind} | {' | '.join(values)} |")


if __name__ == "__main__":
    main()
