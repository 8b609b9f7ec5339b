"""The store of results: whatever changes a bit of it, or takes a file away, is noticed."""

import numpy as np
import pytest
from support.stored_planes import store

from pipeline.errors import FootageError, OutputError, SettingsError
from pipeline.output.store import ResultStore, chosen_fields
from pipeline.output.stored_result import StoredResult

pytestmark = pytest.mark.usefixtures("cpu")

N_FLIPS = 300


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
        (name, number): result.read(name, number).tobytes() for name in sorted(result.fields) for number in result.done
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
        assert mended.faults({0, 1}) == {} and everything(path) == expected
