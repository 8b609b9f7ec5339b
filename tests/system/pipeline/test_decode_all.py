"""Footage decoded frame by frame from Python: order, times, light, damage."""

from itertools import pairwise

import cv2
import numpy as np
import pytest

import colorphase
from pipeline.footage.footage import BadFrame
from pipeline.models import SensorPart

pytestmark = [pytest.mark.usefixtures("cpu"), pytest.mark.filterwarnings("ignore::pipeline.DecodeWarning")]

SIZE = (192, 144)
N_FRAMES = 5


@pytest.fixture(scope="module")
def rig():
    simulated = colorphase.simulated_rig(SIZE, period_px=58, code="contrast")
    return simulated.model_copy(update={"crosstalk_matrix": colorphase.SimulationSettings().crosstalk_matrix})


@pytest.fixture(scope="module")
def images(rig, cpu):
    scenes = [colorphase.SimulationSettings(object_motion_mm=(2.0 * k, 0.0, 0.0), seed=k) for k in range(N_FRAMES)]
    return [np.asarray(colorphase.simulate_frame(rig, scene).image, np.uint8) for scene in scenes]


@pytest.fixture(scope="module")
def film(images, tmp_path_factory):
    path = tmp_path_factory.mktemp("film") / "film.zarr"
    with colorphase.Recorder(path, colorphase.PixelFormat("rgb"), rate_hz=25) as recorder:
        for image in images:
            recorder.add(image)
    return path


def test_each_frame_is_decoded_with_the_one_before(rig, images, film):
    with colorphase.open_footage(film) as footage:
        found = list(colorphase.Decoder(calibration=rig, arch="cpu").decode_all(footage))
        part = list(colorphase.Decoder(calibration=rig, arch="cpu").decode_all(footage, 1, None, 2))
    assert [frame.number for frame in found] == list(range(N_FRAMES)) and [frame.number for frame in part] == [1, 3]
    assert [frame.time_s for frame in found] == pytest.approx([k / 25 for k in range(N_FRAMES)])
    assert not any(frame.dated for frame in found)
    decoder, before = colorphase.Decoder(calibration=rig, arch="cpu"), None
    for frame, image in zip(found, images, strict=True):
        before = decoder.decode(image, previous=before)
        np.testing.assert_array_equal(frame.points, before.points)


def test_frames_that_were_left_out_count_as_time(rig, film, monkeypatch):
    elapsed = []
    decode = colorphase.Decoder.decode

    def noted(self, image, previous=None, out=None, elapsed_=1.0, **how):
        elapsed.append(how["elapsed"])
        return decode(self, image, previous, out, **how)

    monkeypatch.setattr(colorphase.Decoder, "decode", noted)
    decoder = colorphase.Decoder(colorphase.DecodeSettings(frame_s=0.02), rig, arch="cpu")
    with colorphase.open_footage(film) as footage:  # whose frames are 0.04 s apart
        list(decoder.decode_all(footage, step=2))
    assert elapsed == [1.0, 4, 4]


def test_the_footage_says_how_its_light_is_encoded(rig, images, tmp_path):
    """A JPEG is sRGB; a decoder that is told so decodes it alike, and one that is told otherwise does not."""
    for number, image in enumerate(images[:2]):
        encoded = np.rint(255 * (image / 255.0) ** (1 / 2.2)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"{number}.jpg"), encoded[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])
    with colorphase.open_footage(tmp_path) as footage:
        assert footage.transfer == "srgb"
        (first, _) = colorphase.Decoder(calibration=rig, arch="cpu").decode_all(footage)
        told = colorphase.Decoder(colorphase.DecodeSettings(transfer="srgb"), rig, arch="cpu")
        (stated, _) = told.decode_all(footage)
        (linear, _) = colorphase.Decoder(colorphase.DecodeSettings(transfer="linear"), rig, arch="cpu").decode_all(
            footage
        )
    assert first.settings.transfer == "srgb"
    np.testing.assert_array_equal(first.points, stated.points)
    both = first.mask & linear.mask
    assert np.abs(first.range_image - linear.range_image)[both].max() > 0.1


