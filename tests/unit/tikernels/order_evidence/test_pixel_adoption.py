"""Pixels at steps, and whose they become."""

import numpy as np
import pytest
import reference

import tikernels
from tikernels.order_evidence import adopt_pixels
from tikernels.phase.phase_change import RATE_ACROSS
from tikernels.phase.wrapped_phase import NO_PHASE, STEP_PHASE
from tikernels.unwrapping.tables import HAS_STEPS, HIDES_STEP, Final


class Scene:
    """Two planes side by side, 2 rad apart, with a column on either side of the step that belongs to nobody."""

    def __init__(self):
        self.true = reference.ramp(48, 64, 12.0).astype(np.float32)
        self.true[:, 32:] += 2.0
        self.raw = reference.wrapped(self.true)
        self.phase, self.unwrapped = self.raw.copy(), self.true.copy()
        self.region = np.where(np.arange(64) < 32, 1, 2) + np.zeros((48, 1), np.int64)
        self.region = self.region.astype(np.int32)
        self.modulation = np.ones(self.true.shape, np.float32)
        self.drop(np.s_[:, 31:33])

    def drop(self, pixels):
        """Take pixels out of their regions."""
        self.phase[pixels], self.region[pixels], self.unwrapped[pixels] = STEP_PHASE, 0, np.nan
        self.mask = (self.region > 0).astype(np.uint8)

    def adopt(self, known=(False, True, True), steps=HAS_STEPS):
        """Give them to whom they continue."""
        rates = np.zeros((1, 5), np.float32)
        rates[-1, RATE_ACROSS] = 2 * np.pi / 12
        final = np.zeros((len(Final), 48 // 16 * 64 // 8), np.int32)
        final[Final.STEPS] = steps
        seen = (self.phase, self.raw, self.modulation, rates)
        adopt_pixels(final, *seen, np.array(known), out=(self.unwrapped, self.mask, self.region))


def test_pixels_at_a_step_go_to_the_surface_that_they_continue(arch):
    """Of a dropped column beside a step each pixel goes to its own side; what fits neither stays out."""
    scene = Scene()
    mixed = np.zeros(scene.true.shape, bool)
    mixed[::5, 31] = True
    scene.raw[mixed] = reference.wrapped(scene.true[mixed] + 1.0)
    scene.adopt()
    np.testing.assert_array_equal(scene.mask != 0, ~mixed)
    np.testing.assert_allclose(scene.unwrapped[~mixed], scene.true[~mixed], atol=1e-4)
    assert (scene.region[:, :32][~mixed[:, :32]] == 1).all() and (scene.region[:, 32:] == 2).all()
    assert np.abs(scene.phase[~mixed]).max() <= np.pi + 1e-5


def test_only_absolute_surfaces_adopt(arch):
    scene = Scene()
    scene.adopt(known=(False, True, False))
    assert (scene.region[:, 31] == 1).all() and (scene.region[:, 32] == 0).all()


def test_only_cells_with_steps_are_looked_at(arch):
    scene = Scene()
    scene.adopt(steps=0)
    assert (scene.region[:, 31:33] == 0).all()


def test_a_pixel_must_be_as_bright_as_its_surface(arch):
    """0.85 of its neighbour's modulation beside another surface; half of it where there is no other one."""
    scene = Scene()
    scene.modulation[:, 31] = np.where(np.arange(48) < 24, 0.8, 0.9)
    scene.adopt()
    assert (scene.region[:22, 31] == 0).all() and (scene.region[24:, 31] == 1).all()
    alone = Scene()
    alone.drop(np.s_[:, 10])
    alone.modulation[:, 10] = np.where(np.arange(48) < 24, 0.45, 0.55)
    alone.adopt()
    assert (alone.region[:22, 10] == 0).all() and (alone.region[24:, 10] == 1).all()


def test_where_a_step_hides_only_what_is_alone_is_adopted(arch):
    scene = Scene()
    scene.drop(np.s_[:, 10])
    scene.adopt(steps=HIDES_STEP)
    assert (scene.region[:, 31:33] == 0).all() and (scene.region[:, 10] == 1).all()


def test_four_pixels_deep(arch):
    """A pass adopts a pixel from either side: of nine missing ones one stays, and of a cell's eight none."""
    scene = Scene()
    scene.drop(np.s_[:, 6:15])
    scene.adopt()
    np.testing.assert_array_equal(np.flatnonzero(scene.region[20] == 0), [10])


def test_what_has_no_phase_stays_out(arch):
    scene = Scene()
    scene.raw[7, 31] = NO_PHASE
    scene.adopt()
    assert scene.region[7, 31] == 0 and (scene.region == 0).sum() == 1


def test_what_is_refused(arch):
    scene = Scene()
    scene.raw = scene.raw[1:]
    with pytest.raises(tikernels.ShapeError, match="raw_phase has shape"):
        scene.adopt()
    scene = Scene()
    scene.mask.setflags(write=False)
    with pytest.raises(tikernels.ShapeError, match="read-only"):
        scene.adopt()
