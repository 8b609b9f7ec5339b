"""Runs over footage: each frame once, the same bytes whatever happens on the way, one line where it cannot go on."""

import errno
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import zarr
from support.missing import import_but_fail_in_ci
from support.recorded_footage import contents, record

from pipeline import Decoder, DecodeSettings
from pipeline.batch import job as jobs
from pipeline.batch.job import Crop, Job
from pipeline.batch.run import Stopped, decode_job
from pipeline.decoding.frame import FIELDS, read_back
from pipeline.decoding.front_side import RimVotes
from pipeline.errors import CalibrationError, FootageError, OutputError, SettingsError
from pipeline.footage.footage import StoredAs
from pipeline.models import SensorPart
from pipeline.output.range_image import write_png
from pipeline.output.store import chosen_fields
from pipeline.output.stored_result import StoredResult
from pipeline.recording.recorder import Recorder
from pipeline.recording.video_export import export_video
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig
from tikernels.raw.pixel_format import PixelFormat

pytestmark = pytest.mark.usefixtures("cpu")

N_FRAMES = 14
CHAIN = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("footage")


@pytest.fixture(scope="module")
def rig(folder, cpu):
    """Return the calibration of the rig that has recorded the footage."""
    return record(folder / "film.zarr", N_FRAMES)


@pytest.fixture(autouse=True)
def short_chains(monkeypatch):
    monkeypatch.setattr(jobs, "CHAIN_FRAMES", CHAIN)


@pytest.fixture
def job(folder, rig, tmp_path):
    """Return a job without a calibration: the light is learnt."""
    return Job(
        footage=str(folder / "film.zarr"),
        says=StoredAs(),
        settings=DecodeSettings(),
        calibration=None,
        crop=None,
        step=1,
        first=0,
        fields=chosen_fields(None, in_mm=False),
        store=str(tmp_path / "result.zarr"),
        arch="cpu",
    )


