"""A decoded frame as a triangle mesh, top to bottom: the wanted part, steps, specks, holes, smoothing, triangles.

Where fewer triangles are requested, VTK's progressive decimation removes vertices, those nearest to the plane of their
neighbours or to the line of a rim first, and closes what is left with triangles [1]; whole pieces go where nothing else
is left to take. It moves none and makes none, so every vertex of the result lies where it lay, with its normal, its
standard deviation and its flags. (Quadric decimation fits surfaces somewhat better, but puts new vertices where nothing
was measured.)

References
----------
1. W. J. Schroeder, J. A. Zarge, W. E. Lorensen, Decimation of triangle meshes, SIGGRAPH 1992,
   doi:10.1145/133994.134010.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.decoding.frame_fields import FrameFields
from pipeline.errors import FootageError, SettingsError
from pipeline.output.background import inside_box, on_largest_plane
from pipeline.output.mesh import FILLED, RIM, SMOOTHED, Mesh, RangeGrid, Unit, flag_counts, provenance_of
from pipeline.output.range_surface import (
    MAX_SLOPE,
    FilledHoles,
    RangeSurface,
    fill_holes,
    find_surfaces,
    links_within,
    rim_shifts,
)
from tikernels import runtime
from tikernels.arrays import E
from tikernels.depth.meshing import triangulate_mesh
from tikernels.depth.step_cutting import cut_steep_links, link_pixels
from tikernels.depth.surface_fit import FittedSurface, fit_surface
from tikernels.depth.vertex_placing import place_vertices

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]

# Vertices at a time, which stay in the processor's cache.
_BLOCK = 2**15
# A link depends on no pixel that is farther away, px: on its ends, and the pixels that determine the slope there.
_REACH = 5
# The property with the probability that a vertex is whole cycles off.
_WRONG = "order_error_probability"


@dataclass(frozen=True)
class MeshOptions:
    """Options of a frame's mesh.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> near = colorphase.MeshOptions(crop_mm=(-50, -50, 800, 50, 50, 1000))
    >>> f"{np.ptp(colorphase.frame_mesh(frame, near).vertices[:, 0]):.0f} mm wide"
    '99 mm wide'
    """

    smoothed: bool = True
    """True to move vertices along their pixels' rays to the surface through their neighbours."""
    crop_mm: tuple[float, float, float, float, float, float] | None = None
    """Two opposite corners of a box, x0, y0, z0, x1, y1, z1, mm in the camera's frame; what is outside is left out."""
    without_background: bool = False
    """True to omit the largest plane."""
    max_triangles: int | None = None
    """The most triangles that the mesh may have."""


@dataclass(frozen=True)
class MeshCounts:
    """Counts of a frame's points by what became of them in its mesh."""

    vertices: int
    triangles: int
    smoothed: int
    """Vertices that were moved to the surface through their neighbours."""
    filled: int
    """Vertices in holes, where nothing was measured, other than those of ``rim``."""
    rim: int
    """Vertices that have moved to the line in which a surface ends."""
    cropped: int
    """Pixels outside the box."""
    background: int
    """Pixels on the largest plane."""
    specks: int
    """Pixels of surfaces too small to be reliable."""
    teeth: int
    """Pixels connected to their surface by less than a square of four."""


def frame_mesh(frame: FrameFields, options: MeshOptions | None = None, fields: Collection[str] | None = None) -> Mesh:
    """Join a frame's pixels into a mesh, cut at depth steps.

    Parameters
    ----------
    frame : FrameFields
        Any frame, decoded or stored; it stays as it is.
    options : MeshOptions, optional
        The parts to omit, and whether to smooth.
    fields : collection of str, optional
        Properties of the mesh, as far as the frame has them; None: all.

    Returns
    -------
    Mesh
        With a calibration in mm; without one x and y in px and z the relative phase in rad. Colours by the texture,
        normals and flags, modulation, standard deviations and the probability of a wrong order go along. Pixels
        without a range, teeth and specks are left out, so the mesh of an empty frame has no vertices.

    Raises
    ------
    SettingsError
        A box or the background is to be left out without a calibration, or the box is none.
    FootageError
        The fields that the mesh needs are not stored, or damaged.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> mesh = colorphase.frame_mesh(frame, colorphase.MeshOptions(max_triangles=1000))
    >>> len(mesh.faces), mesh.unit
    (1000, 'mm')
    """
    return counted_mesh(frame, options, fields)[0]


