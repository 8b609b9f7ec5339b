"""The emulators of instruments."""

from simavr import simavr_board, simavr_build

__all__ = ["simavr_board", "simavr_build"]
