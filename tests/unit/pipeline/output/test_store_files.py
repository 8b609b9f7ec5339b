"""A store's files, its metadata and the marks of its frames: there and back, and whatever changes them is noticed."""

import json
import os
import shutil

import numpy as np
import pytest
import xarray
import zarr
from support.missing import import_but_fail_in_ci
from support.stored_planes import HEIGHT, WIDTH, edit, plane, store

from pipeline.errors import DamageError, FootageError, OutputError
from pipeline.footage.frame_times import FrameTimes
from pipeline.output import store_files
from pipeline.output.store import ResultStore, is_there
from pipeline.output.store_files import (
    MARK_BYTES,
    OtherFrame,
    StoreFiles,
    identity_digest,
    marked_frames,
    read_mark,
    read_metadata,
)
from pipeline.output.stored_result import StoredResult
from pipeline.zarr_chunks import with_checksum, without_checksum

pytestmark = pytest.mark.usefixtures("cpu")


@pytest.fixture(params=["folder", "url"])
def files(tmp_path, request):
    """Return the same folder by its name, and as fsspec sees it."""
    (tmp_path / "store" / "done").mkdir(parents=True)
    if request.param == "folder":
        return StoreFiles(tmp_path / "store")
    import_but_fail_in_ci("fsspec")
    return StoreFiles(f"file://{tmp_path / 'store'}")


def test_there_and_back(files):
    files.put("done/c.0.0", b"one")
    files.put("done/c.0.0", b"mark")
    files.sync_folder("done")
    assert files.read("done/c.0.0", 4) == b"mark"
    assert files.sizes("done") == {"c.0.0": 4}
    files.remove("done/c.0.0")
    files.remove("done/c.0.0")
    assert files.sizes("done") == {}
    with pytest.raises(FileNotFoundError):
        files.read("done/c.0.0", 4)


def test_what_is_longer_than_it_can_be_is_not_read(files):
    files.put("done/c.0.0", b"mark")
    with pytest.raises(OSError, match="it is larger than 3 bytes"):
        files.read("done/c.0.0", 3)


def test_nothing_is_written_where_the_store_has_gone(tmp_path):
    files = StoreFiles(tmp_path / "store")
    with pytest.raises(OutputError, match="it has vanished: bring its disk back, and run again"), files.explained():
        files.put("mask/c.0.0.0", b"chunk")
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_writer_leaves(tmp_path):
    (tmp_path / "mask").mkdir()
    for name in ("c.0.0.0", ".0123.part", "c.1.partial"):
        (tmp_path / "mask" / name).write_bytes(b"half")
    files = StoreFiles(tmp_path)
    assert files.entries()["mask"] == ["c.0.0.0", ".0123.part", "c.1.partial"] or len(files.entries()["mask"]) == 3
    files.remove_leftovers("", "mask")
    assert files.entries() == {"mask": ["c.0.0.0"]}


def test_no_file_system_for_a_url():
    with pytest.raises(OutputError, match="cannot write to nonsense://a"):
        StoreFiles("nonsense://a")


@pytest.mark.parametrize(
    "edit",
    [
        lambda about: about["attributes"].update(settings={"smoothing_px": 1}),
        lambda about: about["attributes"].update(light=[1, "odd"]),
        lambda about: about["attributes"].update(note="mine"),
        lambda about: about["attributes"].pop("range_unit"),
    ],
)
def test_attributes_that_were_edited(tmp_path, edit):
    path = store(tmp_path / "result.zarr", [400.0])
    about = json.loads((path / "zarr.json").read_text())
    edit(about)
    (path / "zarr.json").write_text(json.dumps(about))
    with pytest.raises(FootageError, match="is not what was written"):
        StoredResult(path)
    with pytest.raises(DamageError):
        is_there(path)


