"""Viewpoints (by a name, by numbers, or along a path from a file), and the light, which moves with them.

The light is computed at the vertices and not by the drawing library: dense surfaces have one per pixel or two, so
that nothing is lost, and a software renderer without lights draws four samples per pixel in the time of one.
"""

import tomllib
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from pipeline.errors import SettingsError
from pipeline.models import Model, Signed, build, read_file

View = Literal["three-quarter", "front", "left", "right", "top", "bottom", "back"]
Triple = tuple[Signed, Signed, Signed]
Points = npt.NDArray[np.floating]
Floats = npt.NDArray[np.float32]

#: From the object to the eye, and what is up in the picture, camera frame.
VIEWS: dict[View, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "three-quarter": ((-0.55, -0.3, -1.0), (0.0, -1.0, 0.0)),  # from the upper left, for the relief to show
    "front": ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0)),
    "left": ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    "right": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    "top": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    "bottom": ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
    "back": ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}
#: Upright angle of all pictures, degrees: a narrow one, so that faces keep their proportions.
FIELD_OF_VIEW_DEG = 24.0
# The most that one frame of a path may have, and a path.
_MOST_KEYFRAMES = 10_000
# Sine of the least angle between where the eye looks and what is up.
_LEAST_SINE = 1e-3

#: RGB of a fully lit surface that has no colour of its own.
CLAY = np.array([236, 228, 216], np.float32)
# Place of a light as seen from the eye (right, up, towards it), and its part in the light.
_LIGHTS = (((-1.0, 1.2, 1.0), 0.60), ((1.2, 0.2, 1.0), 0.20), ((0.0, 0.0, 1.0), 0.22))
_AMBIENT = 0.16
# Light from everywhere that colours which mean something have in place of so much of the rest, to be like their scale.
_EVEN = 0.45
# What mirrors the key light: its share, and the power (of two) of the cosine.
_SHEEN, _DOUBLINGS = 0.10, 4
# Vertices that show which side of a surface is seen.
_FEW = 10_000


class Viewpoint(Model):
    """An eye and what it looks at, mm in the camera's frame: x right, y down, z away from the camera."""

    position: Triple
    focal_point: Triple
    up: Triple = (0.0, -1.0, 0.0)

    @model_validator(mode="after")
    def _looks_somewhere(self) -> "Viewpoint":
        towards, up = np.subtract(self.focal_point, self.position), np.array(self.up)
        lengths = np.linalg.norm(towards) * np.linalg.norm(up)
        if np.linalg.norm(towards) < 1e-6:
            raise ValueError("the eye is at the point that it looks at: move one of them")
        if np.linalg.norm(np.cross(towards, up)) <= _LEAST_SINE * lengths:
            raise ValueError("what is up lies along the line of sight: give another direction")
        return self

    @classmethod
    def of_numbers(cls, numbers: tuple[float, ...]) -> "Viewpoint":
        """Return the viewpoint that six or nine numbers give: position, focal point, and what is up.

        Raises
        ------
        SettingsError
            They are too many, too few, or give no viewpoint.
        """
        if len(numbers) not in (6, 9):
            raise SettingsError(
                f"--camera: got {len(numbers)} numbers, expected 6, the eye's x, y, z and those of the point that it "
                "looks at, in mm, or 9, with what is up"
            )
        triples = [numbers[i : i + 3] for i in range(0, len(numbers), 3)]
        named = dict(zip(("position", "focal_point", "up"), triples, strict=False))
        return build(cls, named, SettingsError, "--camera")

    def axes(self) -> Points:
        """Return the directions right, down and towards the eye, (3, 3), one a row, each of length 1."""
        back = np.subtract(self.position, self.focal_point)
        back /= np.linalg.norm(back)
        right = np.cross(np.array(self.up), back)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, back), back])

    def turned(self, angle_rad: float, pivot: Points) -> "Viewpoint":
        """Return the viewpoint that has gone round a point, to its left, about what is up."""
        axis = -np.array(self.up) / np.linalg.norm(self.up)
        places = (
            pivot + turn(np.subtract(place, pivot), axis, angle_rad) for place in (self.position, self.focal_point)
        )
        position, focal_point = (_triple(place) for place in places)
        return Viewpoint(position=position, focal_point=focal_point, up=self.up)

    def depth_of(self, points: Points) -> Points:
        """Return how far before the eye points are, along the line of sight, mm."""
        return np.asarray(-(points - np.array(self.position)) @ self.axes()[2])


class Keyframe(Viewpoint):
    """The eye when some part of the film is over."""

    at: Annotated[float, Field(ge=0, le=1)]


