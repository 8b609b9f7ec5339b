"""Rigs drawn at random from wide ranges: projector, camera, where they stand, what the camera stores.

Ranges are those of what is sold: LED, lamp and laser projectors, colour cameras with filters of several makers.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from spectra import WAVELENGTHS, bell, edge

from pipeline.calibration import Calibration
from pipeline.calibration.lens import Lens
from pipeline.calibration.model import Pattern
from pipeline.pattern import CYCLES

F64 = npt.NDArray[np.float64]

# The most that a channel may see of another primary, relative to its own.
_MOST_OTHER = 0.7
#: How a camera hands over its frames.
DELIVERIES = ("rgb", "rgb", "rgb", "bayer", "jpeg", "mjpeg")


@dataclass(frozen=True)
class DrawnRig:
    """One rig."""

    name: str
    calibration: Calibration  # true geometry, and the plain pattern; nothing of the light
    primaries: F64  # (3, wavelengths) of unit area
    filters: F64  # (3, wavelengths)
    gammas: tuple[float, float, float]  # the projector's light is black + (1 - black) code ** gamma
    black: float
    projector_blur_px: float
    camera_blur_px: float
    projector_magnified: tuple[float, float, float]  # of the primaries, lateral colour
    camera_magnified: tuple[float, float, float]  # of the channels
    ambient: float  # of the projector's white
    ambient_color: F64  # (wavelengths,) the room's light
    bits: int
    full_well: float  # electrons
    read_noise: float  # electrons
    pedestal: float  # of full scale
    delivery: str  # one of DELIVERIES
    distance_mm: float  # where the two axes meet

    def matrix(self, reflectance: F64 | float) -> F64:
        """Return the (3, 3) matrix of a surface: camera = matrix @ projector, in linear light."""
        return (self.filters * reflectance) @ self.primaries.T

    def ambient_on(self, reflectance: F64 | float) -> F64:
        """Return what the channels, (3,), see of the room's light on a surface."""
        white = (self.filters * self.ambient_color).sum()
        return (
            self.ambient
            * self.matrix(1.0).sum()
            / white
            * (self.filters * self.ambient_color * reflectance).sum(axis=1)
        )


def rig_numbers(text: str) -> range:
    """Return the numbers of rigs that "N-M", or "N", means."""
    first, _, last = text.partition("-")
    return range(int(first), int(last or first) + 1)


def draw_rig(seed: int) -> DrawnRig:
    """Return a rig; every seed gives another one."""
    rng = np.random.default_rng([45, seed])
    kind = str(rng.choice(["LED", "lamp", "phosphor", "laser"]))
    while True:
        primaries = _draw_primaries(kind, rng)
        filters = _draw_filters(rng)
        matrix = filters @ primaries.T
        # A camera that sees another primary better than a channel's own is none that anybody would take.
        if (matrix <= _MOST_OTHER * matrix.diagonal()[:, None]).sum() == 6:
            break
    calibration, distance = _draw_geometry(rng)
    gamma = rng.uniform(1.7, 2.5)
    delivery = str(rng.choice(DELIVERIES))
    return DrawnRig(
        name=f"{seed}: {kind}",
        calibration=calibration,
        primaries=primaries,
        filters=filters,
        gammas=tuple(gamma + rng.uniform(-0.1, 0.1, 3)),
        black=rng.uniform(0.0005, 0.008),
        projector_blur_px=rng.uniform(0.4, 0.9),
        camera_blur_px=rng.uniform(0.35, 0.8),
        projector_magnified=_draw_lateral_color(rng),
        camera_magnified=_draw_lateral_color(rng) if rng.random() < 0.5 else (1.0, 1.0, 1.0),
        ambient=rng.uniform(0.0, 0.08),
        ambient_color=_draw_room(rng),
        bits=8 if "jpeg" in delivery else int(rng.choice([8, 8, 10, 12])),
        full_well=float(np.exp(rng.uniform(np.log(4000), np.log(25000)))),
        read_noise=rng.uniform(2, 8),
        pedestal=rng.uniform(0, 0.03),
        delivery=delivery,
        distance_mm=distance,
    )


