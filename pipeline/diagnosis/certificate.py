"""Certify a rig by a ball bar and a plate, in the words of VDI/VDE 2634 Part 2, from pictures under the pattern.

**Balls** are found anywhere in the picture. A point on a ball of radius r, whose surface faces n, has the
ball's centre at p - r n: all points of a ball vote for one place, which those of a plane or a rod never do. Spheres are
fitted by geometric least squares; of one cap radius and distance are open together, so centres are those of spheres of
the known diameter. A point's window of smoothing must not reach past the ball, which leaves out its rim.

**Figures** are those of the guideline. *Sphere spacing error*: distance of the two centres less the reference's.
*Probing error*, size: diameter less the reference's; form: range of the distances from the fitted sphere. *Flatness
measurement error*: range of the distances from the fitted plane. Three points in a thousand may be left out of a range.
Each is split: trueness is what repeats (the mean error over the positions; of a form, what is left of the distances in
the means of tiles of a cycle), precision is what scatters about that.

**Uncertainty.** A length that is measured later, elsewhere in the volume, is off by the mean error b, which is not
corrected, and by what scatters:

    U = |b| + 2 sqrt(u_reference^2 + u_calibration^2 + u_fit^2 + u_position^2)

u_fit is the noise of the two centres, from their covariance, in which tiles count as independent, not points.
u_position is what the errors of the n positions scatter by beyond it, times sqrt((n - 1) / (n - 3)) for few positions
(JCGM 101:2008, 6.4.9.4). u_calibration is the scale that the calibration's own uncertainty of depth makes.

**Lateral resolution**, across the stripes and along them, is measured if there are pictures of a corrugated plate
(`lateral_resolution.py`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.captures import captured_files
from pipeline.calibration.lens import Lens
from pipeline.calibration.model import Calibration, Geometry, choose_pattern
from pipeline.causes import Cause
from pipeline.decoding.frame_fields import FrameFields
from pipeline.diagnosis.artefacts import BallBar, Plate, Position, Relief, Volume
from pipeline.diagnosis.lateral_resolution import LateralResolution, measure_transfer
from pipeline.diagnosis.picture_reader import PictureReader
from pipeline.errors import CalibrationError
from pipeline.footage.footage import Footage
from pipeline.footage.opening import open_footage
from pipeline.models import FloatArray
from pipeline.planning.rig_plan import lateral_limit_px
from pipeline.robust import fit_plane, fit_sphere
from pipeline.settings import DecodeSettings

# Normals are differences of points this far to either side, px: less than the noise of neighbours.
_NORMAL_PX = 3
# Votes for a ball's centre differ by less than this part of its radius; a plane at the ball's distance then has a
# sixteenth of its votes. Of a ball's disc this part must be seen.
_VOTE, _SEEN = 0.25, 0.25
# A shape needs so many tiles: twice a sphere's unknowns.
_LEAST_TILES = 8
# And corrugations: twice the unknowns of eleven periods and a quadric.
_RELIEF_TILES = 56
# The plate fills this part of the picture at least: where it is farthest the one that is asked for fills a third.
_FILLED = 0.25
# Points that may be left out of a range.
_LEFT_OUT = 0.003
# What is off a shape, or a spacing, by this part of its distance, or length, is another one: no rig gets so far out of
# adjustment by itself.
_OTHER = 0.01
_COVERAGE_FACTOR = 2


@dataclass(frozen=True)
class Figure:
    """A figure of the guideline."""

    name: str
    largest_mm: float  # of all positions
    trueness_mm: float
    precision_mm: float


@dataclass(frozen=True)
class Certificate:
    """The figures of a rig, and the uncertainty of the lengths that it measures."""

    spacing: Figure
    size: Figure
    form: Figure
    flatness: Figure
    noise_mm: float  # standard deviation of a point, across the plate
    noise_predicted_mm: float  # by decoding
    budget_mm: dict[str, float]  # standard uncertainties of a length, by what makes them
    uncertainty_mm: float  # U of a length as long as the bar, k = 2
    spacing_errors_mm: tuple[float, ...]  # by position
    flatness_errors_mm: tuple[float, ...]
    lateral: dict[str, LateralResolution]  # across and along the stripes; empty if it is not measured

    @property
    def figures(self) -> tuple[Figure, ...]:
        """The figures in the guideline's order."""
        return self.form, self.size, self.spacing, self.flatness


@dataclass(frozen=True)
class Fit:
    """A shape laid through points."""

    range_mm: float  # of their distances from it
    means_mm: FloatArray  # (T,) of these over tiles
    rest_mm: FloatArray  # (N,) what is left of them