@pytest.fixture(scope="module")
def undisturbed(folder, rig):
    """Return what an undisturbed run stores."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "CHAIN_FRAMES", CHAIN)
        store = folder / "undisturbed.zarr"
        fields = chosen_fields(None, in_mm=False)
        film = str(folder / "film.zarr")
        decode_job(Job(film, StoredAs(), DecodeSettings(), None, None, 1, 0, fields, str(store), "cpu"))
        return contents(store)


def marked(store):
    return {int(path.name.split(".")[1]) for path in (Path(store) / "done").glob("c.*")}


def test_a_run_stores_what_the_decoder_gives(job, folder):
    """Chains start afresh at every fourth frame, and each frame leans on the one before in its chain."""
    told = []
    summary = decode_job(job, notify=lambda *progress: told.append(progress))
    assert (summary.n_frames, summary.n_before, summary.bad) == (N_FRAMES, 0, [])
    assert told == [(n, N_FRAMES) for n in range(N_FRAMES + 1)]
    group = zarr.open_group(job.store, mode="r")
    frames = zarr.open_group(folder / "film.zarr", mode="r")["frames"]
    decoder, previous = Decoder(arch="cpu"), None
    light = decoder.decode(frames[0]) and decoder.state.light
    assert light is not None and light.reliable
    for number in range(N_FRAMES):
        previous = decoder.decode(frames[number], previous if number % CHAIN else None)
        for name in group.attrs["fields"]:
            stored, values = group[name][number], getattr(previous, name)
            np.testing.assert_array_equal(np.isnan(stored), np.isnan(values), err_msg=name)
            lost = np.nanmax(np.abs(np.subtract(stored, values, dtype=np.float64)))
            if name in ("wrapped_phase", "unwrapped_phase", "range_image"):
                assert lost <= 0.1 * np.nanmin(previous.phase_sigma)
            elif name == "modulation":
                assert lost <= 0.1 * previous.noise_levels
            elif name == "phase_sigma":
                np.testing.assert_allclose(stored, values, rtol=0.004)
            else:
                np.testing.assert_array_equal(stored, values, err_msg=name)
        assert np.nanmax(np.abs(group["wrapped_phase"][number])) <= np.pi
        record = json.loads(bytes(group["done"][number]))
        assert record["noise_levels"] == previous.noise_levels
        assert record["constant_known"] == previous.constant_known


def test_the_store_is_plain_zarr(job):
    decode_job(job, stop=3)
    group = zarr.open_group(job.store, mode="r")
    assert group.metadata.zarr_format == 3
    assert set(group.array_keys()) == {*job.fields, "done", "frame", "time", "y", "x", "rgb"}
    for name in job.fields:
        size = tuple({"y": 96, "x": 128}.get(axis, 3) for axis in FIELDS[name].axes)
        assert group[name].shape == (N_FRAMES, *size)
        assert group[name].chunks == (1, *size)
        assert group[name].dtype == FIELDS[name].dtype
    np.testing.assert_allclose(group["time"], np.arange(N_FRAMES) / 30)  # those that are not done, too
    assert bytes(group["done"][5]).strip() == b""
    assert np.isnan(group["range_image"][5]).all() and not group["mask"][5].any()


def test_a_second_run_does_nothing(job, undisturbed):
    decode_job(job)
    times = {path: path.stat().st_mtime_ns for path in Path(job.store).rglob("*")}
    summary = decode_job(job)
    assert summary.n_before == N_FRAMES
    assert {path: path.stat().st_mtime_ns for path in Path(job.store).rglob("*")} == times
    assert contents(Path(job.store)) == undisturbed


@pytest.mark.parametrize("parts", [((0, 6), (6, None)), ((7, 9), (3, 8), (0, None)), ((11, 12), (0, None))])
def test_parts_in_any_order_give_the_same_bytes(job, undisturbed, parts):
    for start, stop in parts:
        decode_job(job, start, stop)
    assert contents(Path(job.store)) == undisturbed


def test_steps(job, tmp_path):
    """Every third frame from the second on; the chains are of those frames, wherever the run begins."""
    job = replace(job, step=3, first=1)
    decode_job(job, start=1)
    assert marked(job.store) == {1, 4, 7, 10, 13}
    part = replace(job, store=str(tmp_path / "part.zarr"))
    decode_job(part, start=7, stop=11)
    assert marked(part.store) == {7, 10}
    for name in job.fields:
        for number in (7, 10):
            key = f"{name}/c.{number}" + ".0" * len(FIELDS[name].axes)
            assert (Path(part.store) / key).read_bytes() == (Path(job.store) / key).read_bytes(), key


def test_no_frames_are_asked_for(job):
    with pytest.raises(SettingsError, match="has 14 frames, none of which is selected"):
        decode_job(job, start=20)
    assert not Path(job.store).exists()


def test_leftovers_and_marks_cut_off(job, undisturbed):
    decode_job(job, stop=5)
    store = Path(job.store)
    (store / "done" / "c.3.0").write_bytes(b"")
    (store / "mask" / ".0123.part").write_bytes(b"half")
    (store / "zarr.0123.partial").write_bytes(b"half")
    decode_job(job)
    assert contents(store) == undisturbed


def test_damaged_frames_are_decoded_again(job, undisturbed):
    """By the run that goes on, which says which they were."""
    decode_job(job)
    store = Path(job.store)
    (store / "mask" / "c.3.0.0").unlink()
    chunk = bytearray((store / "range_image" / "c.9.0.0").read_bytes())
    chunk[len(chunk) // 2] ^= 8
    (store / "range_image" / "c.9.0.0").write_bytes(chunk)
    summary = decode_job(job, stop=8)
    assert summary.damaged == {3: "mask is missing"} and summary.n_before == 7
    summary = decode_job(job)
    assert summary.damaged.keys() == {9} and summary.n_before == N_FRAMES - 1
    assert contents(store) == undisturbed


@pytest.mark.parametrize("damage", [b"", b"{}", b"not JSON"])
def test_damaged_metadata_is_written_anew(job, undisturbed, damage):
    decode_job(job)
    (Path(job.store) / "zarr.json").write_bytes(damage)
    summary = decode_job(job)
    assert summary.n_before == N_FRAMES and "it is written anew" in summary.notes[-1]
    assert contents(Path(job.store)) == undisturbed


def test_arrays_of_another_making_do_not_pass(job, undisturbed):
    """Another shape, type or codec: what others have put there is written anew."""
    decode_job(job, stop=3)
    zarr.create_array(f"{job.store}/mask", shape=(N_FRAMES, 48, 64), dtype="f4", overwrite=True)
    summary = decode_job(job)
    assert summary.damaged == dict.fromkeys(range(3), "mask is missing")
    assert contents(Path(job.store)) == undisturbed


def test_what_is_said_of_a_run_before_and_while_frames_are_decoded(job, monkeypatch):
    """How large it will be, by a frame or by those that are there; which processes do not help; what is being done."""
    monkeypatch.setattr("pipeline.output.store.WORTH_SAYING", 1e3)
    steps, remarks = [], []
    decode_job(job, stop=3, workers=1, step=steps.append, remark=remarks.append)
    assert list(dict.fromkeys(step.partition(" to about ")[0] for step in steps)) == [
        "reading the footage",
        "checking what is there",
        "compiling kernels, and estimating the footage's light",
        "compiling kernels",
        "decoding",
    ]
    (said,) = remarks
    expected_kb = float(re.fullmatch(r"note: .* will grow by about ([\d.]+) kB, at most [\d.]+ [kM]B", said)[1])
    found_kb = sum(path.stat().st_size for path in Path(job.store).rglob("c.*")) / 1e3
    assert expected_kb == pytest.approx(found_kb, rel=0.2)  # three frames are as large as three times the first
    steps.clear()
    decode_job(job, workers=1, step=steps.append, remark=remarks.append)
    assert steps[1:3] == ["checking what is there", "compiling kernels"] and "will grow by about" in remarks[1]


def test_what_does_not_fit_on_the_disk_is_refused_before_it_is_decoded(job, undisturbed, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("pipeline.output.store.free_bytes", lambda location: 1000)
        with pytest.raises(OutputError, match=r"will grow by about .* and 1.0 kB are free on its disk: choose fewer"):
            decode_job(job)
        assert not Path(job.store).exists()
    decode_job(job)  # into the same place
    assert contents(Path(job.store)) == undisturbed


def test_two_runs_do_not_write_to_one_store(job, undisturbed):
    def second(done, of):
        if done == 3:
            with pytest.raises(OutputError, match=r"is being written by another run \(process \d+ on .*: wait until"):
                decode_job(job)

    decode_job(job, notify=second)
    assert contents(Path(job.store)) == undisturbed
    assert [entry.name for entry in Path(job.store).parent.iterdir()] == ["result.zarr"]


def test_a_store_half_made_is_completed(job, undisturbed):
    decode_job(job, stop=1)
    store = Path(job.store)
    for name in ("range_image", "done", "x"):
        shutil.rmtree(store / name)
    decode_job(job)
    assert contents(store) == undisturbed


@pytest.mark.parametrize(
    "change, key",
    [
        ({"settings": DecodeSettings(smoothing_px=3)}, "settings.smoothing_px is 7 there, 3 here"),
        ({"fields": ("mask",)}, "fields"),
        ({"step": 2}, "step is 1 there, 2 here"),
        ({"crop": Crop(0, 0, 64, 64)}, "region_of_interest"),
    ],
)
def test_a_run_with_other_settings_does_not_mix(job, change, key):
    decode_job(job, stop=2)
    before = contents(Path(job.store))
    with pytest.raises(OutputError, match=key) as caught:
        decode_job(replace(job, **change))
    assert "\n" not in str(caught.value)
    assert contents(Path(job.store)) == before


def test_a_run_without_the_region_of_interest_does_not_mix(job):
    decode_job(replace(job, crop=Crop(0, 0, 64, 64)), stop=2)
    before = contents(Path(job.store))
    with pytest.raises(OutputError, match=r"region_of_interest\.x is 0 there, null here"):
        decode_job(job)
    assert contents(Path(job.store)) == before


def test_other_footage_and_other_rigs_do_not_mix(job, rig, tmp_path):
    decode_job(job, stop=1)
    with pytest.raises(OutputError, match="calibration is another one"):
        decode_job(replace(job, calibration=rig))
    (tmp_path / "other").mkdir()
    record(tmp_path / "other" / "film.zarr", 3)
    with pytest.raises(OutputError, match=r"footage\.frames is 14 there, 3 here"):
        decode_job(replace(job, footage=str(tmp_path / "other" / "film.zarr")))


@pytest.fixture
def pictures(folder, tmp_path, job):
    """Return a folder of pictures that all have one size, and a job that decodes it."""
    (tmp_path / "pictures").mkdir()
    for number, image in enumerate(zarr.open_group(folder / "film.zarr", mode="r")["frames"][:5]):
        cv2.imwrite(str(tmp_path / "pictures" / f"{number}.bmp"), image[..., ::-1])
    return tmp_path / "pictures", replace(job, footage=str(tmp_path / "pictures"))


def replace_one(pictures):
    shutil.copy(pictures / "4.bmp", pictures / "2.bmp")


def remove_one_and_add_another(pictures):
    (pictures / "2.bmp").rename(pictures / "9.bmp")


@pytest.mark.parametrize(
    ("change", "again"), [(replace_one, {2, 3}), (remove_one_and_add_another, {2, 3, 4})], ids=["replaced", "removed"]
)
def test_a_result_is_never_another_pictures(pictures, tmp_path, change, again):
    """Number, sizes and the first picture stay; what leans on a picture in its chain is decoded anew, too."""
    there, job = pictures
    decode_job(job)
    change(there)
    summary = decode_job(job)
    assert summary.damaged.keys() == again and summary.n_before == 5 - len(again)
    assert set(summary.damaged.values()) == {"the footage has changed there since it was decoded"}
    fresh = replace(job, store=str(tmp_path / "fresh.zarr"))
    decode_job(fresh)
    assert contents(Path(job.store)) == contents(Path(fresh.store))
    assert decode_job(job).n_before == 5


def test_another_first_picture_is_told_without_digests(pictures):
    there, job = pictures
    decode_job(job)
    shutil.copy(there / "4.bmp", there / "0.bmp")
    with pytest.raises(OutputError, match=r"made otherwise \(footage\.first_frame is another one\): choose"):
        decode_job(job)


def test_a_bad_picture_that_is_copied_again_is_decoded(pictures, tmp_path, caplog):
    there, job = pictures
    whole = (there / "1.bmp").read_bytes()
    (there / "1.bmp").write_bytes(whole[:-5000])
    assert [bad.number for bad in decode_job(job).bad] == [1]
    assert "pictures is bad: " in caplog.text
    (there / "1.bmp").write_bytes(whole)
    assert decode_job(job).bad == []
    fresh = replace(job, store=str(tmp_path / "fresh.zarr"))
    decode_job(fresh)
    assert contents(Path(job.store)) == contents(Path(fresh.store))


def test_a_recording_and_a_video_that_were_cut_anew(job, folder, tmp_path):
    """Behind their first frame: of a recording the frames that are others, of a video all."""
    film, video = tmp_path / "film.zarr", tmp_path / "film.mkv"
    shutil.copytree(folder / "film.zarr", film)
    export_video(film, video)
    of_film, of_video = (replace(job, footage=str(path), store=f"{path}.r", fields=("mask",)) for path in (film, video))
    for each in (of_film, of_video):
        decode_job(each, stop=6)
    shutil.copy(film / "frames" / "c.9.0.0.0", film / "frames" / "c.5.0.0.0")
    video.unlink()
    export_video(film, video)
    assert decode_job(of_film, stop=6).damaged.keys() == {5}
    assert decode_job(of_video, stop=6).damaged.keys() == set(range(6))


def test_a_folder_that_grows_is_decoded_as_it_was_listed(pictures):
    there, job = pictures

    def add_one(step):
        if step == "compiling kernels":  # before the worker opens the folder
            shutil.copy(there / "4.bmp", there / "5.bmp")

    summary = decode_job(job, workers=1, step=add_one)
    assert (there / "5.bmp").exists()
    assert (summary.n_frames, summary.bad) == (5, [])
    assert marked(job.store) == set(range(5))


def test_something_else_in_its_place(job):
    for make in (lambda path: path.write_text("mine"), lambda path: (path / "mine").mkdir(parents=True)):
        make(Path(job.store))
        with pytest.raises(OutputError, match="not a result of ours"):
            decode_job(job)
        shutil.rmtree(job.store, ignore_errors=True) or Path(job.store).unlink(missing_ok=True)
    zarr.open_group(job.store, mode="w")
    with pytest.raises(OutputError, match="not a result of ours"):
        decode_job(job)


def test_bad_frames_are_left_out(job, folder, tmp_path, undisturbed):
    film = tmp_path / "film.zarr"
    shutil.copytree(folder / "film.zarr", film)
    for number in (6, 13):
        (film / "frames" / f"c.{number}.0.0.0").unlink()
    job = replace(job, footage=str(film))
    summary = decode_job(job)
    assert [bad.number for bad in summary.bad] == [6, 13]
    assert all("missing" in bad.reason for bad in summary.bad)
    assert marked(job.store) == set(range(N_FRAMES)) - {6, 13}
    # Up to the bad frame, and from the next chain on, nothing is changed.
    stored = contents(Path(job.store))
    for number in (4, 5, 8, 12):
        assert stored[f"unwrapped_phase/c.{number}.0.0"] == undisturbed[f"unwrapped_phase/c.{number}.0.0"]
    again = decode_job(job)
    assert [bad.number for bad in again.bad] == [6, 13] and again.n_before == N_FRAMES - 2
    assert contents(Path(job.store)) == stored


def test_strict_stops_at_a_bad_frame(job, folder, tmp_path):
    film = tmp_path / "film.zarr"
    shutil.copytree(folder / "film.zarr", film)
    (film / "frames" / "c.6.0.0.0").unlink()
    with pytest.raises(FootageError, match=r"frame 6 of .*film.zarr: it is missing"):
        decode_job(replace(job, footage=str(film)), strict=True)
    assert {0, 1} <= marked(job.store) <= {0, 1, 2, 3, 4, 5}


def test_frames_that_cannot_be_decoded_are_bad(tmp_path, folder, job):
    """NaN in float frames is found while decoding."""
    images = np.asarray(zarr.open_group(folder / "film.zarr", mode="r")["frames"][:3]) / np.float32(255)
    images[1, 5, 5] = np.nan
    with Recorder(tmp_path / "film.zarr", PixelFormat("rgb", 32)) as recorder:
        for image in images:
            recorder.add(image)
    summary = decode_job(replace(job, footage=str(tmp_path / "film.zarr")))
    assert [bad.number for bad in summary.bad] == [1] and "NaN" in summary.bad[0].reason
    assert marked(job.store) == {0, 2}


def test_frames_without_fringes_come_with_a_warning(tmp_path, folder, job, undisturbed):
    images = np.asarray(zarr.open_group(folder / "film.zarr", mode="r")["frames"][:3])
    with Recorder(tmp_path / "film.zarr", PixelFormat("rgb")) as recorder:
        for image in (np.zeros_like(images[0]), *images):
            recorder.add(image)
    summary = decode_job(replace(job, footage=str(tmp_path / "film.zarr")))
    assert list(summary.warned) == [0, 1] and "no fringe" in summary.warned[0][0]
    assert summary.unmeasured == decode_job(replace(job, footage=str(tmp_path / "film.zarr"))).unmeasured == [0]
    assert "nothing of the frame before" in summary.warned[1][0]
    group = zarr.open_group(job.store, mode="r")
    assert "no fringe" in json.loads(bytes(group["done"][0]))["warnings"][0]
    # The light is learnt from the first frame that shows any.
    assert group.attrs["light"]["reliable"]


@pytest.mark.parametrize("calibrated", [False, True])
def test_dark_frames_leave_nothing_in_the_buffers(tmp_path, folder, rig, job, calibrated, monkeypatch):
    """Results are written into buffers that are used again, and a dark frame writes little."""
    images = np.asarray(zarr.open_group(folder / "film.zarr", mode="r")["frames"])
    with Recorder(tmp_path / "film.zarr", PixelFormat("rgb")) as recorder:
        for number in range(12):
            recorder.add(images[number] if number not in (5, 9) else np.zeros_like(images[0]))
    monkeypatch.setattr(jobs, "CHAIN_FRAMES", 100)
    job = replace(job, footage=str(tmp_path / "film.zarr"), calibration=rig if calibrated else None)
    job = replace(job, fields=chosen_fields(None, in_mm=calibrated))
    decode_job(job)
    monkeypatch.setattr("pipeline.batch.worker._RESULTS", 9)
    more = replace(job, store=str(tmp_path / "more.zarr"))
    decode_job(more)
    assert contents(Path(more.store)) == contents(Path(job.store))
    group = zarr.open_group(job.store, mode="r")
    assert not group["mask"][5].any() and np.isnan(group["phase_sigma"][5]).all()


def test_ctrl_c_keeps_what_is_done(job, undisturbed, monkeypatch):
    def stop(done, of):
        if done >= 2:  # of those decoded meanwhile up to ten are stored, too
            raise KeyboardInterrupt

    monkeypatch.setattr("pipeline.batch.worker._COMMIT_S", 0.0)
    with pytest.raises(Stopped, match=r"stopped: \d+ of 14 frames are done; the same command goes on"):
        decode_job(job, notify=stop)
    assert 2 <= len(marked(job.store)) < N_FRAMES
    assert not list(Path(job.store).rglob("*.part*"))
    decode_job(job)
    assert contents(Path(job.store)) == undisturbed


def test_a_full_disk(job, undisturbed, monkeypatch):
    n_calls = 0

    def full(file):
        nonlocal n_calls
        n_calls += 1
        if n_calls > 200:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr("pipeline.batch.worker._COMMIT_S", 0.0)
        patch.setattr(os, "fsync", full)
        with pytest.raises(OutputError, match=r"cannot write .*: the disk is full: free some space"):
            decode_job(job)
    n_done = len(marked(job.store))
    assert 1 < n_done < N_FRAMES
    assert decode_job(job).n_before == n_done
    assert contents(Path(job.store)) == undisturbed


def test_a_vanished_store(job):
    def remove(done, of):
        if done == 5:
            shutil.rmtree(job.store, ignore_errors=True)

    with pytest.raises(OutputError, match="has vanished"):
        decode_job(job, notify=remove)


def test_frames_that_vanish_after_they_were_stored(job):
    """A run that says it is done has its frames."""

    def remove(done, of):
        if done == of:
            (Path(job.store) / "done" / "c.3.0").unlink()

    with pytest.raises(OutputError, match="a frame has vanished after being stored: run again"):
        decode_job(job, notify=remove)
    assert decode_job(job).n_before == N_FRAMES - 1


def test_a_store_behind_a_url(job, undisturbed):
    fsspec = import_but_fail_in_ci("fsspec")
    url = "memory://bucket/result.zarr"
    decode_job(replace(job, store=url), stop=7)
    assert decode_job(replace(job, store=url)).n_before == 7
    memory = fsspec.filesystem("memory")
    decode_job(job)
    for path in Path(job.store).rglob("*"):
        if path.is_file():
            assert memory.cat_file(f"/bucket/result.zarr/{path.relative_to(job.store)}") == path.read_bytes()
    with pytest.raises(OutputError, match=r"settings\.smoothing_px"):
        decode_job(replace(job, store=url, settings=DecodeSettings(smoothing_px=0)))
    with pytest.raises(OutputError, match="cannot write to nothing://"):
        decode_job(replace(job, store="nothing://bucket/result.zarr"))


def test_a_region_of_interest_has_the_same_points(job, rig, folder):
    """The crop's pixels look where they looked in the whole frame."""
    region = Crop(24, 12, 80, 64)
    cut = np.s_[12 : 12 + 64, 24 : 24 + 80]
    whole = rig.camera.rays()[cut]
    np.testing.assert_allclose(rig.cropped(24, 12, (80, 64)).camera.rays(), whole, atol=1e-6)
    fields = ("mask", "points", "point_sigma")
    job = replace(job, calibration=rig, crop=region, fields=fields)
    decode_job(job, stop=1)
    group = zarr.open_group(job.store, mode="r")
    image = zarr.open_group(folder / "film.zarr", mode="r")["frames"][0]
    frame = Decoder(calibration=rig, arch="cpu").decode(image)
    both = frame.mask[cut] & group["mask"][0]
    assert both.mean() > 0.45
    apart = np.linalg.norm(group["points"][0] - frame.points[cut], axis=-1)[both]
    assert np.median(apart / frame.point_sigma[cut][both]) < 1
    assert group.attrs["region_of_interest"] == {"x": 24, "y": 12, "width": 80, "height": 64}


