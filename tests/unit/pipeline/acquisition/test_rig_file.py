"""Values in a rig's file change, and nothing else in it does."""

import tomllib

import pytest

from hardware.errors import RigError
from pipeline.acquisition.rig_file import change_file, with_values
from pipeline.errors import OutputError

RIG = """# Ours.
[camera]  # a webcam
exposure_s = 0.02  # a guess

# No gain.
gain_db = 0.0
"""


def test_comments_stay():
    changed = with_values(RIG, {"camera.exposure_s": 0.016667, "projector.colour_cycle_s": 0.008333})
    assert changed.startswith(RIG.replace("0.02 ", "0.016667 "))
    assert changed.removeprefix(RIG.replace("0.02 ", "0.016667 ")).split() == [
        "[projector]",
        "colour_cycle_s",
        "=",
        "0.008333",
    ]


@pytest.mark.parametrize(
    "projector", ["", "[projector]\ncolour_cycle_s = 0.01\n", "projector = {colour_cycle_s = 0.01}\n"]
)
def test_sections_within_sections_are_added(projector):
    changed = with_values(projector + RIG, {"projector.fields.red_s": [0.0, 0.003], "camera.row_s": 2e-5})
    read = tomllib.loads(changed)
    assert read["projector"]["fields"] == {"red_s": [0.0, 0.003]}
    assert read["projector"].get("colour_cycle_s") == (0.01 if projector else None)
    assert read["camera"] == {"exposure_s": 0.02, "gain_db": 0.0, "row_s": 2e-5}
    assert "exposure_s = 0.02  # a guess" in changed
    assert with_values(changed, {"projector.fields.red_s": [0.0, 0.003]}) == changed


def test_old_files_are_kept_and_never_overwritten(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_bytes(RIG.replace("\n", "\r\n").encode())
    kept, difference = change_file(rig, {"camera.exposure_s": 0.01})
    assert kept == tmp_path / "rig.toml.old"
    assert kept.read_bytes() == RIG.replace("\n", "\r\n").encode()
    assert difference[3:] == ["-exposure_s = 0.02  # a guess", "+exposure_s = 0.01  # a guess"]
    second, _ = change_file(rig, {"camera.exposure_s": 0.03})
    assert second == tmp_path / "rig.toml.old-2"
    assert "exposure_s = 0.02 " in kept.read_text()
    assert "exposure_s = 0.01 " in second.read_text()
    assert b"exposure_s = 0.03  # a guess\r\n" in rig.read_bytes()


def test_a_byte_order_mark_is_no_fault(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_bytes(RIG.encode("utf-8-sig"))
    kept, _ = change_file(rig, {"camera.exposure_s": 0.01})
    assert kept.read_bytes() == RIG.encode("utf-8-sig")
    assert rig.read_text().startswith("# Ours.")
    rig.write_bytes(RIG.encode("utf-16"))
    with pytest.raises(RigError, match=r"rig\.toml: it is text in UTF-16: save it as UTF-8"):
        change_file(rig, {})


def test_nothing_is_written_where_nothing_changes(tmp_path):
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    assert change_file(rig, {"camera.exposure_s": 0.02}) == (None, [])
    assert list(tmp_path.iterdir()) == [rig]


def test_what_is_no_rig_is_one_line(tmp_path):
    with pytest.raises(RigError, match=r"cannot read .*rig\.toml: its folder does not exist"):
        change_file(tmp_path / "rig.toml", {})
    with pytest.raises(RigError, match="it is no TOML"):
        with_values("[camera", {})
    with pytest.raises(RigError, match="camera is not a section"):
        with_values("camera = 1", {"camera.gain_db": 1.0})


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path, monkeypatch):
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)

    def refuse(path, content):
        raise OutputError(f"cannot write {path}: the disk is full: free some space")

    monkeypatch.setattr("pipeline.acquisition.rig_file.write_atomically", refuse)
    with pytest.raises(OutputError, match="the disk is full"):
        change_file(rig, {"camera.exposure_s": 0.01})
    assert rig.read_text() == RIG