@pytest.mark.parametrize(
    ("key", "value"), [("shape", [2, 60, 80]), ("data_type", "uint8"), ("codecs", []), ("fill_value", True)]
)
def test_an_array_that_was_edited(tmp_path, key, value):
    path = store(tmp_path / "result.zarr", [400.0])
    about = json.loads((path / "mask" / "zarr.json").read_text())
    (path / "mask" / "zarr.json").write_text(json.dumps({**about, key: value}))
    with pytest.raises(FootageError, match="its metadata is not what was written"):
        StoredResult(path)


@pytest.mark.parametrize("in_mm", [True, False])
def test_arrays_say_what_they_are(tmp_path, in_mm):
    """By the names that xarray shows."""
    group = zarr.open_group(store(tmp_path / "result.zarr", [400.0], in_mm=in_mm), mode="r")
    assert group["range_image"].attrs["units"] == ("mm" if in_mm else "rad")
    assert group["phase_sigma"].attrs["units"] == "rad"
    assert group["modulation"].attrs["units"] == "1"
    assert "units" not in group["mask"].attrs
    assert group["mask"].attrs["flag_meanings"] == "not_measured measured"
    assert group["mask"].attrs["long_name"] == "mask"
    assert group["modulation"].attrs["comment"].startswith("The fringe's amplitude")


IDENTITY = {"colorphase_version": "0.9", "settings": {}, "range_unit": "mm"}


SECONDS = np.array([0.25, 0.27, 3.25])


def make(path, since=None, also=None, seconds=SECONDS):
    """Make a store of three frames, none of which is decoded, whose times are known."""
    times = None if seconds is None else FrameTimes(seconds, since)
    identity = {**IDENTITY, **(also or {})}
    return ResultStore.make(path, identity, ("mask", "points"), 3, (WIDTH, HEIGHT), times=times)


def test_xarray_labels_everything(tmp_path):
    path = store(tmp_path / "result.zarr", [400.0, None, 410.0], missing=(1,))
    with xarray.open_zarr(path, consolidated=False) as result:
        assert set(result.coords) == {"frame", "y", "x", "xyz"}
        assert set(result.dims) == {"frame", "y", "x", "xyz", "record"}
        for name, array in result.variables.items():
            assert array.attrs["long_name"], name
        depth = result.points.sel(frame=2, xyz="z")
        np.testing.assert_array_equal(depth.isel(y=0), 410)
        assert float(result.points.sel(frame=0, y=7, x=11, xyz="x")) == 11 - WIDTH / 2
        np.testing.assert_array_equal(result.mask.sel(frame=0), plane(400.0)[1])
        assert np.isnan(result.points.sel(frame=1)).all()
        done = result.frame[(result.done[:, 0] != ord(" ")).compute()]
        np.testing.assert_array_equal(done, [0, 2])
        assert result.range_image.dtype == np.float32
        assert result.mask.dtype == np.bool_
        assert (result.attrs["Conventions"], result.attrs["history"]) == ("CF-1.11", "decoded by colorphase 1")
        assert result.attrs["title"] and str(tmp_path) not in str(result.attrs)


@pytest.mark.parametrize("frame_s", [None, 0.03])
def test_rows_of_a_rolling_shutter_have_times(tmp_path, frame_s):
    """All that of the middle one where motion is carried to it."""
    make(tmp_path / "result.zarr", also={"settings": {"row_s": 2e-5, "frame_s": frame_s}})
    with xarray.open_zarr(tmp_path / "result.zarr", consolidated=False) as result:
        assert result.points.coords["row_time"].dims == ("y",)
        rows = np.arange(HEIGHT) if frame_s is None else np.full(HEIGHT, (HEIGHT - 1) / 2)
        np.testing.assert_allclose(result.row_time, 2e-5 * rows)
    StoredResult(tmp_path / "result.zarr")