def test_a_recording_of_a_part_of_the_sensor_is_decoded_by_the_calibration_of_all_of_it(job, folder, rig, tmp_path):
    """To the same points, bit by bit, as that part of the whole frame."""
    frames = zarr.open_group(folder / "film.zarr", mode="r")["frames"]
    whole, part = (SensorPart(sensor_px=(128, 96), offset_px=at, binning=(1, 1)) for at in ((0, 0), (24, 12)))
    with Recorder(tmp_path / "part.zarr", PixelFormat("rgb"), sensor=part) as recorder:
        recorder.add(np.ascontiguousarray(frames[0][12:76, 24:104]))
    job = replace(job, calibration=rig.model_copy(update={"sensor": whole}), fields=("mask", "points", "point_sigma"))
    cut = replace(job, crop=Crop(24, 12, 80, 64), store=str(tmp_path / "cut.zarr"))
    decode_job(cut, stop=1)
    decode_job(replace(job, footage=str(tmp_path / "part.zarr")))
    cut, of_part = (zarr.open_group(store, mode="r")["points"][0] for store in (cut.store, job.store))
    assert np.isfinite(cut).mean() > 0.4
    np.testing.assert_array_equal(of_part, cut)


def test_regions_of_interest_that_are_none(job, rig):
    with pytest.raises(SettingsError, match="sticks out of the 128x96 frame"):
        decode_job(replace(job, crop=Crop(100, 0, 64, 64)))
    with pytest.raises(CalibrationError, match="is 128x96 but the calibration is for 640x480"):
        decode_job(replace(job, calibration=simulated_rig((640, 480))))