def counted_mesh(
    frame: FrameFields, options: MeshOptions | None = None, fields: Collection[str] | None = None
) -> tuple[Mesh, MeshCounts]:
    """Return a frame's mesh, and what became of its points; see `frame_mesh`."""
    points = frame.points
    values = frame.range_image if points is None else points[..., 2]
    mask = frame.mask & np.isfinite(values)
    asked = frame.fields.keys() if fields is None else frame.fields.keys() & set(fields)
    properties = {
        field.vertex: getattr(frame, name)[mask]
        for name, field in frame.fields.items()
        if field.vertex is not None and name in asked
    }
    region, texture = (getattr(frame, name) if name in asked else None for name in ("region", "texture"))
    mesh, counts = surface_mesh(values, mask, points, properties, region, options, texture)
    return replace(mesh, provenance=provenance_of(frame.attributes, frame.number, frame.time_s)), counts


def frame_grid(frame: FrameFields) -> RangeGrid:
    """Return a frame's places with all that is known of them, in the camera's grid.

    Raises
    ------
    FootageError
        There are no places in mm, or the frame is damaged.
    """
    mask, points = frame.mask, frame.points
    if points is None:
        raise FootageError("the frame is in rad, not in mm: decode with a calibration that holds the geometry")
    return RangeGrid(
        np.where(mask[..., None], points, np.float32(np.nan)),
        frame.texture if "texture" in frame.fields else None,
        {
            field.vertex: np.where(mask, getattr(frame, name), np.float32(np.nan))
            for name, field in frame.fields.items()
            if field.vertex is not None
        },
        frame.camera,
        float(frame.number or 0) if frame.time_s is None else frame.time_s,  # pictures, as if one per second
        provenance_of(frame.attributes, frame.number, frame.time_s),
    )


def grid_mesh(grid: RangeGrid) -> Mesh:
    """Join a grid of points into a mesh as `frame_mesh` joins a frame's; everything that it knows goes along."""
    mask = np.isfinite(grid.depth)
    properties = {name: values[mask] for name, values in grid.properties.items()}
    return surface_mesh(grid.depth, mask, grid.points, properties, texture=grid.texture)[0]


def surface_mesh(
    values: Floats,
    mask: Pixels,
    points: Floats | None,
    properties: dict[str, Floats],
    region: npt.NDArray[np.int32] | None = None,
    options: MeshOptions | None = None,
    texture: npt.NDArray[np.uint8] | None = None,
) -> tuple[Mesh, MeshCounts]:
    """Join the pixels of a range image into a mesh, cut at depth steps.

    Parameters
    ----------
    values : (H, W) float32
        Relative phase, rad; of no account where there are points.
    mask : (H, W) bool
        Pixels that have a range.
    points : (H, W, 3) float32 or None
        mm, camera frame.
    properties : dict of (N,) float32
        More about each masked pixel, row by row. ``sigma_mm``, or ``sigma_rad`` without points, distinguishes noise
        from steps; where it is missing the range image's own scatter does.
    region : (H, W) int32, optional
        Connected surfaces; without it all pixels may be one.
    options : MeshOptions, optional
        The parts to omit, and whether to smooth.
    texture : (H, W, 3) uint8, optional
        sRGB.

    Returns
    -------
    Mesh
        See `frame_mesh`.
    MeshCounts
        Counts of the pixels by their fate.

    Raises
    ------
    SettingsError
        See `frame_mesh`.
    """
    options = options or MeshOptions()
    unit: Unit = "rad" if points is None else "mm"
    surface = RangeSurface.of(values, mask, points, properties.get(f"sigma_{unit}"), region)
    left_out = _left_out(surface, points, options)
    surface = surface.without(left_out[0] | left_out[1])
    joined = _joined(surface)
    holes, kept, fitted = joined.holes, joined.kept, joined.fitted
    shift = rim_shifts(kept) if options.smoothed else np.zeros((*mask.shape, 2), np.float32)
    places = np.flatnonzero(kept)
    flags = _flags(fitted.level, holes, shift, options)[places]
    depth = fitted.depth if options.smoothed else holes.surface.depth
    if points is None:
        vertices, normals = _relief(places, depth, fitted.slope, shift)
    else:
        with runtime.lock:
            vertices, normals = place_vertices(depth, fitted.slope, shift, points, mask, kept)
    number = _source_pixels(mask, holes, places)
    carried = _carried(holes.surface, places, unit, {name: values[number] for name, values in properties.items()})
    if "confidence" in carried:
        carried["confidence"][flags & (FILLED | RIM) == FILLED] = 0
    more: dict[str, Any] = {"normals": normals, "flags": flags}
    if texture is not None:
        more |= {"pixels": _columns_and_rows(places, shift), "texture": texture}
        more["colors"] = _vectors_at(texture, np.flatnonzero(mask)[number])
    mesh = Mesh(vertices, joined.faces, properties=carried, unit=unit, **more)
    if options.max_triangles is not None:
        mesh = decimate_mesh(mesh, options.max_triangles)
    return mesh, _counted(mesh, *(int(pixels.sum()) for pixels in (*left_out, joined.specks, joined.teeth)))