def test_times_that_have_a_date(tmp_path):
    """A frame's time is known before it is decoded, so no run can lose it."""
    make(tmp_path / "result.zarr", since="2026-11-25T10:00:00Z")
    with xarray.open_zarr(tmp_path / "result.zarr", consolidated=False) as result:
        expected = np.datetime64("2026-11-25T10:00:00", "ns") + np.array([250, 270, 3250], "timedelta64[ms]")
        assert abs(result.time.values - expected).max() < np.timedelta64(1, "us")
        assert result.time.attrs["standard_name"] == "time"
        assert result.points.coords["time"].dims == ("frame",)
        after = result.sel(frame=result.time > np.datetime64("2026-11-25T10:00:01"))
        np.testing.assert_array_equal(after.frame, [2])
    assert StoredResult(tmp_path / "result.zarr").frame(1).time_s == pytest.approx(1795600800.27)


def test_times_since_the_first_frame(tmp_path):
    """The unit is s: no version of xarray decodes that into dates or durations."""
    make(tmp_path / "result.zarr")
    with xarray.open_zarr(tmp_path / "result.zarr", consolidated=False) as result:
        np.testing.assert_array_equal(result.time, SECONDS)
        assert result.time.attrs["units"] == "s"
    assert StoredResult(tmp_path / "result.zarr").frame(2).time_s == 3.25
    times = read_metadata(StoreFiles(tmp_path / "result.zarr")).times
    assert times.since is None
    np.testing.assert_array_equal(times.seconds, SECONDS)


def test_times_that_nothing_tells(tmp_path):
    make(tmp_path / "result.zarr", seconds=None)
    with xarray.open_zarr(tmp_path / "result.zarr", consolidated=False) as result:
        assert "time" not in result.variables
    assert StoredResult(tmp_path / "result.zarr").frame(0).time_s is None


def test_rows_and_columns_of_a_part_are_the_cameras(tmp_path):
    part = {"x": 100, "y": 50, "width": WIDTH, "height": HEIGHT}
    make(tmp_path / "result.zarr", also={"region_of_interest": part})
    with xarray.open_zarr(tmp_path / "result.zarr", consolidated=False) as result:
        assert (int(result.x[0]), int(result.x[-1])) == (100, 100 + WIDTH - 1)
        assert (int(result.y[0]), int(result.y[-1])) == (50, 50 + HEIGHT - 1)


@pytest.mark.parametrize("name", ["time", "x", "xyz", "frame"])
@pytest.mark.parametrize("damage", ["bit", "lost", "other"])
def test_a_coordinate_that_is_damaged_is_noticed_and_mended(tmp_path, name, damage):
    path = tmp_path / "result.zarr"
    make(path)
    chunk = path / name / "c.0"
    whole = chunk.read_bytes()
    if damage == "lost":
        chunk.unlink()
    elif damage == "bit":
        chunk.write_bytes(bytes([*whole[:-9], whole[-9] ^ 1, *whole[-8:]]))
    else:
        zarr.open_array(path / name)[0] = "q" if name == "xyz" else 7
    with pytest.raises(FootageError, match=r"is not what was written|metadata of an array is missing"):
        StoredResult(path)
    make(path)
    assert chunk.read_bytes() == whole


def test_a_coordinate_of_a_name_that_we_do_not_know(tmp_path):
    """Such as one outside the store."""
    make(tmp_path / "result.zarr")
    head = tmp_path / "result.zarr" / "zarr.json"
    about = json.loads(head.read_text())
    about["attributes"]["coordinates"] = "../secret"
    head.write_text(json.dumps(about, indent=2))
    with pytest.raises(FootageError, match="metadata of an array is missing"):
        StoredResult(tmp_path / "result.zarr")


def test_a_store_that_has_no_coordinates_yet_stays_readable(tmp_path, monkeypatch):
    """As an earlier version made it; the run that goes on in it leaves it as it is."""
    with monkeypatch.context() as patch:
        patch.setattr(store_files, "_coordinates", lambda *args: {})
        path = store(tmp_path / "result.zarr", [400.0, 410.0], missing=(1,))
    about = json.loads((path / "zarr.json").read_text())
    assert about["attributes"].pop("coordinates") == ""
    old = read_metadata(StoreFiles(path))
    files = {f"{name}/zarr.json": (path / name / "zarr.json").read_bytes() for name in old.shapes}
    about["attributes"]["metadata_sha256"] = store_files._digest(about, files)
    (path / "zarr.json").write_text(json.dumps(about, indent=2))
    result = StoredResult(path)
    assert (result.done, result.frame(0).time_s) == ((0,), None)
    assert float(result.frame(0).points[0, 0, 2]) == 400
    store(path, [400.0, 410.0], missing=(0,))
    assert StoredResult(path).done == (0, 1)
    assert not (path / "x").exists()


