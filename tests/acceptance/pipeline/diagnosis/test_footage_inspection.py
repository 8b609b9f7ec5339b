"""What is said of footage with a single known fault: that one, and none besides."""

import json

import cv2
import numpy as np
import pytest
import reference
from support.command_line import colorphase
from support.video_files import H264, encode, flip

from pipeline.diagnosis.footage_inspection import inspect_footage
from pipeline.errors import FootageError
from pipeline.footage.footage import StoredAs
from pipeline.recording.recorder import Recorder
from pipeline.recording.video_export import export_video
from pipeline.settings import DecodeSettings
from pipeline.simulation import WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels.raw.pixel_format import PixelFormat

pytestmark = pytest.mark.usefixtures("cpu")

RGB = PixelFormat("rgb")
LEFT = PixelFormat("yuv", subsampling=(2, 2), matrix="bt601")
CENTRE = PixelFormat("yuv", subsampling=(2, 2), siting="centre", matrix="bt601")
FULL = PixelFormat("yuv", matrix="bt601")
WHITE_SURFACE = {"gamma": 1.0, "reflectance": WHITE}


def shoot(n_frames, stripes="horizontal", seed=0, **settings):
    """Return frames of a bust that moves a little."""
    rig = simulated_rig((320, 240), period_px=2 * 768 / 44, stripes=stripes)
    return [
        simulate_frame(
            rig,
            SimulationSettings(
                **{"object_motion_mm": (0.3 * i, 0.0, 0.2 * i), "seed": 1000 * seed + i, "scene": "bust", **settings}
            ),
        ).image
        for i in range(n_frames)
    ]


def record(path, frames, format=RGB, **options):
    with Recorder(path, format, **options) as recorder:
        for frame in frames:
            recorder.add(frame)
    return path


def film(path, frames, format, codec, pixels, options=None, **more):
    planes = [reference.subsample_chroma(frame / 255, format) for frame in frames]
    return encode(path, planes, codec, pixels, options, **more)


def faults(path, says=None, settings=None):
    """Return what costs or spoils, with its grade; the total is not a fault of its own."""
    found = inspect_footage(path, says, settings, "cpu")
    assert found.n_looked_at <= 20
    return {f.topic: f.grade for f in found.findings if f.grade != "fine" and f.topic != "total"}


@pytest.fixture(scope="module")
def clip(cpu):
    """Return fourteen good frames of the hard surface."""
    return shoot(14, seed=1)


@pytest.mark.parametrize(
    "seed, settings",
    [
        (2, {}),
        (3, WHITE_SURFACE),
        (4, {"scene": "waves", **WHITE_SURFACE}),
        (7, {"scene": "plane", "bits": 12}),
        (5, {"scene": "objects"}),
        (6, {"scene": "ball", "gamma": 1.5}),
    ],
)
def test_good_footage_has_no_fault(tmp_path, seed, settings):
    bits = settings.get("bits", 8)
    path = record(tmp_path / "good.zarr", shoot(4, seed=seed, **settings), PixelFormat("rgb", bits))
    # Objects show too little smooth surface to tell their light, which is said.
    assert faults(path) == ({"transfer": "costs"} if settings.get("scene") == "objects" else {})


def test_over_exposure(tmp_path):
    for seed, surface, grade in ((8, {}, "costs"), (9, WHITE_SURFACE, "spoils")):
        path = record(tmp_path / f"{seed}.zarr", shoot(3, seed=seed, exposure=1.9, **surface))
        assert faults(path) == {"saturation": grade}


def test_a_transfer_that_is_left_in(tmp_path):
    """The third harmonic of sRGB values read as linear light is 0.153 rad with full modulation, an RMS of 0.108."""
    frames = shoot(3, seed=10, transfer="srgb", **WHITE_SURFACE)
    path = record(tmp_path / "srgb.zarr", frames)
    found = inspect_footage(path, arch="cpu")
    (transfer,) = [f for f in found.findings if f.grade != "fine"]
    assert transfer.topic == "transfer" and transfer.grade == "spoils" and "srgb" in transfer.advice
    assert 0.05 < transfer.cost_rad < 0.108
    assert faults(path, settings=DecodeSettings(transfer="srgb")) == {}
    assert faults(record(tmp_path / "said.zarr", frames, transfer="srgb")) == {}
    # And the other way round: what is said to be sRGB is linear.
    linear = shoot(3, seed=11, **WHITE_SURFACE)
    assert faults(record(tmp_path / "not.zarr", linear, transfer="srgb")) == {"transfer": "spoils"}