@dataclass(frozen=True)
class Sphere(Fit):
    """A ball."""

    centre_mm: FloatArray  # (3,) of the sphere of the reference's diameter
    covariance: FloatArray  # (3, 3) of that, mm^2
    radius_mm: float  # of the nearest sphere


@dataclass(frozen=True)
class Flat(Fit):
    """A plate."""

    middle_mm: FloatArray  # (3,)
    normal: FloatArray  # (3,)
    sigma_mm: float  # predicted noise across it

    def turned_rad(self, asked: Position) -> float:
        """Return by how much it is turned from a position."""
        return float(np.arccos(min(abs(cv2.Rodrigues(asked.turn)[0][:, 2] @ self.normal), 1.0)))


def open_pictures(folder: Path, positions: Sequence[Position]) -> Footage:
    """Open the pictures of artefacts in their positions.

    Raises
    ------
    CalibrationError
        One is missing.
    """
    found = captured_files(folder)
    missing = [position for position in positions if position.name not in found]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise CalibrationError(f"{folder} lacks {missing[0].name}.png{more}: {missing[0].line}")
    return open_footage(folder, listed=[found[position.name].name for position in positions])


def under_cells(calibration: Calibration) -> Calibration:
    """Return the calibration of the same rig under the pattern of a certificate.

    Its code is contrast2: balls are small, and cells alone give small surfaces their depth for certain.
    """
    pattern = choose_pattern(calibration, None, None, "contrast2")
    if calibration.response is not None:  # it is undone in what is shown
        pattern = pattern.replace(compensated=True)
    return calibration.replace(pattern=pattern)


def certify(
    source: Footage,
    bar: BallBar,
    reference_mm: float,
    calibration: Calibration,
    settings: DecodeSettings,
    arch: str = "auto",
    distance_mm: float | None = None,
) -> Certificate:
    """Certify a rig by its pictures of a ball bar and a plate in seven positions each.

    Parameters
    ----------
    source : Footage
        The pictures, in the order of `positions_in`, with or without those of a corrugated plate.
    bar : BallBar
        The reference.
    reference_mm : float
        Expanded uncertainty (k = 2) of its spacing.
    calibration : Calibration
        The rig's, under the pattern that the pictures show.
    settings : DecodeSettings
        How to decode, as `with_transfer_of` completes them for these pictures.
    arch : str
        Where to compute.
    distance_mm : float, optional
        Of the measuring volume; see `Volume.before`.

    Raises
    ------
    CalibrationError
        A picture is of another camera, or does not show what it should where it should.
    FootageError
        A picture cannot be read.
    """
    reader = PictureReader(source, calibration, settings, arch)
    geometry = reader.calibration.geometry()
    volume = Volume.before(geometry, distance_mm)
    bars, plates = list(bar.positions(volume)), list(Plate.within(volume).positions(volume))
    reliefs = list(Relief.within(volume).positions(volume)) if len(source) > len(bars) + len(plates) else []
    pairs: list[list[Sphere]] = []
    flats: list[Flat] = []
    laterals: list[LateralResolution] = []
    for position, (_, frame) in zip([*bars, *plates, *reliefs], reader.frames(), strict=True):
        try:
            if position in bars:
                pairs.append(bar_in(position, bars, frame, bar, geometry, settings.smoothing_px))
            elif position in reliefs:
                laterals.append(measure_relief(frame, position, geometry, settings.smoothing_px))
            else:
                flats.append(measure_plate(frame, settings.smoothing_px))
                _check_place(position, plates, [flats[-1].turned_rad(asked) for asked in plates])
        except CalibrationError as error:
            raise CalibrationError(f"{position.name}: {error}") from None
    _check_depths(flats)
    errors = [measured_spacing_mm(pair) - bar.spacing_mm for pair in pairs]
    spheres = [ball for pair in pairs for ball in pair]
    spacing, flatness = spread("sphere spacing error", errors), form("flatness measurement error", flats)
    budget = _budget(pairs, errors, reference_mm, calibration, bar)
    return Certificate(
        spacing=spacing,
        size=spread("probing error, size", [2 * ball.radius_mm - bar.diameter_mm for ball in spheres]),
        form=form("probing error, form", spheres),
        flatness=flatness,
        noise_mm=flatness.precision_mm,
        noise_predicted_mm=_rms(np.array([flat.sigma_mm for flat in flats])),
        budget_mm=budget,
        uncertainty_mm=abs(spacing.trueness_mm) + _COVERAGE_FACTOR * float(np.hypot.reduce([*budget.values()])),
        spacing_errors_mm=tuple(errors),
        flatness_errors_mm=tuple(flat.range_mm for flat in flats),
        lateral=dict(zip(("across", "along"), laterals, strict=False)),
    )