def _draw_lateral_color(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return by how much a lens magnifies red, green and blue."""
    red = rng.uniform(0, 2.5e-4) * rng.choice([-1, 1])
    return 1 + red, 1.0, 1 - red


def _unit_area(spectra: list[F64]) -> F64:
    return np.stack([spectrum / spectrum.sum() for spectrum in spectra])


def _draw_primaries(kind: str, rng: np.random.Generator) -> F64:
    """Return LEDs, a lamp or a white LED behind dichroic filters, or lasers; the colours as bright as each other."""
    if kind == "LED":
        bells = [bell(rng.uniform(615, 640), rng.uniform(8, 14)), bell(rng.uniform(517, 545), rng.uniform(14, 28)),
                 bell(rng.uniform(448, 468), rng.uniform(8, 14))]  # fmt: skip
        return _unit_area(bells)
    if kind == "laser":
        return _unit_area([bell(rng.uniform(636, 642), 1.5), bell(rng.uniform(520, 532), 1.5),
                                 bell(rng.uniform(448, 465), 1.5)])  # fmt: skip
    if kind == "lamp":
        lines = ((405, 4, 1.6), (436, 5, 3.0), (546, 5, 3.2), (578, 6, 3.0))
        source = 0.45 + 0.15 * edge(600, 40) + sum(height * bell(at, width) for at, width, height in lines)
    else:
        source = 1.4 * bell(450, 10) + bell(rng.uniform(545, 565), 50) + 0.35 * bell(620, 30)
    # Filters overlap little to strongly.
    steep = rng.uniform(3, 9)
    overlap = rng.uniform(-6, 14)
    red, green = rng.uniform(585, 597), rng.uniform(497, 508)
    filters = (edge(red, steep), edge(green - overlap / 2, steep) * edge(red - 18 + overlap, -steep),
               edge(420, 4) * edge(green - 4 + overlap / 2, -steep))  # fmt: skip
    return _unit_area([source * passed + 0.002 * source for passed in filters])


def _draw_filters(rng: np.random.Generator) -> F64:
    """Return the sensitivities of a camera: bells of their makers' widths, with what leaks, behind an infrared cut."""
    wide = rng.uniform(0.75, 1.15)
    leak = rng.uniform(0.005, 0.04)
    red = rng.uniform(0.75, 1.0) * bell(rng.uniform(596, 610), wide * rng.uniform(28, 42))
    red += rng.uniform(0.0, 0.08) * bell(rng.uniform(430, 460), 35) + rng.uniform(0.0, 0.08) * bell(530, 28)
    green = bell(rng.uniform(525, 540), wide * rng.uniform(32, 44))
    blue = rng.uniform(0.7, 0.95) * bell(rng.uniform(452, 468), wide * rng.uniform(25, 36))
    cut = (1 - edge(rng.uniform(645, 680), rng.uniform(5, 9))) * edge(rng.uniform(400, 415), 5)
    return np.stack([red + leak, green + leak, blue + leak]) * cut


def _draw_room(rng: np.random.Generator) -> F64:
    """Return the room's light: daylight, a white LED or a warm lamp."""
    kinds = (np.ones(len(WAVELENGTHS)), bell(450, 12) + 1.2 * bell(560, 60), np.linspace(0.3, 1.7, len(WAVELENGTHS)))
    return kinds[rng.integers(len(kinds))]


def _draw_geometry(rng: np.random.Generator) -> tuple[Calibration, float]:
    """Return lenses and places; the pattern has 8 to 20 camera px a cycle where the two axes meet."""
    width, height = ((640, 480), (720, 540), (800, 600))[rng.integers(3)]
    focal = rng.uniform(1.5, 2.2) * width
    camera = Lens(
        size_px=(width, height),
        matrix=np.array(
            [
                [focal, 0, (width - 1) / 2 + rng.uniform(-8, 8)],
                [0, focal * rng.uniform(0.999, 1.001), (height - 1) / 2 + rng.uniform(-8, 8)],
                [0, 0, 1],
            ]
        ),
        distortion=np.array([rng.uniform(-0.15, 0.03), rng.uniform(-0.02, 0.06), *rng.normal(0, 4e-4, 2), 0.0]),
    )
    size = ((1024, 768), (1280, 800), (1280, 720))[rng.integers(3)]
    distance = rng.uniform(550, 1200)
    vertical = bool(rng.integers(2))
    # The projector's picture is somewhat larger than what the camera sees.
    seen = distance / focal * np.array([width, height])
    throw = 1 / max(1.12 * seen / distance / np.array(size))
    projector = Lens(
        size_px=size,
        matrix=np.array(
            [
                [throw, 0, (size[0] - 1) / 2 + rng.uniform(-20, 20)],
                [0, throw, (size[1] - 1) / 2 + rng.uniform(-20, 20)],
                [0, 0, 1],
            ]
        ),
        distortion=np.array([rng.uniform(-0.06, 0.03), rng.uniform(-0.02, 0.04), *rng.normal(0, 3e-4, 2), 0.0]),
    )
    baseline = rng.uniform(0.13, 0.28) * distance * rng.choice([-1, 1])
    centre = np.array([baseline, rng.uniform(-15, 15), rng.uniform(-20, 20)])
    if not vertical:
        centre[:2] = centre[1], centre[0]
    forward = np.array([0.0, 0.0, distance]) - centre
    forward /= np.linalg.norm(forward)
    down = np.array([0.0, 1.0, 0.0])
    right = np.cross(down, forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    rotation = cv2.Rodrigues(np.radians([0, 0, rng.uniform(-2, 2)]))[0] @ rotation
    period = rng.uniform(8, 20) * throw / focal  # about as many camera px
    axis = 0 if vertical else 1
    period = max(period, size[axis] / CYCLES, 6.0)
    rig = Calibration(
        camera=camera,
        projector=projector,
        rotation=rotation,
        translation_mm=-rotation @ centre,
        pattern=Pattern(period_px=period, stripes="vertical" if vertical else "horizontal"),
    )
    return rig, distance
