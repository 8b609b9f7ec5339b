"""Which surface each pixel shows."""

import numpy as np
import pytest
from support.colored_boards import MATRIX, PAINTS, PERIOD_PX, board, light, surface_matrix

import tikernels
from tikernels import runtime
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.frame_statistics import FrameLevels
from tikernels.phase.surface_labels import cells_of_pixels, choose_surfaces, relabel
from tikernels.phase.surface_misfits import (
    MOST_MISFIT,
    Lattice,
    NeutralLight,
    average_light,
    measure_scatter,
    surface_residuals,
)
from tikernels.phase.surfaces import NO_SURFACE

LEVELS = FrameLevels(255.0, 1.0, 0.0, 1.0, 5.0, 5.0)
_PHASES = np.linspace(0, 2 * np.pi, 64, endpoint=False)
_SPECTRUM = np.fft.rfft(light(_PHASES), axis=0).T[:, 1:5] / 64
LIGHT = 2 * _SPECTRUM / light(_PHASES).mean(axis=0)[:, None]
PAINTED = ["white", "orange", "blue"]
# By how much better a surface must be, and one that does not fit.
FOUNDING, ALIKE = np.ones(3, bool), np.zeros(3, bool)
# Where a lattice of every second row and eighth column has its places.
PLACES = np.s_[::2, 4::8]


def seen_of(image: np.ndarray, contrast: float = 1.0, cells: np.ndarray | None = None) -> tuple:
    """Return the light of pixels, where cells say which, else means over five at the lattice's places."""
    gains, crosstalk = Gains(*image.shape[:2], PERIOD_PX), Crosstalk.of(MATRIX)
    gains.measure(image, crosstalk, LEVELS)
    nodes = (
        np.full(gains.gains.shape[:2], contrast, np.float32),
        np.zeros(image.shape[:2], bool),
        LEVELS,
    )
    steps = (2, gains.spacing_px, 2) if cells is None else (1, 1, 0, cells)
    return tuple(runtime.to_host(part) for part in average_light(image, gains, crosstalk, *nodes, *steps))


def lattice_of(image: np.ndarray, contrast: float = 1.0) -> Lattice:
    return Lattice(*seen_of(image, contrast), 2, 8, PERIOD_PX)


def paints() -> NeutralLight:
    matrices = np.stack([surface_matrix(PAINTS[paint]) for paint in PAINTED])
    return NeutralLight.of(matrices, 6 * matrices.sum(axis=2) + 4, LIGHT)


def misfits_of(image: np.ndarray, contrast: float = 1.0, code_doubt: float = 0.0) -> np.ndarray:
    return np.minimum(surface_residuals(lattice_of(image, contrast), paints(), LEVELS, code_doubt) ** 2, MOST_MISFIT)


def test_the_right_surface_leaves_noise_over(arch):
    """One degree of freedom, of a mean over five pixels, and what is doubted of the model; others leave much more."""
    image, _, numbers = board(PAINTED)
    misfits = misfits_of(image)
    for own in range(3):
        means = misfits[:, numbers[PLACES] == own].mean(axis=1)
        assert 0.1 < means[own] < 0.7
        assert (np.delete(means, own) > 4 * means[own]).all()


def test_errors_that_neighbours_share_are_noise(arch):
    """Of as large errors those of whole stripes leave more in a place's mean, and count for less."""
    image, _, _ = board(PAINTED, noise=0.0)
    errors = 5 * np.random.default_rng(1).standard_normal((2, *image.shape))
    alone, shared = (np.float32(image + error) for error in (errors[0], errors[1][:, :1]))
    levels = FrameLevels(255.0, 5.0, 0.0, 5.0, 5.0, 5.0)
    inside = np.abs(np.arange(4, 240, 8)[None] % 80 - 40) < np.full((90, 1), 32)
    scatters = []
    for seen in (alone, shared):
        lattice = lattice_of(seen)
        scatters.append(measure_scatter(lattice, surface_residuals(lattice, paints(), levels, 0.0), inside))
    assert scatters[0] < 1.1
    assert 1.5 < scatters[1] < np.sqrt(5 * 3)  # five pixels a place, three places in two cycles; the least of surfaces


def test_a_finer_fringe_has_less_contrast(arch):
    """Blur that takes 8 % of the fundamental is no other surface."""
    image, phase, _ = board(["white"], noise=0.5)
    turns = np.exp(1j * np.arange(1, 5) * phase[..., None, None])
    blurred = 1 + (turns * LIGHT * 0.92 ** (np.arange(1, 5) ** 2)).real.sum(axis=-1)
    sharp = 1 + (turns * LIGHT).real.sum(axis=-1)
    mean = 240 * light(_PHASES).mean()
    image += (mean * (blurred - sharp) @ surface_matrix(PAINTS["white"]).T).astype(np.float32)
    as_if_even, as_it_is = (misfits_of(image, contrast)[0].mean() for contrast in (1.0, 0.92))
    assert as_it_is < 0.9
    assert as_if_even > 4 * as_it_is


def test_a_mean_along_tilted_stripes_has_less_contrast(arch):
    """Five pixels 0.2 rad apart have 0.96 of it."""
    phase = np.arange(120)[:, None] * 2 * np.pi / PERIOD_PX + 0.2 * np.arange(160)
    image = (20 + 200 * light(phase) @ surface_matrix(PAINTS["white"]).T).astype(np.float32)
    expected = np.sin(0.5) / (5 * np.sin(0.1))
    assert lattice_of(image).contrast[10:-10, 2:-2].mean() == pytest.approx(expected, abs=0.01)