@pytest.mark.filterwarnings("ignore:the colours' fringes differ", "ignore:no matrix explains the colours")
@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_fetched_fields_need_no_device(arch, stripes, monkeypatch):
    """Another thread writes them while the device decodes the next frame."""
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44, stripes=stripes)
    image = simulate_frame(rig, SimulationSettings()).image
    decoder = Decoder(DecodeSettings(stripes=stripes, crosstalk_matrix=np.eye(3)), rig, arch=arch)
    expected, fetched = decoder.decode(image), decoder.decode(image)
    values = {name: np.array(getattr(expected, name)) for name in FIELDS}
    # Where a frame takes two seconds, a field of each kind: as it is, of host and device, and made by a kernel.
    for name in FIELDS if arch == "cpu" else ("mask", "points", "phase_sigma", "texture"):
        frame = decoder.decode(image, out=fetched)
        read_back(frame, [name])
        with monkeypatch.context() as patch:
            patch.setattr("pipeline.decoding.frame.runtime", SimpleNamespace())
            patch.setattr("pipeline.decoding.frame.transpose", None)
            for launched in ("estimate_phase_sigma", "point_sigma"):
                patch.setattr(f"pipeline.decoding.frame.{launched}", None)
            np.testing.assert_array_equal(getattr(frame, name), values[name], err_msg=name)