def test_low_contrast(tmp_path):
    found = faults(record(tmp_path / "faint.zarr", shoot(3, seed=12, ambient=4.0)))
    assert found.keys() == {"contrast"}


@pytest.mark.parametrize("wanted, there", [("horizontal", "vertical"), ("vertical", "horizontal")])
def test_stripes_the_other_way(tmp_path, wanted, there):
    path = record(tmp_path / "turned.zarr", shoot(3, there, seed=13))
    assert faults(path, settings=DecodeSettings(stripes=wanted)) == {"direction": "spoils"}
    assert faults(path, settings=DecodeSettings(stripes=there)) == {}


def test_drift_of_exposure_and_of_white_balance(tmp_path, clip):
    gains = {
        "exposure": lambda part: 0.7 + 0.25 * part,
        "white": lambda part: np.array([0.8 + 0.1 * part, 0.9, 1 - 0.1 * part]),
    }
    for name, gain in gains.items():
        frames = [np.rint(frame * gain(i / 13)).astype(np.uint8) for i, frame in enumerate(clip)]
        assert faults(record(tmp_path / f"{name}.zarr", frames)) == {"drift": "costs"}


def test_an_object_that_turns_is_no_drift(tmp_path):
    frames = [shoot(1, seed=i, object_turn_deg=4.0 * i)[0] for i in range(14)]
    assert "drift" not in faults(record(tmp_path / "turns.zarr", frames))


