"""Piles of balls and plates before a wall, seen by pixels that average over their area, with exact truth.

Rays meet planes and balls in closed form: an oracle that shares nothing with the simulator's distance fields.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.models import CodeName
from pipeline.pattern import make_pattern
from pipeline.simulation import SKIN, TYPICAL_CROSSTALK, WHITE, SimulatedFrame, simulated_rig

Floats = npt.NDArray[np.float64]

SIZE = (640, 480)
PAINTS = (SKIN, WHITE, (0.6, 0.25, 0.1), (0.7, 0.6, 0.15), (0.15, 0.45, 0.2), (0.15, 0.25, 0.6))
#: Where a pixel's rays go through it, px (x, y) from its middle.
PLACES = [(x, y) for y in (-1 / 3, 0.0, 1 / 3) for x in (-1 / 3, 0.0, 1 / 3)]
# Blur of projector and camera, px; ambient light; noise, levels.
_BLUR, _AMBIENT, _NOISE = (0.6, 0.5), 0.05, 1.5
_FALLOFF_MM = 918.0


@dataclass(frozen=True)
class Surface:
    """A plane n . p = distance, whole or seen inside an outline, or a ball."""

    color: tuple[float, float, float]
    normal: Floats | None = None
    distance_mm: float = 0.0
    outline: tuple[bool, float, float, float, float] | None = None  # ellipse or box; its middle, half width and height
    middle: Floats | None = None
    radius_mm: float = 0.0


@dataclass(frozen=True)
class Rays:
    """What one ray of every pixel meets."""

    points: Floats  # (H, W, 3) mm, camera frame
    projector_px: npt.NDArray[np.float32]  # (H, W, 2) column and row
    strength: Floats  # (H, W) share of the projector's light that arrives; 0: none
    reflectance: Floats  # (H, W, 3)
    number: npt.NDArray[np.int64]  # (H, W) of the surface; 0: the wall


def piled_objects(
    seed: int,
    *,
    objects: int,
    cycles: tuple[float, float],
    gamma: float,
    code: CodeName | None = "contrast",
    painted: bool = False,
    touching: bool = False,
) -> tuple[SimulatedFrame, npt.NDArray[np.int64]]:
    """Return a frame, and which surface every pixel sees (0: the wall).

    Parameters
    ----------
    seed : int
        Of places, tilts and noise.
    objects : int
        How many.
    cycles : (2,) float
        How many cycles high they are.
    gamma : float
        The projector's response.
    code : {"contrast", "contrast2"}, optional
        The pattern's.
    painted : bool
        Every object has a colour of its own, and the wall is white; else all are skin.
    touching : bool
        All are plates, and each lies one to three whole cycles before the wall at a place of its border.
    """
    rng = np.random.default_rng(seed)
    rig = simulated_rig(SIZE, code=code)
    return photographed(rng, rig, pile(rng, rig, objects, cycles, painted, touching), gamma)


def pile(
    rng: np.random.Generator,
    rig: Calibration,
    objects: int,
    cycles: tuple[float, float],
    painted: bool = False,
    touching: bool = False,
) -> list[Surface]:
    """Return the surfaces of `piled_objects`, the wall first."""
    surfaces = [wall(rng, painted)]
    for _ in range(objects):
        color = PAINTS[rng.integers(len(PAINTS))] if painted else SKIN
        surfaces.append(_object(rng, rig, surfaces[0], cycles, color, touching))
    return surfaces


def plates_before_a_wall(
    seed: int, size_px: tuple[float, float], *, gamma: float, code: CodeName
) -> tuple[SimulatedFrame, npt.NDArray[np.int64]]:
    """Return a frame of twelve plates, 1.5 cycles before a wall (0), and which surface every pixel sees."""
    rng = np.random.default_rng(seed)
    rig = simulated_rig(SIZE, code=code)
    surfaces = [wall(rng)]
    for x, y in np.stack(np.meshgrid(np.arange(4) + 0.5, np.arange(3) + 0.5), -1).reshape(-1, 2):
        x, y = np.array([x / 4, y / 3]) * SIZE + rng.uniform(-30, 30, 2)
        normal, ray = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), 1.0]), ray_through(rig, x, y)
        distance_mm = float(_depth_before(rig, surfaces[0], ray, 1.5) * ray @ normal)
        surfaces.append(Surface(SKIN, normal, distance_mm, (False, x, y, size_px[0] / 2, size_px[1] / 2)))
    return photographed(rng, rig, surfaces, gamma)


def wall(rng: np.random.Generator, painted: bool = False) -> Surface:
    """Return a wall behind everything."""
    normal = np.array([rng.uniform(-0.15, 0.15), rng.uniform(-0.15, 0.15), 1.0])
    return Surface(WHITE if painted else SKIN, normal, float(rng.uniform(930, 1000)))


def _object(
    rng: np.random.Generator,
    rig: Calibration,
    behind: Surface,
    cycles: tuple[float, float],
    color: tuple[float, float, float],
    touching: bool,
) -> Surface:
    half_height = rng.uniform(*cycles) * 12 / 2
    half_width = half_height * rng.uniform(0.7, 1.6)
    x, y = rng.uniform(40, SIZE[0] - 40), rng.uniform(40, SIZE[1] - 40)
    outline = (bool(rng.random() < 0.5), x, y, half_width, half_height)
    normal = np.array([rng.uniform(-0.4, 0.4), rng.uniform(-0.4, 0.4), 1.0])
    ray, depth = ray_through(rig, x, y), rng.uniform(800, 910)
    if touching:
        dx, dy = ((0, -half_height), (0, half_height), (-half_width, 0), (half_width, 0))[rng.integers(4)]
        ray = ray_through(rig, x + dx, y + dy)
        depth = _depth_before(rig, behind, ray, rng.integers(1, 4))
    elif rng.random() < 0.5:
        radius = half_height / rig.camera.matrix[0, 0] * depth
        return Surface(color, middle=ray * depth + [0, 0, radius], radius_mm=radius)
    return Surface(color, normal, float(depth * ray @ normal), outline)


def _depth_before(rig: Calibration, behind: Surface, ray: Floats, cycles: float) -> float:
    """Return how far along a ray the pattern is so many cycles before that on a plane."""
    geometry, far = rig.geometry(), behind.distance_mm / float(ray @ behind.normal)
    depths = np.linspace(far - 180, far, 600)
    lead = np.abs(geometry.pattern_cycles(depths[:, None] * ray) - geometry.pattern_cycles((far * ray)[None]))
    return float(np.interp(cycles, lead[::-1], depths[::-1]))


def ray_through(rig: Calibration, x: float, y: float) -> Floats:
    """Return the direction (x, y, 1) in which the camera sees at a pixel."""
    k = rig.camera.matrix
    return np.array([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], 1.0])


def _met(
    rig: Calibration, surfaces: list[Surface], origin: Floats, rays: Floats
) -> tuple[Floats, npt.NDArray[np.int64]]:
    """Return how far along rays (..., 3) the first surface lies, and its number; inf and -1 where there is none."""
    k = rig.camera.matrix
    nearest, number = np.full(rays.shape[:-1], np.inf), np.full(rays.shape[:-1], -1)
    for n, surface in enumerate(surfaces):
        if surface.normal is not None:
            far = (surface.distance_mm - origin @ surface.normal) / (rays @ surface.normal)
            met = far > 1e-6
            if surface.outline is not None:
                ellipse, x, y, half_width, half_height = surface.outline
                p = origin + far[..., None] * rays
                u = (p[..., 0] / p[..., 2] * k[0, 0] + k[0, 2] - x) / half_width
                v = (p[..., 1] / p[..., 2] * k[1, 1] + k[1, 2] - y) / half_height
                met &= (u * u + v * v < 1) if ellipse else (np.maximum(np.abs(u), np.abs(v)) < 1)
        else:
            away = origin - surface.middle
            along, square = rays @ away, (rays**2).sum(axis=-1)
            under = along**2 - square * (away @ away - surface.radius_mm**2)
            far = (-along - np.sqrt(np.maximum(under, 0))) / square
            met = (under > 0) & (far > 1e-6)
        nearer = met & (far < nearest)
        nearest, number = np.where(nearer, far, nearest), np.where(nearer, n, number)
    return nearest, number


def traced(rig: Calibration, surfaces: list[Surface]) -> list[Rays]:
    """Return what the rays of every pixel meet, the middle one among them."""
    geometry = rig.geometry()
    k, centre = geometry.camera.matrix, -geometry.rotation.T @ geometry.translation_mm
    y, x = np.indices(SIZE[::-1])
    colors, met = np.array([surface.color for surface in surfaces]), []
    for sub_x, sub_y in PLACES:
        rays = np.stack([(x + sub_x - k[0, 2]) / k[0, 0], (y + sub_y - k[1, 2]) / k[1, 1], np.ones(x.shape)], -1)
        far, number = _met(rig, surfaces, np.zeros(3), rays)
        points = far[..., None] * rays
        towards = points - centre
        distance = np.linalg.norm(towards, axis=-1)
        slope = np.zeros(x.shape)
        for n, surface in enumerate(surfaces):
            inside = number == n
            if surface.normal is not None:
                normal = np.broadcast_to(surface.normal / np.linalg.norm(surface.normal), towards[inside].shape)
            else:
                normal = (surface.middle - points[inside]) / surface.radius_mm
            slope[inside] = (normal * towards[inside]).sum(axis=-1) / distance[inside]
        lit = (_met(rig, surfaces, centre, towards)[0] > 1 - 2e-3) & (slope > 0)
        pixel = geometry.projector_px(points.reshape(-1, 3)).reshape(*x.shape, 2)
        lit &= (pixel > -0.5).all(axis=-1) & (pixel < np.array(geometry.projector.size_px) - 0.5).all(axis=-1)
        strength = np.where(lit, slope * (_FALLOFF_MM / distance) ** 2, 0)
        met.append(Rays(points, pixel.astype(np.float32), strength, colors[number], number))
    return met


def light_seen(rays: list[Rays], light: npt.NDArray[np.floating]) -> Floats:
    """Return the light (H, W, 3) that reaches the camera from what the projector shows, and from the room."""
    total = 0.0
    for ray in rays:
        falls = ray.strength[..., None] * cv2.remap(light, ray.projector_px, None, cv2.INTER_LINEAR)
        total = total + ray.reflectance * ((_AMBIENT + falls) @ np.array(TYPICAL_CROSSTALK).T)
    return np.asarray(total / len(rays))


def projected(rig: Calibration, gamma: float) -> npt.NDArray[np.float32]:
    """Return the light of the rig's pattern, (Hp, Wp, 3)."""
    codes = make_pattern(rig.geometry().projector.size_px, rig.pattern)
    return cv2.GaussianBlur(cv2.pow(codes, gamma), (0, 0), _BLUR[0])


def photographed(
    rng: np.random.Generator, rig: Calibration, surfaces: list[Surface], gamma: float
) -> tuple[SimulatedFrame, npt.NDArray[np.int64]]:
    """Return a frame of these surfaces, and which of them every pixel sees."""
    rays = traced(rig, surfaces)
    image = cv2.GaussianBlur(light_seen(rays, projected(rig, gamma)), (0, 0), _BLUR[1])
    image = 0.9 * image / np.quantile(image, 0.995) + _NOISE / 255 * rng.standard_normal(image.shape)
    middle, geometry = rays[len(rays) // 2], rig.geometry()
    frame = SimulatedFrame(
        rig=rig,
        image=np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8),
        white_level=255,
        phase=2 * np.pi / geometry.pattern.period_px * middle.projector_px[..., geometry.phase_axis].astype(np.float64),
        mask=middle.strength > 0,
        points=middle.points.astype(np.float32),
        reflectance=middle.reflectance.astype(np.float32),
    )
    return frame, middle.number