def test_which_side_is_in_front_is_learnt_once_for_all_frames(job, folder, tmp_path):
    """Whatever process decodes whichever frame; and the store says whether it is a guess."""
    decode_job(job, stop=1)
    stored = StoredResult(job.store)
    frames = zarr.open_group(folder / "film.zarr", mode="r")["frames"]
    decoder = Decoder(arch="cpu")
    expected = decoder.decode(frames[0])
    assert RimVotes(**stored.attributes["rims"]) == decoder.state.rims
    assert stored.front_known == expected.front_known
    # Walls tell nothing, one frame with something before the wall does; it stands for all.
    scenes = [SimulationSettings(scene=scene, seed=k) for k, scene in enumerate(("plane", "plane", "objects"))]
    *walls, objects = (simulate_frame(simulated_rig((320, 240)), scene).image for scene in scenes)
    signs = []
    for name, shown in (("walls", walls), ("last", [*walls, objects])):
        pictures = tmp_path / name
        pictures.mkdir()
        for number, image in enumerate(shown):
            write_png(pictures / f"{number}.png", image)
        told = replace(job, footage=str(pictures), store=str(tmp_path / f"{name}.zarr"), fields=("mask", "range_image"))
        decode_job(told)
        stored = StoredResult(told.store)
        assert stored.front_known == (name == "last")
        signs.append(stored.frame(0).range_image)
    np.testing.assert_array_equal(signs[0], -signs[1])