def bar_in(
    position: Position,
    bars: Sequence[Position],
    frame: FrameFields,
    bar: BallBar,
    geometry: Geometry,
    window_px: int,
) -> list[Sphere]:
    """Return the balls of a bar; see `measure_balls`.

    Raises
    ------
    CalibrationError
        It is another bar, is nearer to another one of its positions, or too little of it is seen.
    """
    pair = measure_balls(frame, bar.diameter_mm, 2, geometry.camera, window_px)
    check_balls(pair, bar.diameter_mm, bar.spacing_mm, geometry.rad_per_mm)
    centres = np.stack([ball.centre_mm for ball in pair])
    _check_place(position, bars, [_apart_mm(centres, bar.centres_mm(asked)) for asked in bars])
    return pair


def measure_balls(frame: FrameFields, diameter_mm: float, count: int, camera: Lens, window_px: int) -> list[Sphere]:
    """Return balls of one diameter, the one with most points first.

    Parameters
    ----------
    frame : FrameFields
        Decoded with a calibration, or stored.
    diameter_mm : float
        The reference's.
    count : int
        How many there are.
    camera : Lens
        The calibration's.
    window_px : int
        The side of the window that phases were smoothed over.

    Raises
    ------
    CalibrationError
        They are not seen, or too little of them.
    """
    points = _points(frame)
    fits = []
    for found_at in find_balls(points, diameter_mm / 2, camera, count):
        ball = _inside(found_at, window_px)
        tile = _tiles(ball, frame)
        enough = np.unique(tile).size >= _LEAST_TILES
        found, centred = (fit_sphere(points[ball], size) if enough else None for size in (None, diameter_mm / 2))
        if found is None or centred is None:
            raise CalibrationError(f"only {tile.size} points of a ball count: hold it nearer, or take larger balls")
        (centre, radius), (middle, known_radius) = found, centred
        ways = points[ball] - middle
        distance = np.linalg.norm(ways, axis=1, keepdims=True)
        slopes, residual = ways / distance, distance[:, 0] - known_radius
        # Points of a tile err alike: their sum counts as one.
        sums = np.stack([np.bincount(tile, slope * residual) for slope in slopes.T])
        few = sums.shape[1] / (sums.shape[1] - 3)
        inverse = np.linalg.inv(slopes.T @ slopes)
        split = _split(np.linalg.norm(points[ball] - centre, axis=1) - radius, tile)
        fits.append(Sphere(*split, middle, few * inverse @ (sums @ sums.T) @ inverse, radius))
    return fits


def measure_relief(frame: FrameFields, asked: Position, geometry: Geometry, window_px: int) -> LateralResolution:
    """Return the transfer of height of the surface that fills most of a position's outline.

    Parameters
    ----------
    frame : FrameFields
        Decoded with a calibration, or stored.
    asked : Position
        Where the corrugated plate is to be held.
    geometry : Geometry
        The calibration's.
    window_px : int
        The side of the window that phases were smoothed over.

    Raises
    ------
    CalibrationError
        The surface is small, or not the corrugated plate.
    """
    points = _points(frame)
    (left, top), (right, bottom) = np.clip([asked.outline_px.min(axis=0), asked.outline_px.max(axis=0)], 0, None)
    seen = np.bincount(frame.region[int(top) : int(bottom), int(left) : int(right)].ravel(), minlength=2)
    surface = _inside(frame.region == 1 + seen[1:].argmax(), window_px)
    tile = _tiles(surface, frame)
    if np.unique(tile).size < _RELIEF_TILES:
        raise CalibrationError(f"only {tile.size} points of the corrugated plate count: hold it where it is asked for")
    mm_per_px = _mm_per_px(geometry.camera, float(np.median(points[surface][:, 2])))
    profile = cv2.Rodrigues(asked.turn)[0][:, 0]
    return measure_transfer(points[surface], tile, profile, mm_per_px * lateral_limit_px(window_px))


