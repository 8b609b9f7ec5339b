"""A whole file of every kind that is read, and what its reader makes of a damaged one."""

import hashlib
import json
import shutil
from base64 import b64encode
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from support.damage import damaged, with_png_checksums
from support.foreign_calibrations import CAMERA_PX, PROJECTOR_PX, kalibr, matlab, opencv, rig
from support.numbered_frames import record
from support.stored_planes import LENS, reseal, store
from support.tilted_sheets import PROVENANCE, tilted_grid
from support.video_files import H264, MJPEG, encode, moving_planes

from pipeline.acquisition.chosen_rig import read_rig
from pipeline.calibration import Calibration, Pattern
from pipeline.calibration.color_chart import read_spectra
from pipeline.calibration.foreign import read_foreign
from pipeline.errors import DamageError
from pipeline.footage.footage import StoredFrame
from pipeline.footage.image_file import read_image
from pipeline.footage.opening import open_footage
from pipeline.output.formats.ros_bag import write_bag
from pipeline.output.formats.table import FORMATS, encode_as
from pipeline.output.mesh import Mesh
from pipeline.output.mesh_files import read_mesh, write_mesh
from pipeline.output.store_files import MARK_BYTES
from pipeline.output.stored_result import StoredResult
from pipeline.output.surface_mesh import frame_mesh
from pipeline.recording.video_export import export_video
from pipeline.settings import DecodeSettings
from pipeline.simulation import simulated_rig
from pipeline.zarr_chunks import with_checksum, without_checksum
from tikernels.errors import Error
from tikernels.raw.pixel_format import PixelFormat

#: What became of a damaged file.
REFUSED, IN_PART, SAME, OTHERWISE = "refused", "read in part", "read as before", "read otherwise"


@dataclass(frozen=True)
class Reading:
    """What a reader returned: a digest of each part, and whether it said that others are lost."""

    parts: dict[str, str]
    told: bool = False


@dataclass(frozen=True)
class Sample:
    """A whole file or folder, and how it is read."""

    name: str
    read: Callable[[Path], Reading]
    text: bool = False
    checked: bool = False  # whether its checksums tell every damage that is no intent


def _digest(*values: Any) -> str:
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            digest.update(f"{value.shape} {value.dtype}".encode() + np.ascontiguousarray(value).tobytes())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()


def _read_picture(path: Path) -> Reading:
    return Reading({"picture": _digest(read_image(path))})


def _read_frames(path: Path) -> Reading:
    source = open_footage(path)
    parts, told = {}, bool(source.notes)
    for frame in source.frames(0, 40):
        if isinstance(frame, StoredFrame):
            parts[str(frame.number)] = _digest(*frame.planes)
        else:
            told = True
            _check_line(frame.reason)
    return Reading(parts, told)


def _read_store(path: Path) -> Reading:
    stored = StoredResult(path)
    parts, told = {}, len(stored.done) < len(_DISTANCES)  # of frames that are not done it says so
    for name in ("mask", "range_image", "phase_sigma"):
        for number in stored.done:
            try:
                parts[f"{name} {number}"] = _digest(getattr(stored.frame(number), name))
            except Error as error:
                told = True
                _check_line(str(error))
    return Reading(parts, told)


def _read_all_of_a_store(path: Path) -> Reading:
    """Read whatever can be asked of a store; nothing tells its checksums' damage, which is none."""
    stored = StoredResult(path)
    known = [stored.size_px, len(stored.wanted), stored.front_known, stored.camera, bool(stored._repr_html_())]
    for number in stored.done:
        with suppress(Error):
            known += [stored.frame(number).warnings, stored.frame(number).time_s, stored.frame(number).digest]
            known += [stored.fault(number), len(frame_mesh(stored.frame(number)).vertices)]
    return Reading({"all": _digest(*known)})


def _read_mesh(path: Path) -> Reading:
    mesh = read_mesh(path)
    return Reading({"mesh": _digest(mesh.vertices, mesh.faces, mesh.colors, *sorted(mesh.properties.items()))})


