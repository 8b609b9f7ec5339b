"""The files of a store, here and behind a URL."""

import pytest
from support.missing import import_but_fail_in_ci

from pipeline.errors import OutputError
from pipeline.output.store_files import StoreFiles


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
    assert files.read("done/c.0.0") == b"mark"
    assert files.sizes("done") == {"c.0.0": 4}
    files.remove("done/c.0.0")
    files.remove("done/c.0.0")
    assert files.sizes("done") == {}
    with pytest.raises(FileNotFoundError):
        files.read("done/c.0.0")


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
