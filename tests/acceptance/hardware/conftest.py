"""Emulated instruments: the trigger box, Basler's cameras and Aravis's fake camera."""

from support.emulated_cameras import aravis, emulator, start_fake_camera, start_twin
from support.simavr import simavr_board, simavr_build

__all__ = ["aravis", "emulator", "simavr_board", "simavr_build", "start_fake_camera", "start_twin"]