def _read_import(path: Path) -> Reading:
    """Read another program's calibration, as `colorphase calibrate import` does."""
    rig = read_foreign(path, Pattern(period_px=16), CAMERA_PX, PROJECTOR_PX, 1.0)
    return Reading({"model": _digest(rig.model_dump_json(), rig.geometry().translation_mm)})


def _reader_of(read: Callable[[Path], Any]) -> Callable[[Path], Reading]:
    def reader(path: Path) -> Reading:
        model = read(path)
        return Reading({"model": _digest(json.dumps(model.model_dump(mode="json")))})

    return reader


def _check_line(message: str) -> None:
    if "\n" in message or not message:
        raise AssertionError(f"{message!r} is not one line")


SAMPLES = {
    sample.name: sample
    for sample in (
        Sample("picture.png", _read_picture),
        Sample("frame.png", _read_frames),
        Sample("deep.png", _read_picture),
        Sample("picture.jpg", _read_picture),
        Sample("frame.jpg", _read_frames),
        Sample("picture.tif", _read_picture),
        Sample("float.tif", _read_frames),
        Sample("stack.tif", _read_frames),
        Sample("picture.bmp", _read_picture),
        Sample("picture.webp", _read_picture),
        Sample("frame.webp", _read_frames),
        Sample("picture.ppm", _read_picture),
        Sample("recording.mkv", _read_frames),
        Sample("film.avi", _read_frames),
        Sample("film.mp4", _read_frames),
        Sample("recording.zarr", _read_frames, checked=True),
        Sample("result.zarr", _read_store, checked=True),
        Sample("resealed.zarr", _read_all_of_a_store),
        Sample("calibration.json", _reader_of(Calibration.read), text=True),
        Sample("settings.toml", _reader_of(DecodeSettings.read), text=True),
        Sample("rig.toml", _reader_of(read_rig), text=True),
        Sample("spectra.csv", lambda path: Reading({"table": _digest(read_spectra(path))}), text=True),
        Sample("opencv.yml", _read_import, text=True),
        Sample("opencv.xml", _read_import, text=True),
        Sample("kalibr.yaml", _read_import, text=True),
        Sample("matlab.json", _read_import, text=True),
        Sample("mesh.ply", _read_mesh),
        Sample("ascii.ply", _read_mesh, text=True),
        Sample("mesh.obj", _read_mesh, text=True),
        Sample("textured", lambda folder: _read_mesh(folder / "mesh.obj")),
        Sample("mesh.stl", _read_mesh),
        Sample("meshlab_ascii.stl", _read_mesh, text=True),
        Sample("mesh.glb", _read_mesh),
        Sample("textured.glb", _read_mesh),
        Sample("mesh.gltf", _read_mesh, text=True),
        Sample("mesh.wrl", _read_mesh, text=True),
        Sample("grid.pcd", _read_mesh),
        Sample("pcl_ascii.pcd", _read_mesh, text=True),
        Sample("pcl_compressed.pcd", _read_mesh),
        Sample("depth.png", _read_mesh),
        Sample("depth.tiff", _read_mesh),
        Sample("bag.mcap", _read_mesh),
    )
}
_DISTANCES = (400.0, 410.0, None, 420.0)
_SETTINGS = """camera_period_px = 12.5
stripes = "horizontal"
crosstalk_matrix = [[0.9, 0.1, 0.0], [0.1, 0.8, 0.1], [0.0, 0.1, 0.9]]
transfer = "srgb"
smoothing_px = 7
projector_side = "above"
row_s = 2e-05
frame_s = 0.0333
fields = { cycle_s = 0.0167 }
noise = [1.5, 0.02]
white_level = 255
min_intensity = 3.0
min_modulation = 1.5
capture = { exposure_s = 0.01, gain = 2.0 }
"""
_RIG = """[trigger]
driver = "box"
port = "/dev/ttyUSB0"
baud = 115200
[timing]
period_s = 0.1
frames = 30
projector_delay_s = 0.001
[camera]
driver = "basler"
serial = 40012345
exposure_s = 0.0166667
gain_db = 3.0
size_px = [640, 480]
[projector]
colour_cycle_s = 0.0166667
control = "pjlink"
port = "socket://10.0.0.6:4352"
fields = { red_s = 0.001, green_s = 0.006, blue_s = 0.011 }
"""


