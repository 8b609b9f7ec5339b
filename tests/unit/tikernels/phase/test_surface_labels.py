"""Which surface each pixel shows."""

import numpy as np
import pytest
from support.colored_boards import MATRIX, PAINTS, PERIOD_PX, board, light, surface_matrix

import tikernels
from tikernels.phase.channel_template import known_template
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.projector_response import response_table
from tikernels.phase.surface_labels import Fringe, relabel, surface_misfits
from tikernels.phase.surfaces import NO_SURFACE, Surfaces

LEVELS = FrameLevels(255.0, 1.0, 0.0, 1.0, 5.0, 5.0)
_PHASES = np.linspace(0, 2 * np.pi, 64, endpoint=False)
_SPECTRUM = np.fft.rfft(light(_PHASES), axis=0).T[:, :5] / 64
PAINTED = ["white", "orange", "blue"]
FOUNDING = np.ones(3, bool)


def surfaces_of(labels: np.ndarray) -> Crosstalk:
    """Return the crosstalk with the board's paints."""
    neutral = MATRIX / MATRIX.sum(axis=1, keepdims=True)
    matrices = np.stack([surface_matrix(PAINTS[paint]) for paint in PAINTED])
    ambient = 6 * matrices.sum(axis=2) + 4
    return Crosstalk.of(neutral, surfaces=Surfaces.of(matrices @ np.linalg.inv(neutral), labels, ambient))


def even(contrast: float = 1.0, code_doubt: float = 0.0) -> Fringe:
    contrasts = np.full((8, 10), contrast, np.float32)
    return Fringe(0 * contrasts, code_doubt, contrasts, 32)


EVEN = even()


def misfits_of(image: np.ndarray, labels: np.ndarray, step: int = 1, fringe: Fringe = EVEN) -> np.ndarray:
    crosstalk = surfaces_of(labels)
    correction = response_table(_SPECTRUM)
    template = known_template(crosstalk.matrix, _SPECTRUM)
    return surface_misfits(image, crosstalk, LEVELS, correction, template, fringe, PERIOD_PX, step)


def test_the_right_surface_leaves_noise_over(arch):
    """One degree of freedom, less what is doubted of the model; the others leave many times as much."""
    image, _, numbers = board(PAINTED)
    misfits = misfits_of(image, np.zeros(numbers.shape, np.uint8))
    for own in range(3):
        means = misfits[:, numbers == own].mean(axis=1)
        assert 0.5 < means[own] < 1.2
        assert (np.delete(means, own) > 2.5 * means[own]).all()


def test_a_finer_fringe_has_less_contrast(arch):
    """Blur that takes 8 % of the fundamental is no other surface."""
    image, phase, _ = board(["white"], noise=0.5)
    spectrum = _SPECTRUM * 0.92 ** (np.arange(5) ** 2)
    cycle = (np.exp(1j * np.arange(5) * phase[..., None, None]) * np.r_[1, 2 * np.ones(4)] * spectrum).sum(axis=-1).real
    blurred = image + (240 * (cycle - light(phase)) @ surface_matrix(PAINTS["white"]).T).astype(np.float32)
    labels = np.zeros(phase.shape, np.uint8)
    as_if_even, as_it_is = (misfits_of(blurred, labels, fringe=even(contrast))[0].mean() for contrast in (1.0, 0.92))
    assert as_it_is < 0.7
    assert as_if_even > 2 * as_it_is


def test_a_cycle_of_less_contrast_is_no_other_surface(arch):
    """A code takes 15 % of every second cycle's contrast; other paints are as far off as without a code."""
    image, phase, _ = board(["white"], noise=0.5)
    fades = np.abs(phase / (2 * np.pi) % 2 - 1)[..., None]
    swing = 240 * (light(phase) - light(_PHASES).mean()) @ surface_matrix(PAINTS["white"]).T
    coded, labels = (image - 0.15 * fades * swing).astype(np.float32), np.zeros(phase.shape, np.uint8)
    unknown, known = (misfits_of(coded, labels, fringe=even(code_doubt=doubt)) for doubt in (0.0, 0.13))
    assert unknown[0].mean() > 5
    assert known[0].mean() < 1.5
    assert (known[1:].mean(axis=(1, 2)) > 0.8 * misfits_of(image, labels)[1:].mean(axis=(1, 2))).all()


