"""The whole rig: our firmware in its emulated board, whose pins trigger an emulated camera and move the picture on."""

import threading
import time
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from hardware import rig as rig_module
from hardware.camera.aravis import AravisCamera
from hardware.camera.basler import BaslerCamera
from hardware.errors import BurstError
from hardware.rig import Rig
from hardware.settings import CameraSettings, RigSettings
from hardware.trigger.box import TriggerBox

# Aravis's fake camera may lose a trigger that comes sooner after it was armed, and answers the first one 0.1 s late.
PERIOD_S = 0.25
FRAMES = 5
WIDTH, HEIGHT = 96, 64


class Wires:
    """From the board's pins to the projector and the camera's software trigger, in a thread.

    Parameters
    ----------
    board : Board
        The emulated board.
    lost_triggers, lost_pictures : set of int
        The pulses, counted from the first one of all, that do not arrive.
    """

    def __init__(self, board, lost_triggers=(), lost_pictures=()):
        self.board = board
        self.camera = None
        self.picture = 0
        self.lost = {"camera": set(lost_triggers), "projector": set(lost_pictures)}
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._follow, daemon=True)

    def __enter__(self):
        """Plug them in."""
        self._thread.start()
        return self

    def __exit__(self, *_):
        """Pull them out."""
        self._stopped.set()
        self._thread.join()

    def _follow(self):
        seen = {"projector": 0, "camera": 0}
        while not self._stopped.is_set():
            for name in seen:
                rises, _ = self.board.edges(name)
                for pulse in range(seen[name], len(rises)):
                    if pulse in self.lost[name]:
                        continue
                    if name == "projector":
                        self.picture = 1 - self.picture
                    else:
                        self.camera.trigger()
                seen[name] = len(rises)
            time.sleep(0.002)


class Loop(TriggerBox):
    """The box, at the end of whose cable is a thread."""

    @property
    def limits(self):
        """Its own, and what the thread adds."""
        return replace(super().limits, jitter_s=0.05)


def settings(**projector):
    return RigSettings.model_validate(
        {
            "trigger": {"driver": "box", "port": "emulated"},
            "timing": {"period_s": PERIOD_S, "frames": FRAMES, "camera_delay_s": 0.1},
            # A camera that its line triggers; what stands in for the line is the thread above.
            "camera": {"driver": "aravis", "exposure_s": 1e-3},
            "projector": projector,
        }
    )


def basler():
    return BaslerCamera(camera_settings("basler", "0815-0000", "RGB8Packed"))


def camera_settings(driver, serial, pixel_format):
    size_px = (WIDTH, HEIGHT)
    return CameraSettings(
        driver=driver, serial=serial, exposure_s=1e-3, trigger="software", pixel_format=pixel_format, size_px=size_px
    )


@pytest.fixture
def rig_of(simavr_board):
    """Return what makes a rig of the emulated board and a camera."""
    opened = []

    def make(board, wires, open_camera, rig_settings):
        rejected = []

        def open_instruments():
            wires.camera = open_camera()
            opened.append(wires.camera)
            return Loop(board.link()), wires.camera

        return Rig(rig_settings, open_instruments, rejected.append), rejected

    yield make
    for camera in opened:
        camera.close()


def test_basler_and_the_real_firmware(simavr_board, rig_of, emulator):
    """Every pulse has its frame; the camera's emulator has no clock, so a lost trigger shows in the count."""
    board = simavr_board(speed=1)
    with Wires(board, lost_triggers={7}) as wires:
        rig, rejected = rig_of(board, wires, basler, settings())
        with rig:
            bursts = list(islice(rig.bursts(), 2))
    assert [[paired.pulse for paired in burst.frames] for burst in bursts] == 2 * [list(range(FRAMES))]
    (lost,) = rejected
    assert "4 frames to 5 pulses: the camera's trigger cable" in str(lost.faults[0])
    assert board.outputs() == (False, False)


def test_aravis_and_a_projector_that_loses_a_pulse(simavr_board, start_twin, rig_of, monkeypatch):
    """The camera photographs what the projector shows, which at one pulse is the picture before."""
    monkeypatch.setattr(rig_module, "TRIES", 6)  # the fake camera may itself miss a trigger on a busy machine
    board = simavr_board(speed=1)
    random = np.random.default_rng(0)
    with Wires(board, lost_pictures={4 + 2, 13 + 2}) as wires:

        def photograph():
            light = 0.85 if wires.picture else 1.0
            return (light * random.integers(100, 120, (HEIGHT, WIDTH, 3))).astype(np.uint8)

        start_twin("TWINRIG", photograph)
        rig, rejected = rig_of(
            board, wires, lambda: AravisCamera(camera_settings("aravis", "TWINRIG", "RGB8")), settings(alternating=True)
        )
        with rig:
            (burst,) = islice(rig.bursts(), 1)
    seen = [str(each.faults[0]) for each in rejected]
    assert "pulse 2: its frame shows the picture before: check the projector's trigger cable" in seen
    levels = np.array([paired.image.mean() for paired in burst.frames])
    assert set(np.sign(np.diff(levels)) * (-1) ** np.arange(FRAMES - 1)) in ({1.0}, {-1.0})
    assert board.outputs() == (False, False)


def test_a_cable_that_stays_out(simavr_board, rig_of, emulator):
    board = simavr_board(speed=1)
    with Wires(board, lost_triggers=range(1000)) as wires:
        rig, rejected = rig_of(board, wires, basler, settings())
        with rig, pytest.raises(BurstError, match=r"3 tries; pulse 0: no frame came: check the camera's trigger cable"):
            next(rig.bursts())
    assert len(rejected) == 3
    assert board.outputs() == (False, False)


def test_a_board_that_restarts_in_mid_burst(simavr_board, rig_of, emulator):
    board = simavr_board(speed=1)
    with Wires(board) as wires:
        rig, rejected = rig_of(board, wires, basler, settings())
        with rig:
            threading.Timer(2.5 * PERIOD_S, lambda: board.tell("reset 4")).start()
            (burst,) = islice(rig.bursts(), 1)
    assert len(burst.frames) == FRAMES
    assert "restarted" in str(rejected[0].faults[0])
    assert board.outputs() == (False, False)