def test_a_cycle_of_less_contrast_is_no_other_surface(arch):
    """A code takes 15 % of every second cycle's contrast; other paints are nearly as far off as without."""
    image, phase, _ = board(["white"], noise=0.5)
    fades = np.abs(phase / (2 * np.pi) % 2 - 1)[..., None]
    swing = 240 * (light(phase) - light(_PHASES).mean()) @ surface_matrix(PAINTS["white"]).T
    coded = (image - 0.15 * fades * swing).astype(np.float32)
    unknown, known = (misfits_of(coded, code_doubt=doubt) for doubt in (0.0, 0.13))
    assert unknown[0].mean() > 5
    assert known[0].mean() < 1.5
    assert (known[1:].mean(axis=(1, 2)) > 0.7 * misfits_of(image)[1:].mean(axis=(1, 2))).all()


def test_places_go_to_the_surface_that_explains_them(cpu):
    """From labels that are a column off, all but the places at the very edges."""
    image, _, numbers = board(PAINTED)
    lattice, misfits, numbers = lattice_of(image), misfits_of(image), numbers[PLACES]
    before = np.roll(numbers, 1, axis=1).astype(np.uint8)
    before[:10, :3] = NO_SURFACE
    new = relabel(lattice, misfits, before, FOUNDING, ALIKE)
    assert new.kept == [0, 1, 2]
    assert (new.labels[before == NO_SURFACE] == NO_SURFACE).all()
    lit = before != NO_SURFACE
    assert np.mean(new.labels[lit] == numbers[lit]) > 0.985
    assert not new.unexplained.any()
    unknown = np.where(lit, 0, NO_SURFACE).astype(np.uint8)
    afresh = relabel(lattice, misfits, unknown, FOUNDING, ALIKE, afresh=True)
    assert np.mean(afresh.labels == new.labels) > 0.99


def test_pixels_at_edges_go_to_the_surface_that_explains_them(arch):
    """From labels that are 4 px off; others stay, as pixels without a fringe do."""
    image, _, numbers = board(PAINTED)
    lattice = lattice_of(image)
    places = numbers[PLACES].astype(np.uint8)
    cells = cells_of_pixels(lattice, places, image.shape[:2])
    asked = np.kron(cells, np.ones((8, 16), np.int32))[: image.shape[0], : image.shape[1]]
    assert set(np.unique(cells)) == {0, 0b011, 0b110}
    edges = np.diff(numbers, axis=1) != 0
    assert (asked[:, 1:][edges] != 0).all() and (asked != 0).mean() < 0.4
    new = relabel(lattice, misfits_of(image), places, FOUNDING, ALIKE)
    labels = np.roll(numbers, 4, axis=1).astype(np.uint8)
    labels[:20, :100] = NO_SURFACE
    before = labels.copy()
    choose_surfaces(*seen_of(image, cells=cells), cells, paints(), LEVELS, 0.0, 1.0, lattice, new.around, labels)
    np.testing.assert_array_equal(labels[asked == 0], before[asked == 0])
    assert (labels[:20, :100] == NO_SURFACE).all()
    changed = (asked != 0) & (before != NO_SURFACE)
    assert np.mean(before[changed] == numbers[changed]) < 0.9
    assert np.mean(labels[changed] == numbers[changed]) > 0.96


def test_what_none_needs_is_dropped_and_what_none_explains_is_told(cpu):
    image, _, numbers = board(PAINTED)
    lattice, misfits, numbers = lattice_of(image), misfits_of(image), numbers[PLACES].astype(np.uint8)
    twice = np.concatenate([misfits, misfits[:1]])
    assert len(relabel(lattice, twice, numbers, np.ones(4, bool), np.zeros(4, bool)).kept) == 3
    others = np.where(numbers == 2, 1, 0).astype(np.uint8)
    without = relabel(lattice, misfits[[0, 2]], others, FOUNDING[:2], ALIKE[:2])
    inside = np.abs(np.arange(4, 240, 8) - 120) < 30
    assert without.unexplained[10:-10, inside].mean() > 0.8
    assert without.unexplained[:, :7].mean() < 0.02


def test_a_surface_stays_that_explains_its_places_better_than_any_other(cpu):
    """A copy of white goes, unless white is worse where the copy is, by 0.6."""
    image, _, numbers = board(PAINTED)
    lattice, misfits, before = lattice_of(image), misfits_of(image), numbers[PLACES].astype(np.uint8)
    halves, later = np.concatenate([misfits, misfits[:1]]), np.array([True, True, True, False])
    before[:45][before[:45] == 0] = 3
    assert relabel(lattice, halves, before, later, np.zeros(4, bool)).kept == [0, 1, 2]
    halves[0, :45] += 0.6
    assert relabel(lattice, halves, before, later, np.zeros(4, bool)).kept == [0, 1, 2, 3]
    assert relabel(lattice, halves, before, later, ~later).kept == [0, 1, 2]  # the same paint


def test_what_is_refused(cpu):
    image, _, _ = board(PAINTED, (40, 40))
    nodes = (np.ones((5, 5), np.float32), np.zeros((40, 40), bool), LEVELS)
    with pytest.raises(tikernels.ShapeError, match="image has shape"):
        average_light(image[0], Gains(40, 40, PERIOD_PX), Crosstalk.of(MATRIX), *nodes, 2, 8, 2)


def test_none_that_came_later_takes_the_place_of_a_founding_surface(cpu):
    """Two that explain the same places: the later one goes, whichever has more."""
    image, _, numbers = board(PAINTED)
    misfits, before = misfits_of(image), numbers[PLACES].astype(np.uint8)
    twice = np.concatenate([misfits, misfits[:1]])
    before[:75][before[:75] == 0] = 3  # most of the white places are the later one's
    founding = np.array([True, True, True, False])
    assert relabel(lattice_of(image), twice, before, founding, np.zeros(4, bool)).kept == [0, 1, 2]