def test_a_part_of_the_sensor_is_decoded_by_its_part_of_the_calibration(rig, images, tmp_path):
    whole = rig.model_copy(update={"sensor": SensorPart(sensor_px=SIZE, offset_px=(0, 0), binning=(1, 1))})
    part = SensorPart(sensor_px=SIZE, offset_px=(32, 16), binning=(1, 1))
    with colorphase.Recorder(tmp_path / "part.zarr", colorphase.PixelFormat("rgb"), sensor=part) as recorder:
        recorder.add(np.ascontiguousarray(images[0][16:144, 32:192]))
    with colorphase.open_footage(tmp_path / "part.zarr") as footage:
        (frame,) = colorphase.Decoder(calibration=whole, arch="cpu").decode_all(footage)
        with pytest.raises(colorphase.CalibrationError, match="160x128"):
            next(colorphase.Decoder(calibration=rig, arch="cpu").decode_all(footage))
    expected = colorphase.Decoder(calibration=whole, arch="cpu").decode(images[0])
    both = frame.mask & expected.mask[16:, 32:]
    assert both.mean() > 0.8
    assert np.nanmedian(np.abs(frame.range_image - expected.range_image[16:, 32:])[both]) < 0.3


def test_bad_frames_end_it_or_are_left_out(rig, film, tmp_path):
    with colorphase.open_footage(film) as footage:
        whole = footage.frames

        def frames(*which):
            for stored in whole(*which):
                yield BadFrame(2, "it is torn") if stored.number == 2 else stored

        footage.frames = frames
        decoder = colorphase.Decoder(calibration=rig, arch="cpu")
        seen = []
        with pytest.raises(colorphase.FootageError, match=r"frame 2 of .*film\.zarr: it is torn"):
            for frame in decoder.decode_all(footage):
                seen.append(frame.number)
        assert seen == [0, 1]
        with pytest.warns(colorphase.DecodeWarning, match=r"frame 2 of .*film\.zarr is left out: it is torn"):
            assert [frame.number for frame in decoder.decode_all(footage, on_bad="skip")] == [0, 1, 3, 4]
        with pytest.raises(colorphase.FootageError, match=r"frame 2 of .*: it is torn"):
            list(footage.images())


def test_images_are_rgb_as_it_was_recorded(images, film):
    with colorphase.open_footage(film) as footage:
        found = list(footage.images(1, 4))
    for image, expected in zip(found, images[1:4], strict=True):
        np.testing.assert_array_equal(image, expected)
        image[:] = 0  # the caller's own


def test_a_result_is_a_sequence_of_frames(rig, film, tmp_path):
    """Of those that are done; `frame` counts in the footage."""
    how = {"calibration": rig, "arch": "cpu", "workers": 1}
    colorphase.decode_footage(film, tmp_path, fields=["all"], start=1, step=2, **how)
    result = colorphase.StoredResult(tmp_path / "result.zarr")
    assert len(result) == 2 and [frame.number for frame in result] == [1, 3] == [result[0].number, result[-1].number]
    assert [frame.number for frame in result[::-1]] == [3, 1] and result.frame(3).number == 3
    with pytest.raises(IndexError):
        _ = result[2]
    with colorphase.open_footage(film) as footage:
        (decoded, *_) = colorphase.Decoder(calibration=rig, arch="cpu").decode_all(footage, 1, None, 2)
    stored = result[0]
    assert stored.fields.keys() == decoded.fields.keys() and repr(stored) == repr(decoded).replace("Decoded", "Result")
    for name in ("points", "mask", "region", "absolute"):
        np.testing.assert_array_equal(getattr(stored, name), getattr(decoded, name))
    assert stored.points is stored.points
    with pytest.raises(AttributeError, match="has no gloss"):
        _ = stored.gloss
    some = tmp_path / "some"
    colorphase.decode_footage(film, some, fields=["mask", "points"], stop=1, **how)
    with pytest.raises(colorphase.FootageError, match="holds no phase_sigma: decode with that field"):
        _ = colorphase.StoredResult(some / "result.zarr")[0].phase_sigma