def test_the_light_survives_being_stored(folder, rig):
    decoder = Decoder(arch="cpu")
    decoder.decode(zarr.open_group(folder / "film.zarr", mode="r")["frames"][0])
    light = decoder.state.light
    again = type(light).model_validate_json(light.model_dump_json())
    for name, value in light:
        np.testing.assert_array_equal(getattr(again, name), value)


def test_a_picture_does_not_replace_footage(job, tmp_path):
    from pipeline.output.folder import output_folder

    decode_job(job, stop=1)
    with pytest.raises(OutputError, match="holds the frames of footage"):
        with output_folder(tmp_path, force=True):
            pass


def test_a_store_says_nothing_of_times_or_hosts(job, tmp_path):
    decode_job(job, stop=1)
    text = (Path(job.store) / "zarr.json").read_text()
    assert str(tmp_path) not in text and os.uname().nodename not in text


def test_a_transfer_against_the_files_is_told(job, tmp_path):
    with Recorder(tmp_path / "film.zarr", PixelFormat("rgb"), transfer="srgb") as recorder:
        recorder.add(np.zeros((48, 64, 3), np.uint8))
    job = replace(job, footage=str(tmp_path / "film.zarr"))
    for transfer, n_notes in (("linear", 1), ("srgb", 0), (None, 0)):
        settings = DecodeSettings(transfer=transfer, crosstalk_matrix=np.eye(3), code="none")
        each = replace(job, settings=settings, store=str(tmp_path / f"{transfer}.zarr"))
        notes = decode_job(each).notes
        assert sum("decoded as linear, as you or the calibration say, not as srgb" in note for note in notes) == n_notes


