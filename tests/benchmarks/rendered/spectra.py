"""Spectra at 1 nm, and the 3x3 matrix by which a surface turns the projector's primaries into the camera's channels.

With primaries P_j (unit area), a camera's filters F_i and a surface's reflectance rho, light that bounces once is

    camera_i = sum over j of M_ij p_j,    M_ij = integral of F_i rho P_j over the wavelength.

That is exact for any spectra, so nothing has to be rendered wavelength by wavelength. Light that has bounced off
several surfaces has the product of their reflectances for rho.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

Spectrum = npt.NDArray[np.float64]

#: nm.
WAVELENGTHS = np.arange(390.0, 731.0)


def bell(center_nm: float, deviation_nm: float) -> Spectrum:
    """Return a Gaussian of height one at the wavelengths."""
    return np.exp(-0.5 * ((WAVELENGTHS - center_nm) / deviation_nm) ** 2)


def edge(center_nm: float, width_nm: float) -> Spectrum:
    """Return a logistic step that rises from 0 to 1 with the wavelength, or falls for a negative width."""
    return 1 / (1 + np.exp(-(WAVELENGTHS - center_nm) / width_nm))


@dataclass(frozen=True)
class Projector:
    """What a projector's three primaries are made of."""

    name: str
    primaries: Spectrum  # (3, wavelengths), each of unit area


@dataclass(frozen=True)
class Camera:
    """What a camera's three channels see."""

    name: str
    filters: Spectrum  # (3, wavelengths) sensitivities


def _of_unit_area(spectra: list[Spectrum]) -> Spectrum:
    return np.stack([spectrum / spectrum.sum() for spectrum in spectra])


def _lamp() -> Spectrum:
    """Return a high-pressure mercury lamp: its lines, broadened by the pressure, on a continuum."""
    lines = ((405, 4, 1.6), (436, 5, 3.0), (546, 5, 3.2), (578, 6, 3.0))
    return 0.45 + 0.15 * edge(600, 40) + sum(height * bell(center, width) for center, width, height in lines)


#: Red, green and blue light-emitting diodes.
LED = Projector("LED", _of_unit_area([bell(628, 12), bell(537, 24), bell(462, 13)]))
#: A mercury lamp behind the dichroic filters of a colour wheel.
LAMP = Projector(
    "lamp",
    _of_unit_area(
        [
            _lamp() * edge(592, 4),
            _lamp() * edge(500, 4) * edge(572, -4),
            _lamp() * edge(418, 4) * edge(496, -4),
        ]
    ),
)
_INFRARED_CUT = 1 - edge(668, 7)
#: The filters of a common industrial Bayer sensor, behind a filter that cuts the infrared.
INDUSTRIAL = Camera(
    "industrial",
    np.stack(
        [
            0.90 * bell(605, 38) + 0.05 * bell(440, 40) + 0.03,
            bell(532, 40) + 0.03,
            0.85 * bell(458, 32) + 0.03,
        ]
    )
    * _INFRARED_CUT,
)
#: Filters that part the colours better, as those of a camera for photographs do.
PHOTOGRAPHIC = Camera(
    "photographic",
    np.stack(
        [
            0.85 * bell(602, 27) + 0.06 * bell(530, 25) + 0.01,
            bell(530, 32) + 0.01,
            0.90 * bell(463, 25) + 0.01,
        ]
    )
    * edge(412, 5)
    * (1 - edge(652, 8)),
)
PROJECTORS = {projector.name: projector for projector in (LED, LAMP)}
CAMERAS = {camera.name: camera for camera in (INDUSTRIAL, PHOTOGRAPHIC)}

# Skin's reflectance, 25 nm apart from 415 nm on.
_SKIN = (0.20, 0.25, 0.31, 0.35, 0.36, 0.35, 0.37, 0.46, 0.56, 0.61, 0.63, 0.64)


def _skin() -> Spectrum:
    return np.interp(WAVELENGTHS, 415 + 25 * np.arange(len(_SKIN)), _SKIN)


def _flat(albedo: float) -> Callable[[], Spectrum]:
    return lambda: np.full(len(WAVELENGTHS), albedo)


# Paints by name, in the shapes that pigments have: reds, oranges and yellows are steps, greens and blues are bells, and
# none is black anywhere.
_PAINTS: dict[str, Callable[[], Spectrum]] = {
    "white": _flat(0.85),
    "corner white": _flat(0.8),
    "grey": _flat(0.45),
    "light grey": lambda: 0.48 + 0.03 * edge(520, 40),
    "bright": _flat(0.9),
    "dark": _flat(0.05),
    "skin": _skin,
    "lips": lambda: _skin() * (0.45 + 0.45 * edge(610, 15)),
    "hair": lambda: 0.03 + 0.05 * edge(620, 40),
    "spot": lambda: _skin() * (0.35 + 0.4 * edge(630, 25)),
    "sclera": lambda: 0.62 + 0.10 * edge(520, 40),
    "iris": lambda: 0.05 + 0.06 * bell(470, 50),
    "cream": lambda: 0.50 + 0.27 * edge(505, 25),
    "orange": lambda: 0.09 + 0.58 * edge(580, 14),
    "yellow": lambda: 0.11 + 0.64 * edge(510, 16),
    "green": lambda: 0.10 + 0.33 * bell(530, 38),
    "blue": lambda: 0.10 + 0.38 * bell(460, 42),
    "red": lambda: 0.04 + 0.60 * edge(612, 10),
}


def _chart() -> dict[str, Callable[[], Spectrum]]:
    """Return the 24 patches of a colour chart: steps up and down, bells and greys."""
    rising = [lambda at=at: 0.06 + 0.60 * edge(at, 14) for at in (480, 510, 540, 570, 595, 620)]
    falling = [lambda at=at: 0.06 + 0.50 * edge(at, -18) for at in (470, 495, 520, 550, 580, 610)]
    bells = [lambda at=at: 0.07 + 0.42 * bell(at, 34) for at in (440, 470, 505, 535, 570, 600)]
    grays = [_flat(albedo) for albedo in (0.88, 0.59, 0.36, 0.19, 0.09, 0.035)]
    return {f"patch {number:02d}": made for number, made in enumerate([*rising, *falling, *bells, *grays])}


_PAINTS |= _chart()
PAINTS = tuple(_PAINTS)
#: Names of the chart's patches, row by row of six.
CHART = tuple(name for name in PAINTS if name.startswith("patch"))


@cache
def reflectance(paint: str) -> Spectrum:
    """Return the share of the light, 0..1, that a paint sends back at each wavelength."""
    return _PAINTS[paint]()


def effective_matrix(projector: Projector, camera: Camera, rho: Spectrum | float = 1.0) -> npt.NDArray[np.float64]:
    """Return the (3, 3) matrix of a surface: camera = matrix @ projector, in linear light."""
    return (camera.filters * rho) @ projector.primaries.T


def ambient_color(projector: Projector, camera: Camera, rho: Spectrum | float = 1.0) -> npt.NDArray[np.float64]:
    """Return what the channels see, (3,), of an equal-energy light as bright as the projector's white."""
    channels = (camera.filters * np.ones(len(WAVELENGTHS))).sum(axis=1)
    brightness = effective_matrix(projector, camera).sum() / channels.sum()
    return brightness * (camera.filters * rho).sum(axis=1)


def meeting_wavelengths(projector: Projector, camera: Camera) -> npt.NDArray[np.float64]:
    """Return where filter i and primary j meet, (3, 3) nm: the mean wavelength of what passes both."""
    return (camera.filters * WAVELENGTHS) @ projector.primaries.T / effective_matrix(projector, camera)