def find_balls(points: FloatArray, radius_mm: float, camera: Lens, count: int) -> Iterator[npt.NDArray[np.bool_]]:
    """Yield the pixels of balls, the one with most points first; see the module.

    Parameters
    ----------
    points : (H, W, 3)
        In the camera's frame, mm; NaN where nothing is measured.
    radius_mm : float
        The balls'.
    camera : Lens
        The rig's.
    count : int
        How many there are.

    Raises
    ------
    CalibrationError
        There are fewer.
    """
    half = _NORMAL_PX
    normals = np.full_like(points, np.nan)
    across, down = points[:, 2 * half :] - points[:, : -2 * half], points[2 * half :] - points[: -2 * half]
    normals[half:-half, half:-half] = np.cross(down[:, half:-half], across[half:-half])  # towards the camera
    votes = points - radius_mm * normals / np.linalg.norm(normals, axis=2, keepdims=True)
    free = np.isfinite(votes[..., 0])
    for number in range(count):
        if not free.any():
            raise CalibrationError("no surface is measured: look at the picture, and run colorphase inspect on it")
        centre = _densest(votes[free], _VOTE * radius_mm)
        away = np.linalg.norm(votes - centre, axis=2)
        ball = free & (away < _VOTE * radius_mm)
        seen = ball.sum() * _mm_per_px(camera, centre[2]) ** 2 / (np.pi * radius_mm**2)
        if seen < _SEEN:
            found = "no ball is" if number == 0 else f"only {number} of {count} balls is"
            raise CalibrationError(
                f"{found} found, {2 * radius_mm:g} mm in diameter: show them matt, lit and unobstructed, and give "
                "their true diameter"
            )
        free &= ~(away < radius_mm)
        yield ball


def _densest(votes: FloatArray, radius_mm: float) -> FloatArray:
    """Return the place that most votes (N, 3) are within a radius of."""
    cells = np.floor((votes - votes.min(axis=0)) / radius_mm)
    numbers = cells @ np.cumprod([1.0, *(cells.max(axis=0) + 1)[:2]])
    _, cell, counts = np.unique(numbers, return_inverse=True, return_counts=True)
    place = votes[cell == counts.argmax()].mean(axis=0)
    for _ in range(10):  # the mean shifts by less each time
        place = votes[np.linalg.norm(votes - place, axis=1) < radius_mm].mean(axis=0)
    return np.asarray(place)


def measure_plate(frame: FrameFields, window_px: int) -> Flat:
    """Return the plane through the largest surface.

    Raises
    ------
    CalibrationError
        It is small, or no plane.
    """
    points, surface = _points(frame), _inside(frame.region == 1, window_px)
    tile = _tiles(surface, frame)
    filled = surface.mean()
    if filled < _FILLED or np.unique(tile).size < _LEAST_TILES:
        raise CalibrationError(
            f"the plate fills {filled:.0%} of the picture: hold it where it is asked for, or take a larger one"
        )
    middle, normal = fit_plane(points[surface])
    residual = (points[surface] - middle) @ normal
    rays = points[surface] / np.linalg.norm(points[surface], axis=1, keepdims=True)
    sigma = np.asarray(frame.point_sigma, np.float64)[surface] * np.abs(rays @ normal)
    flat = Flat(*_split(residual, tile), middle, normal, _rms(sigma))
    if _rms(flat.means_mm) > _OTHER * middle[2]:
        words = f"the surface is {_rms(flat.means_mm):.1f} mm from the nearest plane: show a plate alone"
        raise CalibrationError(Cause("other shape", words))
    return flat


def _mm_per_px(camera: Lens, depth_mm: float) -> float:
    return float(depth_mm / np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))


def _points(frame: FrameFields) -> FloatArray:
    if frame.points is None or not np.isfinite(frame.points).any():
        raise CalibrationError("no fringe is found: take the picture under the calibrated pattern")
    return frame.points.astype(np.float64)


def _inside(surface: npt.NDArray[np.bool_], window_px: int) -> npt.NDArray[np.bool_]:
    """Return the pixels of a surface whose window of smoothing does not reach past it."""
    side = max(window_px, 1)
    return np.asarray(cv2.erode(surface.view(np.uint8), np.ones((side, side), np.uint8), borderValue=0)).view(np.bool_)