def fitted_normals(values: Floats, mask: Pixels, points: Floats | None, sigma: Floats | None) -> Floats:
    """Return the normals of the surface fitted to a range image, cut at depth steps.

    Parameters
    ----------
    values : (H, W) float32
        Relative phase, rad; of no account where there are points.
    mask : (H, W) bool
        Pixels that have a range.
    points : (H, W, 3) float32 or None
        mm, camera frame.
    sigma : (N,) float32 or None
        Standard deviation of each masked pixel, row by row; None: the range image's own scatter.

    Returns
    -------
    (H, W, 3) float32
        Unit vectors towards the camera, in px and rad without points; NaN where there is no surface.
    """
    surface = RangeSurface.of(values, mask, points, sigma, None)
    known = surface.region != 0
    places, shift = np.flatnonzero(known), np.zeros((*mask.shape, 2), np.float32)
    with runtime.lock:
        fitted = fit_surface(surface.depth, surface.sigma, known, _links(surface))
        if points is None:
            found = _relief(places, fitted.depth, fitted.slope, shift)[1]
        else:
            found = place_vertices(fitted.depth, fitted.slope, shift, points, mask, known)[1]
    normals = np.full((*mask.shape, 3), np.nan, np.float32)
    normals.reshape(-1, 3)[places] = found
    return normals


class _Joined(NamedTuple):
    """A range image whose pixels are joined."""

    holes: FilledHoles
    fitted: FittedSurface
    kept: Pixels
    """(H, W): what becomes a vertex."""
    faces: npt.NDArray[np.int32]
    specks: Pixels
    teeth: Pixels


def _joined(surface: RangeSurface) -> _Joined:
    """Link a range image's pixels, fill its holes, fit a surface to it, and cut it at the steps of that fit."""
    measured = surface.region != 0
    with runtime.lock:
        links = _links(surface)
        kept, specks = find_surfaces(links)
        holes = fill_holes(surface.without(~kept))
        surface = holes.surface
        if len(holes.filled):
            links = _linked_again(surface, holes.filled, links)
            kept = find_surfaces(links)[0]
        links = links_within(links, kept)
        fitted = fit_surface(surface.depth, surface.sigma, kept, links)
        # What the fit knows better than single pixels did.
        links = runtime.to_host(cut_steep_links(links, fitted.depth, fitted.sigma, surface.width, MAX_SLOPE))
        kept, pieces = find_surfaces(links)
        links = links_within(links, kept)
        faces = triangulate_mesh(surface.depth, kept, links)
    from_measured = kept.copy()
    from_measured.ravel()[holes.filled] = False
    specks = (specks | pieces) & measured
    return _Joined(holes, fitted, kept, faces, specks, measured & ~from_measured & ~specks)


def _carried(
    surface: RangeSurface, places: npt.NDArray[np.intp], unit: Unit, properties: dict[str, Floats]
) -> dict[str, Floats]:
    """Return what is known of each vertex, with the surface's own sigma and, in mm, a confidence."""
    carried = dict(properties)
    if f"sigma_{unit}" in carried:
        carried[f"sigma_{unit}"] = surface.sigma.ravel()[places]
    if unit == "mm" and {"sigma_mm", _WRONG} <= carried.keys():
        width = surface.width.ravel()[places]
        carried["confidence"] = _confidence(carried["sigma_mm"], width, carried[_WRONG])
    return carried


def _left_out(surface: RangeSurface, points: Floats | None, options: MeshOptions) -> tuple[Pixels, Pixels]:
    """Return the pixels outside the box, and those of the background."""
    known = surface.region != 0
    nothing = np.zeros_like(known)
    if points is None and (options.crop_mm is not None or options.without_background):
        raise SettingsError("a box in mm, or the background, can be left out of a mesh in mm only: give a calibration")
    if points is None:
        return nothing, nothing
    cropped = nothing if options.crop_mm is None else known & ~inside_box(points, options.crop_mm)
    if not options.without_background:
        return cropped, nothing
    return cropped, on_largest_plane(points, surface.sigma, known & ~cropped)


def _links(surface: RangeSurface) -> npt.NDArray[np.uint8]:
    return runtime.to_host(link_pixels(surface.depth, surface.sigma, surface.width, surface.region))


def _linked_again(
    surface: RangeSurface, filled: npt.NDArray[np.intp], links: npt.NDArray[np.uint8]
) -> npt.NDArray[np.uint8]:
    """Return the links of a surface of which some pixels have been filled since."""
    pixels = np.zeros(links.shape, np.uint8)
    pixels.ravel()[filled] = 1
    near, around = (
        cv2.dilate(pixels, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) != 0 for reach in (_REACH, 2 * _REACH)
    )
    return np.where(near, _links(surface.without(~around)), links)