def make_samples(folder: Path) -> None:
    """Write all of them by what the project writes them with."""
    rng = np.random.default_rng(5)
    image = rng.integers(0, 255, (48, 64, 3), np.uint8)
    image[:, 32:] = 128
    for name in SAMPLES:
        stem, suffix = Path(name).stem, Path(name).suffix
        if suffix in (".png", ".jpg", ".tif", ".bmp", ".webp", ".ppm") and stem != "depth":
            levels = {"deep": image.astype(np.uint16) * 257, "float": image.astype(np.float32) / 255}.get(stem, image)
            pages = [levels] * (3 if stem == "stack" else 1)
            (folder / name).write_bytes(cv2.imencodemulti(suffix, pages)[1].tobytes())
    record(folder / "recording.zarr")
    export_video(folder / "recording.zarr", folder / "recording.mkv")
    store(folder / "result.zarr", _DISTANCES)
    store(folder / "resealed.zarr", _DISTANCES, lens=LENS)
    yuv = moving_planes(6, PixelFormat("yuv", subsampling=(2, 2)))
    encode(folder / "film.avi", yuv, *MJPEG)
    encode(folder / "film.mp4", yuv, *H264)
    rig = simulated_rig((64, 48)).model_dump(mode="json")
    rig |= {"crosstalk_matrix": np.eye(3).tolist(), "depth_range_mm": [500.0, 1500.0]}
    rig |= {"color_shift_px": {"camera": [[0, 0.1]] * 3, "projector": [[0, 0.2]] * 3}, "capture": {"exposure_s": 0.01}}
    (folder / "calibration.json").write_text(json.dumps(rig))
    (folder / "settings.toml").write_text(_SETTINGS)
    (folder / "rig.toml").write_text(_RIG)
    rows = [f"{wavelength}," + ",".join(["0.5"] * 24) for wavelength in range(380, 740, 10)]
    (folder / "spectra.csv").write_text("\n".join(rows))
    _make_calibrations(folder)
    _make_meshes(folder, image, rng)


def _make_calibrations(folder: Path) -> None:
    for name in ("opencv.yml", "opencv.xml"):
        opencv(folder / name, rig())
    (folder / "kalibr.yaml").write_text(kalibr(rig()))
    (folder / "matlab.json").write_text(json.dumps(matlab(rig()), indent=1))


def _make_meshes(folder: Path, image: Any, rng: np.random.Generator) -> None:
    vertices = rng.uniform(0, 100, (30, 3)).astype(np.float32)
    faces = rng.integers(0, 30, (40, 3)).astype(np.int32)
    colors = rng.integers(0, 255, (30, 3)).astype(np.uint8)
    mesh = Mesh(vertices, faces, colors, {"sigma_mm": vertices[:, 0]}, provenance=PROVENANCE)
    for name in ("mesh.ply", "mesh.obj", "mesh.stl", "mesh.glb", "mesh.wrl"):
        write_mesh(mesh, folder / name)
    textured = replace(mesh, texture=image, pixels=vertices[:, :2] % 48)
    (folder / "textured").mkdir()
    for name in ("textured/mesh.obj", "textured.glb"):
        write_mesh(textured, folder / name)
    (folder / "mesh.gltf").write_bytes(_gltf((folder / "mesh.glb").read_bytes()))
    (folder / "ascii.ply").write_bytes(_ascii_ply(vertices, faces, colors))
    grid = tilted_grid()
    for name, kind in (("grid.pcd", "pcd"), ("depth.png", "png"), ("depth.tiff", "tiff")):
        (folder / name).write_bytes(encode_as(FORMATS[kind], grid, "grid", 600.0)[f".{kind}"])
    write_bag(folder / "bag", [grid], PROVENANCE)
    shutil.copy(folder / "bag" / "bag.mcap", folder)
    for name in ("meshlab_ascii.stl", "pcl_ascii.pcd", "pcl_compressed.pcd"):
        shutil.copy(Path(__file__).parent / "foreign" / name, folder)


