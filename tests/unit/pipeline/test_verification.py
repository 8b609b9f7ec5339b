"""What `colorphase verify` finds, in results, recordings and captures."""

import json
import shutil

import pytest
from support.numbered_frames import RGB8, frame_of
from support.stored_planes import store

from pipeline.errors import FootageError, OutputError
from pipeline.locking import locked
from pipeline.output.folder import output_folder
from pipeline.recording.recorder import Recorder
from pipeline.verification import verify

pytestmark = pytest.mark.usefixtures("cpu")


def recorded(path, n_frames):
    with Recorder(path, RGB8) as recorder:
        for number in range(n_frames):
            recorder.add(frame_of(number))


def test_a_result(tmp_path):
    path = store(tmp_path / "film.zarr", [400.0, 401.0, 402.0, 403.0], missing=(2,))
    told = []
    (found,) = verify(str(path), lambda done, of: told.append((done, of)))
    assert found.whole and found.n_whole == 3 and told == [(1, 3), (2, 3), (3, 3)]
    assert found.notes == ("1 frames between the first and the last have not been decoded",)
    (path / "mask" / "c.1.0.0").unlink()
    (found,) = verify(str(path))
    assert not found.whole and (found.n_whole, found.faults) == (2, {1: "mask is missing"})
    (path / "zarr.json").write_text("{}")
    (found,) = verify(str(path))
    assert not found.whole and "zarr.json is not what was written" in found.damage[0]


def test_an_output_folder(tmp_path):
    with output_folder(tmp_path / "out") as work:
        (work / "mesh.ply").write_text("mesh")
        (work / "report.json").write_text("{}")
        store(work / "result.zarr", [400.0])
    (found,) = verify(str(tmp_path / "out"))
    assert found.whole and found.n_whole == 1
    (tmp_path / "out" / "mesh.ply").write_text("mush")
    (found,) = verify(str(tmp_path / "out"))
    assert found.damage == ("mesh.ply has been changed since it was written",)


def test_a_recording(tmp_path):
    path = tmp_path / "a.zarr"
    recorded(path, 5)
    (found,) = verify(str(path))
    assert found.whole and found.n_whole == 5
    (path / "frames" / "c.3.0.0.0").unlink()
    (found,) = verify(str(path))
    assert found.n_whole == 4 and len(found.faults) == 1


@pytest.mark.parametrize("n_frames", [0, 4])
def test_a_capture_that_was_killed(tmp_path, n_frames):
    """Its log is a burst ahead, and its last line is cut off."""
    recorder = Recorder(tmp_path / "now" / "recording.zarr", RGB8)
    (tmp_path / "now").mkdir()
    log = [{"event": "start"}]
    for number in range(6):
        recorder.add(frame_of(number))
        if number % 2:
            if number < n_frames:
                recorder.commit()
            log += [{"event": "frame", "frame": number - 1}, {"event": "frame", "frame": number}]
            log += [{"event": "burst", "first_frame": number - 1, "frames": 2}]
    while recorder._threads.n_added > recorder._threads._n_done:
        pass
    text = "".join(json.dumps(event) + "\n" for event in log)[:-5]
    with pytest.raises(OutputError, match="is being written by another run"):
        verify(str(tmp_path / "now"))
    folder = shutil.copytree(tmp_path / "now", tmp_path / "killed")
    (folder / "log.jsonl").write_text(text)
    recorder.close()
    finished, *rest = verify(str(folder))
    held = "recording.zarr now holds the 4 frames that were whole" if n_frames else "no frame was whole"
    assert finished.notes == (f"its program was killed: {held}",) and finished.n_whole == n_frames
    assert [each.n_whole for each in rest] == ([4] if n_frames else [])
    assert sorted(entry.name for entry in folder.iterdir() if entry.suffix != ".lock") == sorted(
        ["log.jsonl", *(["recording.zarr"] if n_frames else [])]
    )
    events = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert [event["frame"] for event in events if event["event"] == "frame"] == list(range(n_frames))
    assert events[-1]["event"] == "end" and events[-1]["frames"] == n_frames
    if n_frames:
        (found,) = verify(str(folder))
        assert found.whole and found.n_whole == 4 and found.notes == ()


def test_what_a_killed_program_leaves_is_named(tmp_path):
    store(tmp_path / "out" / "result.zarr", [400.0])
    (tmp_path / "out" / ".0123.part").write_bytes(b"half")
    (tmp_path / ".out.abc").mkdir()
    result, left = verify(str(tmp_path / "out"))
    assert result.whole and left.whole
    assert left.notes == (
        ".0123.part was left by a program that was killed, and may be removed",
        f"{tmp_path / '.out.abc'} was left by a program that was killed, and may be removed",
    )


def test_what_is_not_ours(tmp_path):
    (tmp_path / "thesis.tex").write_text("mine")
    with pytest.raises(FootageError, match="holds no result and no recording: give one of them"):
        verify(str(tmp_path))


def test_while_a_run_goes_on(tmp_path):
    """What has a mark is whole, and nothing is locked out."""
    path = store(tmp_path / "result.zarr", [400.0])
    with locked(path):
        (found,) = verify(str(path))
    assert found.whole