def test_repeated_frames(tmp_path, clip):
    assert faults(record(tmp_path / "twice.zarr", [clip[i // 2] for i in range(14)])) == {"repeated": "costs"}


def test_dropped_frames(tmp_path, clip):
    stamps = [*range(6), *range(8, 16)]
    path = film(tmp_path / "gap.mkv", clip, FULL, "ffv1", "yuv444p", stamps=stamps)
    found = inspect_footage(path, arch="cpu")
    (dropped,) = [f for f in found.findings if f.grade != "fine"]
    assert dropped.topic == "dropped" and "2 frames" in dropped.found
    assert faults(film(tmp_path / "whole.mkv", clip, FULL, "ffv1", "yuv444p")) == {}


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_subsampled_chroma_and_where_it_sits(tmp_path, stripes):
    settings = DecodeSettings(stripes=stripes)
    frames = shoot(3, stripes, seed=14)
    left = film(tmp_path / "left.mp4", frames, LEFT, *H264)
    assert faults(left, settings=settings) == {"chroma": "costs"}
    centre = film(tmp_path / "centre.mp4", frames, CENTRE, *H264)
    found = inspect_footage(centre, settings=settings, arch="cpu")
    (siting,) = [f for f in found.findings if f.topic == "siting"]
    assert siting.grade == "spoils" and "--siting centre" in siting.advice
    assert {f.topic for f in found.findings if f.grade != "fine"} <= {"siting", "chroma", "total"}
    assert faults(centre, StoredAs(siting="centre"), settings).keys() == {"chroma"}


def test_colours_that_a_library_has_repeated(tmp_path):
    (frame,) = shoot(1, seed=14)
    path = film(tmp_path / "film.mp4", [frame], LEFT, *H264)
    (tmp_path / "frame.png").write_bytes(cv2.imencode(".png", cv2.VideoCapture(str(path)).read()[1])[1].tobytes())
    found = inspect_footage(tmp_path / "frame.png", arch="cpu")
    (chroma,) = [f for f in found.findings if f.grade != "fine" and f.topic != "total"]
    assert chroma.topic == "chroma" and "each colour is repeated for 2x2 pixels" in chroma.found
    assert "decode the video itself" in chroma.advice


def test_a_codec_that_is_given_too_few_bits(tmp_path):
    costs = []
    for crf in ("10", "23"):
        path = film(tmp_path / f"{crf}.mp4", shoot(3, seed=15), FULL, "libx264", "yuv444p", {"crf": crf})
        found = inspect_footage(path, arch="cpu")
        assert {f.topic for f in found.findings if f.grade != "fine"} - {"total"} == {"codec"}
        costs.append(next(f.cost_rad for f in found.findings if f.topic == "codec"))
    assert costs[1] > 1.5 * costs[0]


def test_bits_that_are_not_used(tmp_path):
    frames = shoot(2, seed=19, bits=12)
    path = record(tmp_path / "twelve.zarr", frames, PixelFormat("rgb", 16))
    found = inspect_footage(path, arch="cpu")
    (depth,) = [f for f in found.findings if f.grade != "fine"]
    assert depth.topic == "depth" and "--bits 12" in depth.advice
    assert faults(path, StoredAs(bits=12)) == {}


def test_what_shows_no_fringes(tmp_path):
    noise = [np.random.default_rng(i).integers(0, 256, (240, 320, 3)).astype(np.uint8) for i in range(3)]
    assert faults(record(tmp_path / "noise.zarr", noise)) == {"fringes": "spoils"}


def test_damage(tmp_path, clip):
    path = tmp_path / "whole.mkv"
    export_video(record(tmp_path / "whole.zarr", clip), path)
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    assert faults(cut) == {"truncated": "spoils"}
    flip(path, 6)
    assert faults(path) == {"damaged": "spoils"}
    video = film(tmp_path / "whole.mp4", clip[:3], LEFT, *H264)
    video.write_bytes(video.read_bytes()[:-200])
    with pytest.raises(FootageError, match="cut off or damaged"):
        inspect_footage(video, arch="cpu")


def test_frames_that_cannot_be_decoded(tmp_path, clip):
    """One NaN spoils its frame, and not what is said of the others."""
    images = [frame / np.float32(255) for frame in clip[:5]]
    images[2][5, 5] = np.nan
    assert faults(record(tmp_path / "nan.zarr", images, PixelFormat("rgb", 32))) == {"damaged": "spoils"}


def test_frames_that_are_missing_from_a_folder(tmp_path, clip):
    import cv2

    for i, frame in enumerate(clip[:6]):
        number = i if i < 3 else i + 1
        (tmp_path / f"frame{number}.png").write_bytes(cv2.imencode(".png", frame[..., ::-1])[1].tobytes())
    assert faults(tmp_path) == {"dropped": "costs"}


def test_few_frames_of_long_footage_are_looked_at(tmp_path, clip):
    path = record(tmp_path / "long.zarr", [clip[i % 14] for i in range(120)])
    found = inspect_footage(path, arch="cpu")
    assert found.n_frames == 120 and 12 <= found.n_looked_at <= 20
    assert any("20 of 120" in sentence or f"{found.n_looked_at} of 120" in sentence for sentence in found.unknown)


def test_on_every_backend(tmp_path, arch):
    path = record(tmp_path / "srgb.zarr", shoot(2, seed=16, transfer="srgb", **WHITE_SURFACE))
    found = inspect_footage(path, arch=arch)
    assert {f.topic for f in found.findings if f.grade != "fine"} == {"transfer"}


def test_motion_of_more_than_a_third_of_a_cycle(tmp_path):
    frames = shoot(3, seed=17, scene="ball", object_motion_mm=(0.0, 0.0, 0.0))
    later = shoot(3, seed=18, scene="ball", object_motion_mm=(0.0, 0.0, 36.0))  # 0.07 rad a mm
    path = record(tmp_path / "fast.zarr", [frames[0], later[1], frames[2]])
    assert faults(path) == {"motion": "spoils"}


def test_colours_that_are_shown_one_after_another(tmp_path):
    """A plane that swings to and fro; green and blue see it 0.3 of a frame later than the colour before them."""

    def swinging(share):
        noise = np.random.default_rng(22)
        still = reference.ramp(180, 240, 12.0)[..., None] - np.array([0, 1, 2]) * 2 * np.pi / 3
        for t in range(14):
            moved = 0.8 * np.sin(0.35 * (t + share * np.arange(3)))
            yield np.rint(100 + 60 * np.cos(still + moved) + noise.normal(0, 1, still.shape)).astype(np.uint8)

    assert "colour fields" not in faults(record(tmp_path / "one.zarr", swinging(0.0)))
    assert faults(record(tmp_path / "three.zarr", swinging(0.3)))["colour fields"] == "costs"


def test_the_command(tmp_path, clip):
    good, bad = record(tmp_path / "good.zarr", clip[:3]), record(tmp_path / "bad.zarr", 3 * [clip[0] * 0])

    def run(*arguments):
        return colorphase("inspect", *arguments, "--arch", "cpu", cwd=tmp_path)

    done = run(good)
    assert done.returncode == 0, done.stderr
    assert "saturation" in done.stdout and done.stdout.strip().endswith("fine")
    done = run(bad, "--json")
    assert done.returncode == 3
    assert json.loads(done.stdout)["grade"] == "spoils"
    done = run(tmp_path / "none.mkv")
    assert done.returncode == 1 and "no such file" in done.stderr