def test_frames_of_footage_are_joined_by_number_and_time(rig, film):
    xarray = pytest.importorskip("xarray")
    with colorphase.open_footage(film) as footage:
        frames = list(colorphase.Decoder(calibration=rig, arch="cpu").decode_all(footage, 0, 4, 3))
    joined = xarray.concat([frame.to_xarray() for frame in frames], "frame")
    assert joined.frame.values.tolist() == [0, 3] and joined.time.values.tolist() == pytest.approx([0, 0.12])
    assert joined.points.dims == ("frame", "y", "x", "xyz") and joined.points.attrs["units"] == "mm"
    np.testing.assert_array_equal(joined.points.sel(frame=3), frames[1].points)
    frames[0].time_s, frames[0].dated = 1795600800.25, True
    assert str(frames[0].to_xarray().time.values[0]) == "2026-11-25T10:00:00.250000000"


@pytest.mark.parametrize("suffix", "ply obj stl glb wrl pcd png tiff xyz csv npz zarr".split())
def test_a_frame_is_saved_by_its_suffix(rig, images, tmp_path, suffix):
    frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(images[0])
    path = tmp_path / f"face.{suffix}"
    frame.save(path)
    if suffix == "zarr":
        stored = colorphase.StoredResult(path)[0]
        np.testing.assert_array_equal(stored.points, frame.points)
        stored.save(tmp_path / "again.ply")
        with pytest.raises(colorphase.OutputError, match="'zarr' is no format: choose one of ply"):
            stored.save(tmp_path / "again.zarr")
    elif suffix in ("xyz", "csv", "npz"):
        assert path.stat().st_size > 10_000
    else:
        depth = colorphase.read_mesh(path).vertices[:, 2]
        assert abs(np.median(depth) - np.nanmedian(frame.range_image)) < 5


def test_what_cannot_be_saved_is_said(rig, images, tmp_path):
    frame = colorphase.Decoder(arch="cpu").decode(images[0])
    for name, message in (
        ("face.stp", "'stp' is no format: choose one of ply"),
        ("face.mcap", "holds all frames of a film"),
    ):
        with pytest.raises(colorphase.OutputError, match=message):
            frame.save(tmp_path / name)
    with pytest.raises(colorphase.FootageError, match="in rad, not in mm: decode with a calibration"):
        frame.save(tmp_path / "face.pcd")
    assert not list(tmp_path.iterdir())


def test_a_run_says_how_far_it_has_come(rig, film, tmp_path):
    heard = []
    how = {"calibration": rig, "arch": "cpu", "workers": 1, "crop": colorphase.Crop(0, 0, 128, 128)}
    summary = colorphase.decode_footage(film, tmp_path / "out", progress=heard.append, **how)
    assert summary.n_frames == N_FRAMES and not summary.bad
    done = [come.done for come in heard]
    assert done == sorted(done) and (heard[-1].done, heard[-1].of) == (N_FRAMES, N_FRAMES)
    assert heard[0].doing == "reading the footage" and all(a != b for a, b in pairwise(heard))
    assert colorphase.StoredResult(tmp_path / "out" / "result.zarr").size_px == (128, 128)
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "letter.txt").write_text("Dear")
    with pytest.raises(colorphase.OutputError, match=r"holds something else \(letter\.txt\)"):
        colorphase.decode_footage(film, tmp_path / "theirs", **how)
    assert [entry.name for entry in (tmp_path / "theirs").iterdir()] == ["letter.txt"]


def test_what_cannot_be_asked_for_is_refused(rig, film, tmp_path):
    with colorphase.open_footage(film) as footage:
        with pytest.raises(colorphase.SettingsError, match='on_bad is \'ignore\': give "raise" or "skip"'):
            next(colorphase.Decoder(calibration=rig, arch="cpu").decode_all(footage, on_bad="ignore"))
    for wrong, message in (
        ({"on_bad": "ignore"}, "on_bad is 'ignore'"),
        ({"step": 0}, "start is 0 and step 0: start at 0 or later, and go on by 1 or more"),
        ({"start": -1}, "start is -1 and step 1"),
    ):
        with pytest.raises(colorphase.SettingsError, match=message):
            colorphase.decode_footage(film, tmp_path / "out", **wrong)
    assert not (tmp_path / "out").exists()
