"""What a recorder leaves that was killed."""

import shutil

import pytest
from support.numbered_frames import RGB8, add, held

from pipeline.errors import FootageError, OutputError
from pipeline.recording.finishing import finish_recording, unfinished
from pipeline.recording.recorder import Recorder

both = pytest.mark.parametrize("suffix", [".mkv", ".zarr"])


@pytest.fixture
def left(tmp_path, suffix):
    """Return a recording that was left with five frames committed and two that were not."""
    (tmp_path / "now").mkdir()
    recorder = Recorder(tmp_path / "now" / f"a{suffix}", RGB8)
    add(recorder, 5)
    recorder.commit()
    add(recorder, 2)
    while recorder._threads.n_added > recorder._threads._n_done:
        pass
    folder = shutil.copytree(tmp_path / "now", tmp_path / "left")
    recorder.close()
    (part,) = unfinished(folder)
    return part


@both
def test_what_was_committed_gets_its_name(left, suffix):
    path, n_frames = finish_recording(left)
    assert (path.name, n_frames, held(path)) == (f"a{suffix}", 5, 5)
    assert list(unfinished(left.parent)) == []
    assert [entry.name for entry in left.parent.iterdir()] == [path.name]


@both
def test_a_new_recording_does_not_replace_it(left, suffix):
    with pytest.raises(OutputError, match=rf"a\.part\{suffix} is there, of a program that was killed: colorphase v"):
        Recorder(left.with_name(f"a{suffix}"), RGB8)
    left.with_name(f"a{suffix}").write_bytes(b"mine")
    with pytest.raises(OutputError, match="exists, move it away"):
        finish_recording(left)
    assert left.with_name(f"a{suffix}").read_bytes() == b"mine"


@both
def test_what_is_damaged_stays(left, suffix):
    head = left / "frames" / "zarr.json" if suffix == ".zarr" else left
    head.write_bytes(b"nonsense")
    with pytest.raises(FootageError, match="cannot finish"):
        finish_recording(left)
    assert left.exists()


@both
def test_what_was_only_begun_is_removed(tmp_path, suffix):
    """At every moment of its making."""
    with Recorder(tmp_path / f"a{suffix}", RGB8) as recorder:
        add(recorder, 1)
    part = tmp_path / f"b.part{suffix}"
    if suffix == ".mkv":
        whole = (tmp_path / "a.mkv").read_bytes()
        for n_bytes in (0, 7, 40, 300):
            part.write_bytes(whole[:n_bytes])
            assert finish_recording(part) == (tmp_path / "b.mkv", 0)
            assert not part.exists()
        part.write_bytes(whole[:-1200])
        with pytest.raises(FootageError, match="is damaged at byte"):
            finish_recording(part)
        assert part.read_bytes() == whole[:-1200]
    else:
        for left in ((), ("zarr.json",), ("zarr.json", "frames")):
            part.mkdir()
            for name in left:
                (part / name).mkdir() if name == "frames" else (part / name).write_bytes(b"{}")
            assert finish_recording(part) == (tmp_path / "b.zarr", 0)
            assert not part.exists()
        shutil.copytree(tmp_path / "a.zarr", part)
        (part / "frames" / "zarr.json").unlink()
        with pytest.raises(FootageError, match="does not say how many frames it holds"):
            finish_recording(part)
