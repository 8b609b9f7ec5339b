"""Light on a surface: a key light from the upper left, a fill light, a head light, and a soft sheen.

The light is worked out at the vertices and not by the drawing library: dense surfaces have one a pixel or two, so
that nothing is lost, and a software renderer without lights draws four samples a pixel in the time of one.
"""

import numpy as np
import numpy.typing as npt

from pipeline.output.pictures.viewpoint import Viewpoint

Floats = npt.NDArray[np.float32]

#: RGB of a fully lit surface that has no colour of its own.
CLAY = np.array([236, 228, 216], np.float32)
# Place of a light as seen from the eye (right, up, towards it), and its part in the light.
_LIGHTS = (((-1.0, 1.2, 1.0), 0.60), ((1.2, 0.2, 1.0), 0.20), ((0.0, 0.0, 1.0), 0.22))
_AMBIENT = 0.16
# Light from everywhere that colours which mean something have in place of so much of the rest, to be like their scale.
_EVEN = 0.45
# What mirrors the key light: its share, and the power (of two) of the cosine.
_SHEEN, _DOUBLINGS = 0.10, 4
# Vertices that tell which side of a surface is seen.
_FEW = 10_000


def lit_colors(vertices: Floats, normals: Floats, colors: npt.NDArray[np.uint8], eye: Viewpoint) -> Floats:
    """Return the colours of a surface's vertices under the light.

    Parameters
    ----------
    vertices, normals : (N, 3) float32
        The surface; a normal that points away from the eye is of its back, which is lit, too.
    colors : (N, 3) or (3,) uint8
        sRGB in full light; one for all is of a surface that only its relief tells about.
    eye : Viewpoint
        The lights move with it.

    Returns
    -------
    (N, 3) float32
        sRGB, 0 to 255.
    """
    right, down, back = eye.axes()
    few = slice(None, None, max(1, len(normals) // _FEW))
    facing = np.einsum("ij,ij->i", normals[few], np.array(eye.position, np.float32) - vertices[few])
    # The back of a surface is seen where most of it points away; else it is a rim's vertex, and keeps its side light.
    sign = -1.0 if np.mean(facing) < 0 else 1.0
    places = [place for place, _ in _LIGHTS]
    to_light = np.array([x * right - y * down + z * back for x, y, z in places])
    to_light /= np.linalg.norm(to_light, axis=1, keepdims=True)
    halfway = to_light[0] + back
    directions = sign * np.vstack([to_light, halfway / np.linalg.norm(halfway)])
    cosines = directions.astype(np.float32) @ normals.T  # one row a light: rows are read in one go
    np.maximum(cosines, 0, out=cosines)
    even = np.float32(0.0 if colors.ndim == 1 else _EVEN)
    intensities = (1 - even) * np.array([intensity for _, intensity in _LIGHTS], np.float32)
    light = intensities @ cosines[:3]
    light += even + (1 - even) * np.float32(_AMBIENT)
    sheen = cosines[3]
    for _ in range(_DOUBLINGS):
        sheen *= sheen
    sheen *= np.float32(255 * _SHEEN) * (1 - even)
    lit = light[:, None] * colors.astype(np.float32)
    lit += sheen[:, None]
    return np.asarray(np.minimum(lit, 255, out=lit))
