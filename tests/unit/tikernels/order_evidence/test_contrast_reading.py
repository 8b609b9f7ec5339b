"""The contrast of every cycle against its twin."""

import numpy as np
import pytest
import reference
from support.wrapped_surfaces import join

import tikernels
from tikernels import runtime
from tikernels.order_evidence import measure_contrast
from tikernels.order_evidence.contrast_reading import (
    BACKGROUND,
    BLOCK_WIDTH,
    BLOCKS,
    COSINE,
    MODULATION,
    PHASE,
    SINE,
    SUMS,
    TOTAL,
)
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.surfaces import Surfaces
from tikernels.phase.wrapped_phase import NO_PHASE
from tikernels.unwrapping.tables import numbers_of


@pytest.mark.parametrize("shape", [(64, 96), (51, 43)])
def test_contrast_as_the_twin(arch, shape):
    rng = np.random.default_rng(3)
    phase = reference.wrapped(reference.ramp(*shape, 11.0, tilt=0.05))
    phase[rng.random(shape) < 0.05] = NO_PHASE
    image = rng.integers(20, 255, (*shape, 3)).astype(np.uint8)
    modulation = rng.uniform(5, 60, shape).astype(np.float32)
    crosstalk = Crosstalk.of(np.eye(3) + 0.1 * rng.random((3, 3)))
    gains = Gains(*shape, 11.0)
    nodes = rng.uniform(0.8, 1.2, gains.gains.shape).astype(np.float32)
    gains.gains = runtime.to_device(nodes)
    patches, _ = join(phase)
    sums = measure_contrast(image, crosstalk, gains, phase, modulation, patches, 11.0)
    labels, cells = runtime.to_host(patches.labels), runtime.to_host(patches.cell_table)
    seen = (image, crosstalk.inverse, nodes, gains.spacing_px, phase, modulation, labels)
    expected = reference.measure_contrast(*seen, 7)
    assert sums.shape == (patches.count, 7, BLOCKS, SUMS)
    for draft, own in expected.items():
        patch = numbers_of(np.array(draft), cells, patches.draft_bits)
        np.testing.assert_allclose(sums[patch], own, rtol=1e-4, atol=1e-2)
    assert (sums[..., TOTAL] > 0).any(axis=(1, 2)).sum() == len(expected)


@pytest.mark.parametrize("ambient", [0.0, 0.1])
def test_neutral_fringes_show_their_contrast(arch, ambient):
    """Of grey light without crosstalk the contrast is modulation over background, whatever the phase.

    A surface's own colour and ambient light are taken off before.
    """
    shape = (64, 48)
    phase = reference.wrapped(reference.ramp(*shape, 12.0, tilt=0.05))
    image = reference.fringes(phase, modulation=0.2, background=0.5)
    gains = Gains(*shape, 12.0)
    gains.gains.fill(1.0)
    mixing = np.diag([0.5, 1.0, 0.7]) if ambient else np.eye(3)
    crosstalk = Crosstalk.of(np.eye(3), surfaces=Surfaces.of(mixing, ambient=np.full((1, 3), ambient)))
    image = (image @ mixing.T + ambient).astype(np.float32)
    patches, _ = join(phase)
    sums = measure_contrast(image, crosstalk, gains, phase, np.full(shape, 0.2, np.float32), patches, 12.0)
    cycles = sums[sums[..., TOTAL] > 0]
    assert len(cycles) > patches.count
    np.testing.assert_allclose(cycles[:, MODULATION] / cycles[:, BACKGROUND], 0.4, rtol=1e-5)


def test_blocks_are_columns_side_by_side(arch):
    """The modulation of every four columns is another one, and each block shows its own."""
    shape = (48, 64)
    phase = reference.wrapped(reference.ramp(*shape, 12.0))
    block = np.arange(shape[1]) // BLOCK_WIDTH
    modulation = np.broadcast_to(0.1 + 0.01 * block, shape).astype(np.float32)
    gains = Gains(*shape, 12.0)
    gains.gains.fill(1.0)
    patches, _ = join(phase)
    crosstalk = Crosstalk.of(np.eye(3))
    sums = measure_contrast(np.ones((*shape, 3), np.float32), crosstalk, gains, phase, modulation, patches, 12.0)
    first = patches.graph().first % shape[1] // BLOCK_WIDTH
    seen = sums[..., TOTAL] > 0
    expected = 0.1 + 0.01 * (first[:, None, None] + np.arange(BLOCKS))
    np.testing.assert_allclose(
        (sums[..., MODULATION] / np.where(seen, sums[..., TOTAL], 1))[seen],
        np.broadcast_to(expected, seen.shape)[seen],
        rtol=1e-5,
    )
    assert seen.any(axis=1).all()


def test_waves_are_those_of_three_times_the_phase(arch):
    """To two hundredths, pixel by pixel: of a phase that is the same all over."""
    shape = (16, 16)
    crosstalk, gains = Crosstalk.of(np.eye(3)), Gains(*shape, 12.0)
    gains.gains.fill(1.0)
    image, modulation = np.ones((*shape, 3), np.float32), np.ones(shape, np.float32)
    patches, _ = join(np.zeros(shape, np.float32))
    for phase in np.linspace(-np.pi, np.pi, 30)[1:-1]:
        sums = measure_contrast(image, crosstalk, gains, np.full(shape, phase, np.float32), modulation, patches, 12.0)
        seen = sums[sums[..., TOTAL] > 0]
        assert len(seen)
        expected = np.array([[phase, np.cos(3 * phase), np.sin(3 * phase)]])
        np.testing.assert_allclose(
            seen[:, [PHASE, COSINE, SINE]] / seen[:, [TOTAL]], expected + 0 * seen[:, [TOTAL]], atol=0.0205
        )


def test_what_is_refused(arch):
    shape = (32, 40)
    phase = reference.wrapped(reference.ramp(*shape))
    patches, _ = join(phase)
    crosstalk, gains = Crosstalk.of(np.eye(3)), Gains(*shape, 12.0)
    gains.gains.fill(1.0)
    image = np.zeros((*shape, 3), np.uint8)
    with pytest.raises(tikernels.ShapeError, match="modulation has shape"):
        measure_contrast(image, crosstalk, gains, phase, phase[1:], patches, 12.0)
    with pytest.raises(tikernels.ShapeError, match="image is int64"):
        measure_contrast(image.astype(np.int64), crosstalk, gains, phase, phase, patches, 12.0)