def _tiles(surface: npt.NDArray[np.bool_], frame: FrameFields) -> npt.NDArray[np.intp]:
    """Return the number of the tile, one cycle of the fringe wide, of each of a surface's pixels, (N,)."""
    side = round(frame.period_px or _LEAST_TILES)
    rows, columns = np.nonzero(surface)
    return np.asarray(np.unique(rows // side * surface.shape[1] + columns // side, return_inverse=True)[1])


def _split(residual: FloatArray, tile: npt.NDArray[np.intp]) -> tuple[float, FloatArray, FloatArray]:
    """Return the range of residuals (N,), and what repeats and what scatters of them; see `Fit`."""
    kept = residual[np.abs(residual) <= np.quantile(np.abs(residual), 1 - _LEFT_OUT)]
    means = np.bincount(tile, residual) / np.bincount(tile)
    return float(np.ptp(kept)), means, residual - means[tile]


def _apart_mm(centres: FloatArray, asked: FloatArray) -> float:
    """Return how far the centres of two balls are from those of a position, whichever is which."""
    return min(_rms(centres - asked), _rms(centres[::-1] - asked))


def _check_place(own: Position, asked: Sequence[Position], away: Sequence[float]) -> None:
    """Refuse an artefact that is less away from another of the seven positions than from its own."""
    nearest = int(np.argmin(away))
    if away[nearest] < away[asked.index(own)]:
        raise CalibrationError(f"it is held as {asked[nearest].name} should be: {own.line}")


def _check_depths(flats: Sequence[Flat]) -> None:
    """Refuse a plate that did not face the camera in the middle, near and far."""
    middle, near, far = (float(flat.middle_mm[2]) for flat in flats[:3])
    if not near < middle < far:
        raise CalibrationError(
            f"plane-2 must be nearer than plane-1, and plane-3 farther: they are {near:.0f}, {middle:.0f} and "
            f"{far:.0f} mm away"
        )


def measured_spacing_mm(pair: Sequence[Sphere]) -> float:
    """Return the distance of the centres of two balls."""
    return float(np.linalg.norm(pair[1].centre_mm - pair[0].centre_mm))


def check_balls(
    balls: Sequence[Sphere],
    diameter_mm: float,
    spacing_mm: float | None,
    rad_per_mm: Callable[[float], float],
) -> None:
    """Refuse balls that are others than those that were given.

    Parameters
    ----------
    balls : sequence of Sphere
        As measured.
    diameter_mm : float
        The reference's.
    spacing_mm : float or None
        The distance of their centres; None: it is not compared.
    rad_per_mm : callable
        Returns how much the phase changes per mm at a depth, mm.

    Raises
    ------
    CalibrationError
        They are.
    """
    for ball in balls:
        depth_mm = float(ball.centre_mm[2])
        cycle = 2 * np.pi / rad_per_mm(depth_mm) / depth_mm  # all lengths change by this part with a cycle
        if abs(2 * ball.radius_mm / diameter_mm - 1) > cycle / 2:
            raise CalibrationError(
                f"a ball's diameter is {2 * ball.radius_mm:.1f} mm, not {diameter_mm:g}: give the true one; or its "
                "depth is a cycle off: use a coded pattern"
            )
    if spacing_mm is not None and abs(measured_spacing_mm(balls) / spacing_mm - 1) > _OTHER:
        raise CalibrationError(
            f"the balls are {measured_spacing_mm(balls):.1f} mm apart, not {spacing_mm:g}: give the true spacing; "
            "or the calibration's scale is wrong"
        )


def _budget(
    bars: Sequence[Sequence[Sphere]],
    errors: Sequence[float],
    reference_mm: float,
    calibration: Calibration,
    bar: BallBar,
) -> dict[str, float]:
    """Return the standard uncertainties of a length as long as the bar; see the module."""
    variances = []
    for first, second in bars:
        way = second.centre_mm - first.centre_mm
        way /= np.linalg.norm(way)
        variances.append(way @ (first.covariance + second.covariance) @ way)
    fit = float(np.sqrt(np.mean(variances)))
    beyond = max(float(np.var(errors, ddof=1)) - fit**2, 0.0)
    bias_mm = 0.0 if calibration.uncertainty is None else calibration.uncertainty.depth_bias_mm or 0.0
    depth_mm = float(np.mean([ball.centre_mm[2] for pair in bars for ball in pair]))
    return {
        "reference": reference_mm / 2,
        "calibration": bias_mm / depth_mm * bar.spacing_mm,
        "noise of the fit": fit,
        "position in the volume": float(np.sqrt(beyond * (len(errors) - 1) / (len(errors) - 3))),
    }


def spread(name: str, errors: Sequence[float]) -> Figure:
    """Return the figure of errors, one for each position or ball; one alone has no precision, which is NaN."""
    precision = float(np.std(errors, ddof=1)) if len(errors) > 1 else np.nan
    return Figure(name, max(errors, key=abs), float(np.mean(errors)), precision)


def form(name: str, fits: Sequence[Fit]) -> Figure:
    """Return the figure of distances from a shape, one fit for each position or ball."""
    means, rest = (np.concatenate([getattr(fit, part) for fit in fits]) for part in ("means_mm", "rest_mm"))
    return Figure(name, max(fit.range_mm for fit in fits), _rms(means), _rms(rest))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
