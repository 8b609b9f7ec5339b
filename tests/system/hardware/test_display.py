"""Pictures on displays: what is refused, what ends them, and on a real X server every pixel."""

import builtins
import os
import signal
import subprocess
import sys
import threading
import time
import types

import cv2
import numpy as np
import pytest
from support.command_line import command
from support.virtual_screen import screen

from hardware import display
from hardware.display import Display, DisplayInfo, list_displays
from hardware.errors import ProjectorError


@pytest.fixture(autouse=True)
def undone(monkeypatch):
    """Forget with each test what was told to SDL through the environment."""
    for name in (*display._SDL, "SDL_VIDEODRIVER", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


@pytest.fixture
def dummy(monkeypatch):
    """SDL's display that is only memory."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def noise(size_px):
    return np.random.default_rng(0).integers(0, 256, (size_px[1], size_px[0], 3), dtype=np.uint8)


def test_a_picture_is_shown_for_some_time(dummy):
    (there,) = list_displays()
    with Display() as shown:
        assert DisplayInfo(shown.number, shown.size_px) == there
        picture = noise(shown.size_px)
        shown.show(picture)
        drawn = np.frombuffer(shown._pygame.image.tobytes(shown._window.get_surface(), "RGB"), np.uint8)
        np.testing.assert_array_equal(drawn.reshape(picture.shape), picture)
        start_s = time.monotonic()
        shown.wait(0.2)
        assert time.monotonic() - start_s >= 0.2
    shown.close()  # closing twice is allowed


@pytest.mark.parametrize("key", ["K_ESCAPE", "K_q"])
def test_a_key_ends_it(dummy, key):
    with Display(0) as shown:
        pygame = shown._pygame
        press = pygame.event.Event(pygame.KEYDOWN, key=getattr(pygame, key))
        threading.Timer(0.2, pygame.event.post, [press]).start()
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_SPACE))  # does not
        start_s = time.monotonic()
        shown.wait(60)
        assert 0.1 < time.monotonic() - start_s < 30


def test_enter_is_noted_and_esc_ends_the_wait(dummy):
    with Display(0) as shown:
        pygame = shown._pygame
        assert not shown.entered()
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_RETURN))
        assert shown.wait(0.2) is False
        assert shown.entered() and not shown.entered()
        pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_ESCAPE))
        assert shown.wait(60) is True


def test_the_operator_sees_a_picture_where_there_is_another_display(dummy):
    picture = noise((64, 48))
    with Display(0) as shown:
        assert shown.show_aside(picture) is False
        shown._others = [0]  # as if there were two
        assert shown.show_aside(picture) is True
        drawn = np.frombuffer(shown._pygame.image.tobytes(shown._aside.get_surface(), "RGB"), np.uint8)
        np.testing.assert_array_equal(drawn.reshape(picture.shape), picture)
        assert shown.size_px != (64, 48)


def test_another_size_is_refused_and_so_is_another_display(dummy):
    with Display() as shown:
        width, height = shown.size_px
        message = f"is 640x480, but display 0 is {width}x{height}.*--size {width}x{height}"
        with pytest.raises(ProjectorError, match=message):
            shown.show(noise((640, 480)))
    with pytest.raises(ProjectorError, match="there is no display 1: choose one of 0"):
        Display(1)


def test_among_several_displays_one_must_be_chosen():
    sizes = [(1920, 1080), (1024, 768)]
    assert display._chosen(1, sizes) == 1
    assert display._chosen(None, sizes[:1]) == 0
    with pytest.raises(ProjectorError, match=r"choose one with --display, of 0 \(1920x1080\), 1 \(1024x768\)"):
        display._chosen(None, sizes)


def test_a_display_that_the_desktop_scales_is_refused(dummy, monkeypatch):
    monkeypatch.setattr(Display, "size_px", (2048, 1536))
    with pytest.raises(ProjectorError, match="scales display 0 from 1024x768 to 2048x1536: set its scaling to 100 %"):
        Display()


def test_a_display_that_changes_while_it_is_used(dummy):
    with Display() as shown:
        shown.show(noise(shown.size_px))
        shown._window.set_windowed()
        shown._window.size = (640, 480)
        with pytest.raises(ProjectorError, match="display 0 changed to 640x480"):
            shown.wait(5)


def test_without_the_library(monkeypatch, dummy):
    take = builtins.__import__

    def missing(name, *arguments):
        if name == "pygame":
            raise ImportError("No module named 'pygame'")
        return take(name, *arguments)

    monkeypatch.setattr(builtins, "__import__", missing)
    with pytest.raises(ProjectorError, match=r"needs pygame-ce .*pip install 'colorphase\[project\]'"):
        Display()
    monkeypatch.setattr(builtins, "__import__", take)
    monkeypatch.setitem(sys.modules, "pygame", types.ModuleType("pygame"))  # the other one, of the same name
    with pytest.raises(ProjectorError, match="pip uninstall pygame"):
        Display()


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no DISPLAY")
def test_without_a_screen(monkeypatch):
    with pytest.raises(ProjectorError, match=r"DISPLAY names no X11 display$"):
        Display()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    with pytest.raises(ProjectorError, match="XWayland's"):
        Display()
    monkeypatch.setenv("DISPLAY", ":12345")
    with pytest.raises(ProjectorError, match="there is no display to show pictures on"):
        Display()
    assert list_displays() == []


def test_listing_waits_for_no_display_server(monkeypatch):
    def hang(*_, timeout, **__):
        raise subprocess.TimeoutExpired("python", timeout)

    monkeypatch.setattr(subprocess, "run", hang)
    assert list_displays() == []


def test_every_pixel_on_an_x_server(tmp_path, monkeypatch):
    with screen(tmp_path) as server:
        monkeypatch.setenv("DISPLAY", server.name)
        assert list_displays() == [DisplayInfo(0, (320, 240))]
        with Display() as shown:
            assert shown.note is None
            assert not server.shot().any()  # no pointer, no frame
            for picture in (noise((320, 240)), 255 - noise((320, 240))):
                shown.show(picture)
                server.wait_for(picture)
                shown.wait(0.1)
                server.wait_for(picture)
            monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
            assert "does not report scaling" in shown.note


def test_too_few_colours_on_an_x_server(tmp_path, monkeypatch):
    with screen(tmp_path, "320x240x16") as server:
        monkeypatch.setenv("DISPLAY", server.name)
        with pytest.raises(ProjectorError, match="has 5 bits a colour"):
            Display()


def test_the_command_until_ctrl_c(tmp_path):
    """In a process of its own, as its user runs it."""
    picture = noise((320, 240))
    cv2.imwrite(str(tmp_path / "p.png"), picture[..., ::-1])
    with screen(tmp_path) as server:
        with subprocess.Popen(
            command("project", "p.png"),
            cwd=tmp_path,
            env={**os.environ, "DISPLAY": server.name},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as running:
            server.wait_for(picture)
            running.send_signal(signal.SIGINT)
            try:
                said, complained = running.communicate(timeout=30)
            finally:
                running.kill()
        assert (running.returncode, complained) == (0, "")
        assert said == "p.png is on display 0, 320x240; Esc, q or Ctrl-C ends it\n"
        assert not np.array_equal(server.shot(), picture)