def test_a_code_that_the_calibration_states_is_stored(tmp_path, job):
    """And the job goes on with it where it was."""
    rig = simulated_rig((160, 120), period_px=4 * 768 / 44, code="contrast2")
    with Recorder(tmp_path / "film.zarr", PixelFormat("rgb")) as recorder:
        recorder.add(simulate_frame(rig, SimulationSettings(scene="plane")).image)
    calibration = rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
    job = replace(job, footage=str(tmp_path / "film.zarr"), calibration=calibration)
    for before in (0, 1):
        assert decode_job(job).n_before == before
        assert StoredResult(job.store).attributes["code"] == "contrast2"


def test_a_code_that_footage_shows_is_learnt_once_for_all_frames(tmp_path, job):
    """Whatever process decodes whichever frame: the first one with fringes shows it."""
    rig = simulated_rig((320, 240), period_px=2 * 768 / 44, code="contrast")
    coded = simulate_frame(rig, SimulationSettings(scene="plane")).image
    with Recorder(tmp_path / "film.zarr", PixelFormat("rgb")) as recorder:
        for image in (np.zeros_like(coded), coded, coded):
            recorder.add(image)
    job = replace(job, footage=str(tmp_path / "film.zarr"))
    stated = replace(job, settings=DecodeSettings(code="contrast"), store=str(tmp_path / "stated.zarr"))
    notes = [decode_job(each).notes for each in (job, stated)]
    assert [sum("shows a contrast code" in note for note in said) for said in notes] == [1, 0]
    shown, expected = StoredResult(job.store), StoredResult(stated.store)
    assert shown.attributes["code"] == expected.attributes["code"] == "contrast"
    assert shown.frame(2).absolute.any()
    for number in (1, 2):
        for name in ("unwrapped_phase", "absolute", "phase_sigma"):
            np.testing.assert_array_equal(getattr(shown.frame(number), name), getattr(expected.frame(number), name))
