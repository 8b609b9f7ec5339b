"""The store is whole or says what is not; and how large it will be."""

import shutil
from collections import namedtuple

import numpy as np
import pytest
from support.stored_planes import HEIGHT, WIDTH, _frame, store

from pipeline.decoding.frame import FIELDS
from pipeline.errors import FootageError, OutputError, SettingsError
from pipeline.output.store import (
    ResultStore,
    SizeForecast,
    chosen_fields,
    frame_bytes,
    free_bytes,
    mean_frame_bytes,
    most_frame_bytes,
)
from pipeline.output.stored_result import StoredResult

pytestmark = pytest.mark.usefixtures("cpu")

N_FLIPS = 300

STORED = ("modulation", "mask", "phase_sigma", "points", "point_sigma", "range_image")
GIGABYTE = 10**9


def test_fields_that_are_none():
    with pytest.raises(SettingsError, match="no field is called 'depth': choose of wrapped_phase"):
        chosen_fields(("depth",), in_mm=False)
    with pytest.raises(SettingsError, match="points needs a calibration"):
        chosen_fields(("points",), in_mm=False)
    assert chosen_fields(("range_image", "mask"), in_mm=False) == ("mask", "range_image")


def everything(path):
    """Return all that a store holds."""
    result = StoredResult(path)
    return result.attributes, {
        (name, number): getattr(result.frame(number), name).tobytes()
        for name in sorted(result.fields)
        for number in result.done
    }


@pytest.fixture(scope="module")
def whole(tmp_path_factory, cpu):
    path = store(tmp_path_factory.mktemp("whole") / "result.zarr", [400.0, 401.0])
    return path, everything(path), [file for file in sorted(path.rglob("*")) if file.is_file()]


def noticed(path, expected):
    """Whether something is wrong for whoever reads all of it; what is read is as it was."""
    try:
        attributes, values = everything(path)
    except FootageError as error:
        assert "\n" not in str(error)
        return True
    assert attributes == expected[0]
    assert all(expected[1][key] == content for key, content in values.items())
    return values.keys() != expected[1].keys()


def test_a_wrong_bit(whole):
    path, expected, files = whole
    rng = np.random.default_rng(1)
    for _ in range(N_FLIPS):
        file = files[rng.integers(len(files))]
        content = file.read_bytes()
        flipped = bytearray(content)
        flipped[rng.integers(len(flipped))] ^= 1 << rng.integers(8)
        file.write_bytes(flipped)
        assert noticed(path, expected), file
        file.write_bytes(content)
    assert not noticed(path, expected)


@pytest.mark.parametrize("content", [None, b"", b"\0" * 100], ids=["missing", "empty", "blank"])
def test_a_file_that_is_missing_or_empty(whole, content):
    path, expected, files = whole
    for file in files:
        before = file.read_bytes()
        if content is None:
            file.unlink()
        else:
            file.write_bytes(content)
        assert noticed(path, expected), file
        file.write_bytes(before)


def test_a_damaged_store_is_mended_where_its_frames_are_of_the_same_run(tmp_path):
    identity = {"colorphase_version": "1", "settings": {}, "step": 1, "range_unit": "mm"}
    path = store(tmp_path / "result.zarr", [400.0, 401.0])
    expected, about = everything(path), (path / "zarr.json").read_bytes()
    fields = expected[0]["fields"]
    for damaged in (b"", about[:-9], about.replace(b'"step": 1', b'"step": 2')):
        (path / "zarr.json").write_bytes(damaged)
        with pytest.raises(OutputError, match="is damaged and holds frames made otherwise: choose another folder"):
            ResultStore.make(path, {**identity, "step": 3}, fields, 2, (80, 60))
        assert (path / "zarr.json").read_bytes() == damaged
        mended = ResultStore.make(path, identity, fields, 2, (80, 60))
        assert (path / "zarr.json").read_bytes() == about
        assert mended.faults({0, 1}, lambda number: "") == {} and everything(path) == expected


@pytest.fixture
def free(monkeypatch):
    def leave(count):
        disk = namedtuple("disk", ("total", "used", "free"))(2 * count, count, count)
        monkeypatch.setattr(shutil, "disk_usage", lambda place: disk)

    return leave