def _flags(level: Floats, holes: FilledHoles, shift: Floats, options: MeshOptions) -> npt.NDArray[np.uint8]:
    """Return what of each pixel's vertex was not measured, in the flat image."""
    flags = np.zeros(level.size, np.uint8)
    flags[(level.ravel() > 0) & options.smoothed] = SMOOTHED
    flags[holes.filled] |= FILLED
    flags[((shift[..., 0] != 0) | (shift[..., 1] != 0)).ravel()] |= FILLED | RIM
    return flags


def _columns_and_rows(places: npt.NDArray[np.intp], shift: Floats) -> Floats:
    """Return x and y of some pixels' vertices, px."""
    moved = np.empty_like(shift)
    for k, (count, along) in enumerate(((shift.shape[1], (1, -1)), (shift.shape[0], (-1, 1)))):
        np.add(shift[..., 1 - k], np.arange(count, dtype=np.float32).reshape(along), out=moved[..., k])
    return _vectors_at(moved, places)


def _vectors_at(image: npt.NDArray[E], places: npt.NDArray[np.intp]) -> npt.NDArray[E]:
    """Return the vectors of an image, (H, W, C), at N places of the flat image, (N, C)."""
    # By an index in brackets it takes sixteen times as long.
    return np.take(image.reshape(-1, image.shape[-1]), places, axis=0)


def _relief(places: npt.NDArray[np.intp], depth: Floats, slope: Floats, shift: Floats) -> tuple[Floats, Floats]:
    """Return the vertices of a relief over an image, in px and rad, and their normals towards the camera."""
    slope = _vectors_at(slope, places)
    normals = np.column_stack([slope[:, 1], slope[:, 0], np.full(len(slope), -1, np.float32)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moved = depth.ravel()[places] + (slope * _vectors_at(shift, places)).sum(axis=1)
    return np.column_stack([_columns_and_rows(places, shift), moved]), normals


def _source_pixels(mask: Pixels, holes: FilledHoles, places: npt.NDArray[np.intp]) -> npt.NDArray[np.int32]:
    """Return the masked pixel that each vertex comes from; where a hole was filled, the one next to it."""
    source = np.arange(mask.size, dtype=np.int32)
    source[holes.filled] = holes.beside
    return np.asarray(np.cumsum(mask.ravel(), dtype=np.int32)[source[places]] - 1)


def _confidence(sigma: Floats, width: Floats, wrong: Floats) -> Floats:
    """Return how probably a vertex lies within one pixel's width of the surface, along its ray, 0..1.

    That of a normal error, by formula 7.1.26 of M. Abramowitz, I. A. Stegun, Handbook of Mathematical Functions, 1964,
    times that of the right order.
    """
    confidence = np.empty(sigma.shape, np.float32)
    for start in range(0, len(sigma), _BLOCK):
        part = slice(start, start + _BLOCK)
        x = width[part] / np.maximum(np.float32(np.sqrt(2)) * sigma[part], np.float32(1e-12))
        t = 1 / (1 + np.float32(0.3275911) * x)
        tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
        within = 1 - tail * np.exp(-(np.minimum(x, 9) ** 2))
        confidence[part] = np.clip(within * (1 - wrong[part]), 0, 1)
    return confidence


def _counted(mesh: Mesh, cropped: int, background: int, specks: int, teeth: int) -> MeshCounts:
    moved = flag_counts(np.zeros(0, np.uint8) if mesh.flags is None else mesh.flags)
    left_out = {"cropped": cropped, "background": background, "specks": specks, "teeth": teeth}
    return MeshCounts(len(mesh.vertices), len(mesh.faces), **moved, **left_out)


def decimate_mesh(mesh: Mesh, max_triangles: int) -> Mesh:
    """Return a mesh with few triangles, whose vertices are some of its own.

    Parameters
    ----------
    mesh : Mesh
        Left as it is.
    max_triangles : int
        Most triangles of the result; a mesh that has no more is returned itself.

    Raises
    ------
    SettingsError
        The number is less than one.
    """
    if max_triangles < 1:
        raise SettingsError(f"max_triangles: got {max_triangles}, expected 1 or more")
    if len(mesh.faces) <= max_triangles:
        return mesh
    import pyvista  # slow to import, and seldom needed

    surface = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)
    surface.point_data["number"] = np.arange(len(mesh.vertices), dtype=np.int32)
    # Splitting would make two vertices of one.
    fewer = surface.decimate_pro(1 - max_triangles / len(mesh.faces), splitting=False)
    kept, corners = np.unique(fewer.point_data["number"][fewer.regular_faces], return_inverse=True)
    return replace(mesh, faces=corners.reshape(-1, 3).astype(np.int32), **mesh.vertices_at(kept))