class CameraPath(Model):
    """Viewpoints that a film's eye passes, on smooth curves.

    Parameters
    ----------
    keyframes : tuple of Keyframe
        From ``at = 0``, the first picture, to ``at = 1``, the last one.
    """

    keyframes: Annotated[tuple[Keyframe, ...], Field(min_length=2, max_length=_MOST_KEYFRAMES)]

    @model_validator(mode="after")
    def _in_order(self) -> "CameraPath":
        at = [keyframe.at for keyframe in self.keyframes]
        if at[0] != 0 or at[-1] != 1 or any(after <= before for before, after in pairwise(at)):
            raise ValueError("keyframes: at must begin at 0, grow, and end at 1")
        return self

    @classmethod
    def read(cls, path: str | Path) -> "CameraPath":
        """Read a path from a TOML file, with a table ``[[keyframes]]`` for each viewpoint.

        Raises
        ------
        SettingsError
            It cannot be read, or is no path; the message names the key.
        """
        return read_file(path, cls, tomllib.loads, SettingsError)

    def viewpoint(self, part: float) -> Viewpoint:
        """Return where the eye is when this part of the film, 0 to 1, is over."""
        at = np.array([keyframe.at for keyframe in self.keyframes])
        position, focal_point, up = (
            _triple(_on_curve(at, np.array([getattr(keyframe, name) for keyframe in self.keyframes]), part))
            for name in ("position", "focal_point", "up")
        )
        return Viewpoint(position=position, focal_point=focal_point, up=up)


def fitted_viewpoint(
    points: Points,
    towards_eye: Points,
    up: Points,
    size_px: tuple[int, int],
    margins_px: tuple[float, float, float, float],
) -> Viewpoint:
    """Return the viewpoint from which points just fill a picture inside its margins.

    Parameters
    ----------
    points : (N, 3) float
        What is to be seen.
    towards_eye : (3,) float
        From them to the eye, of any length.
    up : (3,) float
        What is up in the picture.
    size_px : (int, int)
        Width and height.
    margins_px : four floats
        What stays free on the left, above, on the right and below.
    """
    here = Viewpoint(position=_triple(towards_eye), focal_point=(0.0, 0.0, 0.0), up=_triple(up))
    axes = here.axes()
    right, down, near = (points @ axis for axis in axes)
    half = np.tan(np.radians(FIELD_OF_VIEW_DEG / 2))
    left_margin, top, right_margin, bottom = np.array(margins_px) / (size_px[1] / 2) * half
    half_width = half * size_px[0] / size_px[1]
    # An edge of the picture at slope s to the line of sight has all points inside if x - X <= s (Z - z), X, Z the eye.
    spans = []
    for across, before, after in (
        (right, half_width - left_margin, half_width - right_margin),
        (down, half - top, half - bottom),
    ):
        least, most = (across - before * near).min(), (across + after * near).max()
        spans.append((least, most, before, after))
    distance = max((most - least) / (before + after) for least, most, before, after in spans)
    distance = max(distance, near.max() + 1e-3 * max(float(np.ptp(points, axis=0).max()), 1e-3))
    middles = [((most - after * distance) + (least + before * distance)) / 2 for least, most, before, after in spans]
    position = np.array([*middles, distance]) @ axes
    focal_point = position - axes[2] * (distance - (near.min() + near.max()) / 2)
    return Viewpoint(position=_triple(position), focal_point=_triple(focal_point), up=_triple(up))


def turn(vector: Points, axis: Points, angle_rad: float) -> Points:
    """Return vectors, (..., 3), turned about an axis of length 1 (Rodrigues)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.asarray(c * vector + s * np.cross(axis, vector) + (1 - c) * (vector @ axis)[..., None] * axis)


def _on_curve(at: Points, values: Points, part: float) -> Points:
    """Return a point of the curve through some points: cubic between two, with the slope of their neighbours."""
    slopes = np.gradient(values, at, axis=0) if len(at) > 2 else np.diff(values, axis=0) / np.diff(at)
    slopes = np.broadcast_to(slopes, values.shape)
    i = int(np.clip(np.searchsorted(at, part, side="right") - 1, 0, len(at) - 2))
    span = at[i + 1] - at[i]
    t = np.clip((part - at[i]) / span, 0, 1)
    return np.asarray(
        (2 * t**3 - 3 * t**2 + 1) * values[i]
        + (t**3 - 2 * t**2 + t) * span * slopes[i]
        + (3 * t**2 - 2 * t**3) * values[i + 1]
        + (t**3 - t**2) * span * slopes[i + 1]
    )


def _triple(values: Points) -> Triple:
    x, y, z = (float(value) for value in values)
    return x, y, z


def lit_colors(vertices: Floats, normals: Floats, colors: npt.NDArray[np.uint8], eye: Viewpoint) -> Floats:
    """Return the colours of a surface's vertices under the light.

    Parameters
    ----------
    vertices, normals : (N, 3) float32
        The surface; a normal that points away from the eye is of its back, which is lit, too.
    colors : (N, 3) or (3,) uint8
        sRGB in full light; one for all: only the surface's relief is shown.
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
