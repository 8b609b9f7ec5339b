"""`colorphase verify` as its user meets it."""

import pytest
from support.numbered_frames import RGB8, frame_of
from support.stored_planes import store

from pipeline.recording.recorder import Recorder

pytestmark = pytest.mark.usefixtures("cpu")


def test_a_result(command, tmp_path):
    path = store(tmp_path / "result.zarr", [400.0, 401.0])
    assert command("verify", str(path)) == (0, f"{path}: 2 frames are whole\n", "")
    (path / "mask" / "c.1.0.0").unlink()
    code, said, complained = command("verify", str(path))
    assert (code, complained) == (3, "frame 1: mask is missing\n")
    assert said == f"{path}: 1 frame is whole, 1 damaged\n"


def test_a_recording(command, tmp_path):
    with Recorder(tmp_path / "a.zarr", RGB8) as recorder:
        for number in range(30):
            recorder.add(frame_of(number))
    for number in range(12):
        (tmp_path / "a.zarr" / "frames" / f"c.{number}.0.0.0").write_bytes(b"")
    code, said, complained = command("verify", str(tmp_path / "a.zarr"))
    assert code == 3 and said.endswith("18 frames are whole, 12 damaged\n")
    assert complained.startswith("frame 0: it is damaged") and complained.endswith("and 2 frames are damaged, too\n")


def test_what_is_not_there(command, tmp_path):
    code, _, complained = command("verify", str(tmp_path / "none"))
    assert code == 1 and "there is no such file" in complained
