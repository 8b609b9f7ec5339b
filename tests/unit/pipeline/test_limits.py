"""Bounds of what is read: one line when they are passed, and a variable for larger cameras."""

import os

import pytest

from pipeline import limits
from pipeline.errors import FootageError, SettingsError


def test_the_largest_cameras_are_allowed_and_more_by_a_variable(monkeypatch):
    monkeypatch.delenv(limits.MAX_PIXELS, raising=False)
    limits.check_size("a.png", 9344, 7000)
    with pytest.raises(FootageError, match=r"^a\.png has 16000x16000 px, .* at most: set COLORPHASE_MAX_PIXELS"):
        limits.check_size("a.png", 16000, 16000)
    with pytest.raises(FootageError, match="says that it has 0x9 px"):
        limits.check_size("a.png", 0, 9)
    monkeypatch.setenv(limits.MAX_PIXELS, "256000000")
    limits.check_size("a.png", 16000, 16000)


@pytest.mark.parametrize("said", ["0", "-5", "many", "1e9", "99999999999999", "1073741825"])
def test_the_variable_holds_a_number_of_pixels(monkeypatch, said):
    monkeypatch.setenv(limits.MAX_PIXELS, said)
    with pytest.raises(SettingsError, match=f"^COLORPHASE_MAX_PIXELS is '{said}': give a number of pixels from 1"):
        limits.max_pixels()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"x" * (2**20 + 1), "larger than 1,048,576 bytes"),
        (b"\x89PNG", "no text file in UTF-8: save it as that"),
        ("a = 1".encode("utf-16"), "it is text in UTF-16: save it as UTF-8"),
        ("a = 1".encode("utf-16-be"), "or text in UTF-16: save it as UTF-8"),
        ("a = 1".encode("utf-32"), "it is text in UTF-32: save it as UTF-8"),
        (b"9" * 401, "more than 400 digits"),
        (b"a." * 30 + b"a = 1", "nested too deep"),
        (b"'a b' . " * 30 + b"a = 1", "nested too deep"),
        (b'["a" . ' + b'"b".' * 30, "nested too deep"),
    ],
)
def test_texts_that_no_rig_needs(tmp_path, content, message):
    (tmp_path / "a.toml").write_bytes(content)
    with pytest.raises((OSError, ValueError), match=message):
        limits.read_text(tmp_path / "a.toml")


def test_a_byte_order_mark_is_read(tmp_path):
    """As Windows' editors write it."""
    (tmp_path / "a.toml").write_bytes("a = 1  # ö\r\n".encode("utf-8-sig"))
    assert limits.read_text(tmp_path / "a.toml") == "a = 1  # ö\n"


def test_texts_are_read_as_they_are(tmp_path):
    text = "a = [1.5, 2.25,\r\n3.125]\r# 10.0.0.5\n" + ", ".join(256 * ["0.123456789012345678"])
    (tmp_path / "a.toml").write_bytes(text.encode())
    assert limits.read_text(tmp_path / "a.toml") == text.replace("\r\n", "\n").replace("\r", "\n")
    with pytest.raises(OSError, match="No such file"):
        limits.read_text(tmp_path / "none")


@pytest.mark.skipif(os.name == "nt", reason="this system has no pipes among its files")
def test_only_plain_files_are_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for what in ("pipe", "link", "."):
        with pytest.raises(OSError, match=r"it is no file|it is a folder"):
            limits.read_plain(tmp_path / what, 10)
    (tmp_path / "file").write_bytes(b"0123456789")
    assert limits.read_plain(tmp_path / "file", 10) == b"0123456789"
    with pytest.raises(OSError, match="it is larger than 9 bytes"):
        limits.read_plain(tmp_path / "file", 9)
    os.truncate(tmp_path / "file", 2**43)
    with pytest.raises(OSError, match="its 8,796,093,022,208 bytes do not fit into memory"):
        limits.read_plain(tmp_path / "file", 2**60)