def test_every_second_pixel(arch):
    image, _, numbers = board(PAINTED, (60, 61))
    labels = np.zeros(numbers.shape, np.uint8)
    labels[10:20] = NO_SURFACE
    whole, every = misfits_of(image, labels), misfits_of(image, labels, 2)
    np.testing.assert_allclose(every, whole[:, ::2, ::2], rtol=1e-4, atol=1e-4)
    assert (whole[:, 10:20] == -1).all()
    assert (whole[:, 20:] >= 0).all()


def test_pixels_go_to_the_surface_that_explains_them(cpu):
    """From labels that are 12 px off, all but the pixels at the very edges."""
    image, _, numbers = board(PAINTED)
    before = np.roll(numbers, 12, axis=1).astype(np.uint8)
    before[:20, :30] = NO_SURFACE
    new = relabel(misfits_of(image, before), before, np.ones(3, bool), FOUNDING, PERIOD_PX)
    assert new.kept == [0, 1, 2]
    assert (new.labels[before == NO_SURFACE] == NO_SURFACE).all()
    lit = before != NO_SURFACE
    assert np.mean(new.labels[lit] == numbers[lit]) > 0.985
    assert not new.unexplained.any()
    afresh = relabel(
        misfits_of(image, before),
        np.where(lit, 0, NO_SURFACE).astype(np.uint8),
        np.ones(3, bool),
        FOUNDING,
        PERIOD_PX,
        afresh=True,
    )
    assert np.mean(afresh.labels == new.labels) > 0.99


def test_what_none_needs_is_dropped_and_what_none_explains_is_told(cpu):
    image, _, numbers = board(PAINTED)
    misfits = misfits_of(image, numbers.astype(np.uint8))
    twice = np.concatenate([misfits, misfits[:1]])
    assert len(relabel(twice, numbers.astype(np.uint8), np.ones(4, bool), np.ones(4, bool), PERIOD_PX).kept) == 3
    without = relabel(
        misfits[[0, 2]], np.where(numbers == 2, 1, 0).astype(np.uint8), np.ones(2, bool), FOUNDING[:2], PERIOD_PX
    )
    inside = np.abs(np.arange(240) - 120) < 30
    assert without.unexplained[20:-20, inside].mean() > 0.8
    assert without.unexplained[:, :60].mean() < 0.02


def test_a_surface_that_does_not_fit_stays_where_the_rest_is_much_worse(cpu):
    """Pixels of orange that no other paint explains keep it; a bad copy of white goes, a good one would stay."""
    image, _, numbers = board(PAINTED)
    before = numbers.astype(np.uint8)
    misfits = misfits_of(image, before)
    fits = np.array([True, False, True])
    assert relabel(misfits, before, fits, FOUNDING, PERIOD_PX).kept == [0, 1, 2]
    halves = np.concatenate([misfits, misfits[:1]])
    halves[3, :90] = np.maximum(halves[3, :90] - 0.6, 0)
    before[:90][numbers[:90] == 0] = 3
    later = np.array([True, True, True, False])
    kept = [
        relabel(halves, before, np.array([True, True, True, good]), later, PERIOD_PX).kept for good in (True, False)
    ]
    assert kept == [[0, 1, 2, 3], [0, 1, 2]]


def test_what_is_refused(cpu):
    image, _, numbers = board(PAINTED, (40, 40))
    with pytest.raises(tikernels.ShapeError, match="image has shape"):
        misfits_of(image[0], numbers.astype(np.uint8))


def test_none_that_came_later_takes_the_place_of_a_founding_surface(cpu):
    """Two that explain the same pixels: the later one goes, whichever has more."""
    image, _, numbers = board(PAINTED)
    misfits = misfits_of(image, numbers.astype(np.uint8))
    twice = np.concatenate([misfits, misfits[:1]])
    before = numbers.astype(np.uint8)
    before[:150][numbers[:150] == 0] = 3  # most of the white pixels are the later one's
    founding = np.array([True, True, True, False])
    assert relabel(twice, before, np.ones(4, bool), founding, PERIOD_PX).kept == [0, 1, 2]