def _gltf(binary: bytes) -> bytes:
    """Return a binary glTF file as text."""
    size = int.from_bytes(binary[12:16], "little")
    scene = json.loads(binary[20 : 20 + size])
    scene["buffers"][0]["uri"] = "data:;base64," + b64encode(binary[28 + size :]).decode()
    return json.dumps(scene, indent=1).encode()


def _ascii_ply(vertices: Any, faces: Any, colors: Any) -> bytes:
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    points: Iterable[str] = (
        f"{x:.4f} {y:.4f} {z:.4f} {r} {g} {b}\n" for (x, y, z), (r, g, b) in zip(vertices, colors, strict=True)
    )
    return (head + "".join(points) + "".join("3 {} {} {}\n".format(*face) for face in faces)).encode()


def damage_sample(sample: Sample, whole: Path, target: Path, rng: np.random.Generator) -> bool:
    """Write a damaged copy of a sample; return whether its checksums were made right again, as somebody can."""
    intent = bool(rng.random() < 0.4)
    if not whole.is_dir():
        data = damaged(whole.read_bytes(), rng, text=sample.text)
        intent = intent and whole.suffix == ".png"
        target.write_bytes(with_png_checksums(data) if intent else data)
        return intent
    shutil.copytree(whole, target)
    if sample.name == "resealed.zarr":
        _damage_and_reseal(target, rng)
        return True
    files = sorted(path for path in target.rglob("*") if path.is_file())
    if sample.name == "textured":
        path = files[rng.integers(len(files))]
        path.write_bytes(damaged(path.read_bytes(), rng, text=path.suffix != ".png"))
        return True
    heads = [path for path in files if path.suffix == ".json"]
    chosen = heads if rng.random() < 0.5 else [path for path in files if path not in heads]
    path = chosen[rng.integers(len(chosen))]
    if path in heads:
        path.write_bytes(damaged(path.read_bytes(), rng, text=True))
        return True  # heads of recordings have no checksum
    if rng.random() < 0.1:
        path.unlink()
    elif intent:
        with suppress(DamageError):
            path.write_bytes(with_checksum(damaged(without_checksum(path.read_bytes()), rng)))
            return True
    else:
        path.write_bytes(damaged(path.read_bytes(), rng))
    return False


def _damage_and_reseal(store_path: Path, rng: np.random.Generator) -> None:
    """Damage a head, a frame's mark or a chunk of a store, so that no checksum tells."""
    kind = rng.random()
    files = sorted(path for path in store_path.rglob("*") if path.is_file())
    if kind < 0.7:
        heads = [path for path in files if path.name == "zarr.json"]
        path = store_path / "zarr.json" if kind < 0.4 else heads[rng.integers(len(heads))]
        path.write_bytes(damaged(path.read_bytes(), rng, text=True))
        with suppress(ValueError, RecursionError):
            path.write_text(json.dumps(json.loads(path.read_bytes()), indent=2))
        reseal(store_path)
        return
    mark = store_path / "done" / "c.0.0"
    said = without_checksum(mark.read_bytes())
    if kind < 0.85:
        said = damaged(said.rstrip(), rng, text=True)
    else:
        name = str(rng.choice(["mask", "points", "range_image"]))
        (chunk,) = (store_path / name).glob("c.0.*")
        content = with_checksum(damaged(without_checksum(chunk.read_bytes()), rng))
        chunk.write_bytes(content)
        about = json.loads(said)
        about["chunks"][name] = content[-4:].hex()
        said = json.dumps(about).encode()
    mark.write_bytes(with_checksum(said.ljust(MARK_BYTES)[:MARK_BYTES]))


def outcome(sample: Sample, path: Path, whole: Reading) -> str:
    """Read a file; return what became of it.

    Raises
    ------
    Exception
        Anything but the project's own errors, which is what nobody wants to see.
    """
    try:
        reading = sample.read(path)
    except Error as error:
        _check_line(str(error))
        return REFUSED
    if reading.parts == whole.parts:
        return SAME
    if reading.told and reading.parts.items() <= whole.parts.items():
        return IN_PART if reading.parts else REFUSED
    return OTHERWISE
