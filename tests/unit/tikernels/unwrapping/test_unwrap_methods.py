"""The table of methods, and that one more plugs in."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import join, orders, written

import tikernels
from pipeline import DecodeSettings
from pipeline.errors import SettingsError
from tikernels import runtime
from tikernels.phase.wrapped_phase import LEAST_NO_PHASE
from tikernels.unwrapping import METHODS, PatchMethod, RegionUnwrapper
from tikernels.unwrapping.tables import (
    CELL_HEIGHT,
    CELL_WIDTH,
    NOTHING,
    ORDER_BITS,
    ORDER_ZERO,
    Cell,
    Patch,
    cells_of,
)


class CellsAlone(PatchMethod):
    """A cell of a plane that rises by less than a cycle is a patch; nothing touches anything."""

    draft_bits, adds_votes = 0, True

    def __init__(self, height, width):
        pass

    def grow(self, phase, quality, rates, drafts):
        """See `PatchMethod.grow`."""
        phase = runtime.to_host(phase)
        y, x = np.mgrid[: phase.shape[0], : phase.shape[1]]
        cell = (y // CELL_HEIGHT) * cells_of(*phase.shape)[1] + x // CELL_WIDTH
        labels = np.where(phase < LEAST_NO_PHASE, (cell << (ORDER_BITS + drafts.bits)) + ORDER_ZERO, NOTHING)
        cells = np.zeros(drafts.cell_table.shape, np.int32)
        cells[Cell.PATCHES, :-1] = 1
        table = np.zeros(drafts.patches.shape, np.int32)
        own = np.s_[:: 1 << drafts.bits]
        table[Patch.PIXELS, own] = table[Patch.WEIGHT, own] = CELL_HEIGHT * CELL_WIDTH
        table[Patch.FIRST, own] = [np.flatnonzero(cell == number)[0] for number in range(drafts.cells)]
        for buffer, host in ((drafts.labels, labels), (drafts.cell_table, cells), (drafts.patches, table)):
            buffer[...] = host


def test_a_new_method_plugs_in(monkeypatch, cpu):
    phase = np.zeros((32, 24), np.float32)
    patches, rates = join(phase, method=CellsAlone(32, 24))
    _, _, region = written(patches, phase, rates)
    assert patches.count == 6 and sorted(np.unique(region)) == [1, 2, 3, 4, 5, 6]
    monkeypatch.setitem(METHODS, "cells alone", CellsAlone)
    ones = np.ones((32, 24), np.float32)
    np.testing.assert_array_equal(tikernels.unwrap_phase(phase, ones, ones > 0, method="cells alone"), phase)


def test_every_method_unwraps_a_plane(arch):
    true = reference.ramp(64, 72, tilt=0.03)
    phase = reference.wrapped(true)
    for method in METHODS:
        patches, rates = join(phase, method=method)
        order = orders(written(patches, phase, rates)[0], phase)
        assert np.ptp(order - np.rint((true - phase) / (2 * np.pi))) == 0


@pytest.mark.parametrize("method", METHODS)
def test_cells_without_room_are_grown_again(arch, method):
    """With one place a cell at first, the patches are those of ample room."""
    rng = np.random.default_rng(3)
    true = reference.ramp(64, 72, tilt=0.03)
    phase = reference.wrapped(true + 0.4 * rng.standard_normal(true.shape))
    expected, _ = join(phase, method=method)
    tight = METHODS[method](64, 72)
    tight.draft_bits = 0
    found, _ = join(phase, method=tight)
    *found, found_borders = found.graph()
    *expected, expected_borders = expected.graph()
    for one, other in zip([*found, *(found_borders or ())], [*expected, *(expected_borders or ())], strict=True):
        np.testing.assert_array_equal(one, other)


def test_settings_know_the_methods():
    assert DecodeSettings(unwrap_method="reliability").unwrap_method in METHODS
    with pytest.raises(SettingsError, match=r"unwrap_method.*must be directional or reliability, got 'magic'"):
        DecodeSettings.of(unwrap_method="magic")


def test_what_join_refuses(arch):
    unwrapper = RegionUnwrapper(32, 24, METHODS["directional"](32, 24))
    phase, rates = np.zeros((32, 24), np.float32), np.zeros((5, 5), np.float32)
    with pytest.raises(tikernels.ShapeError, match="quality has shape"):
        unwrapper.join(phase, phase[1:], rates)
    with pytest.raises(tikernels.ShapeError, match="phase is float64"):
        unwrapper.join(phase.astype(np.float64), phase, rates)
    with pytest.raises(tikernels.ShapeError, match="rates has shape"):
        unwrapper.join(phase, phase, rates[:, :3])