def written_bytes(path):
    """Return what frames take; coordinates are there once for all of them."""
    return sum(file.stat().st_size for name in (*STORED, "done") for file in (path / name).glob("c.*"))


def test_the_size_of_a_frame_is_what_it_takes_on_the_disk(tmp_path):
    path = store(tmp_path / "result.zarr", [400.0, 410.0, None])
    expected = written_bytes(path) / 3
    assert mean_frame_bytes(path, STORED) == pytest.approx(expected, abs=4.01)  # the mark's checksum
    planes = [frame_bytes(_frame(distance, True), STORED) for distance in (400.0, 410.0, None)]
    assert np.mean(planes) == pytest.approx(expected, abs=4.01)
    assert mean_frame_bytes(store(tmp_path / "empty.zarr", [400.0], missing=(0,)), STORED) is None


def test_no_frame_takes_more_than_the_most():
    """Noise in every bit, which cannot be compressed."""
    rng = np.random.default_rng(1)
    frame = _frame(400.0, True)
    for name in STORED:
        noise = rng.integers(0, 256, (HEIGHT, WIDTH, 3 if name == "points" else 1, 4), np.uint8)
        values = noise.view(np.float32).reshape(getattr(frame, name).shape)
        setattr(frame, name, noise[..., 0, 0] if name == "mask" else values)
    unrounded = ("mask", "points", "range_image")
    most = most_frame_bytes(unrounded, (WIDTH, HEIGHT))
    assert 0.98 * most < frame_bytes(frame, unrounded) <= most
    most = most_frame_bytes(STORED, (WIDTH, HEIGHT))
    values = HEIGHT * WIDTH * (1 + 4 * (len(STORED) + 1))
    assert values < most < 1.1 * values
    assert most_frame_bytes(tuple(FIELDS), (WIDTH, HEIGHT)) > most


@pytest.mark.parametrize(
    ("free_bytes", "said"),
    [
        (100 * GIGABYTE, "note: r.zarr will grow by about 2.0 GB, at most 4.0 GB"),
        (3 * GIGABYTE, "note: r.zarr will grow by about 2.0 GB, at most 4.0 GB"),
        (
            1.2 * GIGABYTE,
            "warning: r.zarr will grow by about 2.0 GB, at most 4.0 GB, and 1.2 GB are free on its disk: ",
        ),
    ],
)
def test_it_is_said_before_it_starts(free, free_bytes, said):
    free(free_bytes)
    assert SizeForecast("r.zarr", 1000, 4_000_000, 2_000_000).check().startswith(said)


def test_what_surely_does_not_fit_is_refused(free):
    free(0.9 * GIGABYTE)
    with pytest.raises(OutputError, match="900 MB are free") as refused:
        SizeForecast("r.zarr", 1000, 4_000_000, 2_000_000).check()
    assert "choose fewer --fields" in str(refused.value) and "\n" not in str(refused.value)


def test_little_is_not_worth_a_line(free):
    free(GIGABYTE)
    assert SizeForecast("r.zarr", 10, 4_000_000, 2_000_000).check() is None
    assert SizeForecast("r.zarr", 10, 4_000_000, None).check() is None
    assert "by 4.0 GB at most" in SizeForecast("r.zarr", 1000, 4_000_000, None).check()


def test_frames_that_are_written_correct_it():
    size = SizeForecast("r.zarr", 1000, 4_000_000, 2_000_000)
    assert size.corrected_by(1_000_000) == "1.0 GB"
    assert size.corrected_by(3_000_000) == "2.0 GB"
    assert SizeForecast("r.zarr", 10, 4_000_000, 2_000_000).corrected_by(1_000_000) is None


def test_what_is_free_is_asked_where_the_store_will_be(tmp_path, monkeypatch):
    asked = []
    there = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda place: asked.append(place) or there)
    assert free_bytes(tmp_path / "not" / "there" / "result.zarr") == there.free
    assert asked == [tmp_path]
    assert free_bytes("s3://bucket/result.zarr") is None


def test_frames_in_which_nothing_was_measured_are_known(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, None, None])
    attributes = StoredResult(path).attributes
    fields = attributes["fields"]
    again = ResultStore(path, {name: value for name, value in attributes.items() if name != "fields"}, fields)
    assert again.unmeasured({0, 1, 2}) == [1, 2] and again.unmeasured({0, 2}) == [2]