def test_a_store_half_made_is_made_anew(tmp_path):
    path = tmp_path / "result.zarr"
    make(path)
    there = {file: file.read_bytes() for file in path.rglob("*") if file.is_file()}
    (path / "zarr.json").unlink()
    (path / "time" / "c.0.partial").write_bytes(b"half")
    shutil.rmtree(path / "y")
    make(path).remove_leftovers()
    assert {file: file.read_bytes() for file in path.rglob("*") if file.is_file()} == there


@pytest.fixture
def path(tmp_path):
    return store(tmp_path / "result.zarr", [400.0, 401.0, 402.0])


def test_a_mark_says_how_its_frame_was_decoded(path):
    files = StoreFiles(path)
    assert marked_frames(files) == {0, 1, 2}
    attributes = StoredResult(path).attributes
    mark = read_mark(files, 1, identity_digest(attributes))
    assert (mark.period_px, mark.noise_levels, mark.constant_known, mark.warnings) == (12.0, 1.0, True, [])
    assert mark.chunks.keys() == set(attributes["fields"])
    with pytest.raises(OtherFrame, match="decoded with other settings than its store's"):
        read_mark(files, 1, identity_digest({**attributes, "step": 2}))


def test_what_the_footage_tells_again_is_no_part_of_how_a_frame_was_decoded():
    assert identity_digest({"step": 1, "light": None}) == identity_digest({"step": 1, "rims": {}})


def test_a_chunk_of_another_frame(path):
    (path / "mask" / "c.0.0.0").unlink()
    shutil.copy(path / "modulation" / "c.0.0.0", path / "mask" / "c.0.0.0")
    with pytest.raises(FootageError, match="frame 0: mask is another frame's, or of another run"):
        _ = StoredResult(path).frame(0).mask


def test_a_mark_of_another_frame(path):
    (path / "mask" / "c.2.0.0").unlink()
    shutil.copy(path / "done" / "c.0.0", path / "done" / "c.2.0")
    with pytest.raises(FootageError, match="frame 2: mask is missing"):
        _ = StoredResult(path).frame(2).mask


def test_a_frame_that_is_not_done(path):
    (path / "done" / "c.1.0").unlink()
    with pytest.raises(FootageError, match="frame 1: it has no mark, and so is not whole"):
        _ = StoredResult(path).frame(1).mask
    with pytest.raises(FootageError, match="has frames 0 to 2, and no 7"):
        StoredResult(path).frame(7)


def test_faults_are_named_by_frame(path):
    (path / "points" / "c.1.0.0.0").unlink()
    (path / "mask" / "c.2.0.0").write_bytes(b"something else")
    result = StoredResult(path)
    assert [result.fault(number) is None for number in range(3)] == [True, False, False]
    assert result.fault(1) == "points is missing"
    assert result.fault(2).startswith("mask is damaged: ")


def set_to(**values):
    return lambda about: about["attributes"].update(values)


def shape(*lengths):
    return lambda about: about.update(shape=list(lengths))


@pytest.mark.parametrize(
    ("key", "change"),
    [
        *(("zarr.json", set_to(step=step)) for step in (0, -1, "two", 10**30, None)),
        *(("zarr.json", set_to(rims=rims)) for rims in ({"falls": "x"}, {"side": 1}, [1], 3, {"grows": 10**400})),
        *(("zarr.json", set_to(footage=footage)) for footage in ([1], "film", {"frames": 3})),
        *(("zarr.json", set_to(fields=fields)) for fields in ([], ["../mask"], ["/dev"], "mask", [3], ["mask/"])),
        *(("zarr.json", set_to(light=light)) for light in ({}, {"ripple": [1]}, 5, {"cycles": {}})),
        *(("zarr.json", set_to(camera=camera)) for camera in ({}, 1, {"size_px": [10**9, 10**9]})),
        ("zarr.json", set_to(range_unit="furlong")),
        ("zarr.json", set_to(code="unknown")),
        ("zarr.json", set_to(coordinates=3)),
        ("zarr.json", set_to(settings=[])),
        ("zarr.json", set_to(colorphase_version=1)),
        ("mask/zarr.json", shape(4, 10**7, 10**7)),
        ("mask/zarr.json", shape(10**18, 60, 80)),
        ("mask/zarr.json", shape(4, 60)),
        ("mask/zarr.json", shape(4, -60, -80)),
        ("points/zarr.json", shape(4, 60, 80, 10**6)),
        ("points/zarr.json", shape(4, 60, 81, 3)),
        ("done/zarr.json", shape(4, 2)),
        ("done/zarr.json", shape()),
        ("x/zarr.json", shape(10**30)),
        ("time/zarr.json", lambda about: about["attributes"].update(units="seconds since the flood")),
        ("time/zarr.json", lambda about: about.pop("attributes")),
    ],
)
def test_metadata_that_no_run_writes_is_told_in_one_line(tmp_path, key, change):
    """Though its checksum is right."""
    make(tmp_path / "result.zarr", also={"colorphase_version": "1"})
    edit(tmp_path / "result.zarr" / key, change)
    with pytest.raises((FootageError, OutputError)) as raised:
        StoredResult(tmp_path / "result.zarr")
    assert "\n" not in str(raised.value)


def test_marks_of_frames_that_there_are_not(tmp_path):
    path = store(tmp_path / "result.zarr", [400.0, 410.0])
    for number in (2, 10**9, 10**17):
        (path / "done" / f"c.{number}.0").write_bytes((path / "done" / "c.0.0").read_bytes())
    assert StoredResult(path).done == (0, 1)


@pytest.mark.parametrize(
    "said",
    [
        {"warnings": 3},
        {"warnings": [3]},
        {"chunks": []},
        {"chunks": {"mask": 3}},
        {"period_px": "x"},
        {"noise_levels": None},
        {"more": 1},
    ],
)
def test_a_mark_that_no_run_writes(tmp_path, said):
    path = store(tmp_path / "result.zarr", [400.0])
    mark = path / "done" / "c.0.0"
    about = {**json.loads(without_checksum(mark.read_bytes())), **said}
    mark.write_bytes(with_checksum(json.dumps(about).encode().ljust(MARK_BYTES)))
    assert "its mark is of another program" in StoredResult(path).fault(0)


@pytest.mark.skipif(os.name == "nt", reason="this system has no pipes among its files")
@pytest.mark.parametrize("make_it", [os.mkfifo, lambda path: path.symlink_to("/dev/zero")], ids=["pipe", "device"])
@pytest.mark.parametrize("key", ["zarr.json", "mask/zarr.json", "x/c.0", "mask/c.0.0.0", "done/c.0.0"])
def test_what_is_no_file_is_not_waited_for(tmp_path, key, make_it):
    path = store(tmp_path / "result.zarr", [400.0])
    (path / key).unlink()
    make_it(path / key)
    try:
        result = StoredResult(path)
        assert result.done == () or "it is no file" in result.fault(0)
    except (FootageError, OutputError) as error:
        assert "\n" not in str(error)


def test_a_chunk_longer_than_its_frame_is_not_read(tmp_path):
    path = store(tmp_path / "result.zarr", [400.0])
    os.truncate(path / "mask" / "c.0.0.0", 2**36)
    assert "mask cannot be read: it is larger than 4,864 bytes" in StoredResult(path).fault(0)
