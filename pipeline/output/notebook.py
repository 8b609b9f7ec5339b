"""Displays of frames, results, meshes and calibrations in a notebook, and a frame as PyVista's data or a file.

Nothing here draws with VTK, which dies where there is no GL: pictures are shaded range images.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Calibration
from pipeline.decoding.frame import DecodedFrame
from pipeline.decoding.frame_fields import FrameFields
from pipeline.errors import FootageError, OutputError, SettingsError
from pipeline.files import write_atomically
from pipeline.output.formats.table import encode_as, format_of
from pipeline.output.mesh import Mesh, flag_counts, vertex_normals
from pipeline.output.mesh_files import write_mesh
from pipeline.output.range_image import HIDDEN, encode_png, shade_frame, shade_normals
from pipeline.output.store import write_store
from pipeline.output.stored_result import StoredResult
from pipeline.output.surface_mesh import frame_grid, frame_mesh
from pipeline.showing import html_block, save_frame, to_html, to_pyvista

Floats = npt.NDArray[np.float32]
Pixels = npt.NDArray[np.bool_]

# Of a picture, px: next to it there is room for the figures.
_WIDTH_PX = 320
# Vertices per pixel of a mesh's picture, so that hardly any is left without one.
_VERTICES_A_PIXEL = 2
# Of which one is made: enough for its width.
_MOST_VERTICES = 2 * _WIDTH_PX**2


# Standard deviations of a calibration: their names, keys and units.
_SIGMAS = (
    ("place of the projector, x y z", "translation_mm", "mm"),
    ("turn of the projector, x y z", "rotation_deg", "deg"),
    ("camera's focal lengths and principal point", "camera", "px"),
    ("projector's focal lengths and principal point", "projector", "px"),
)


@to_html.register
def _frame_html(frame: DecodedFrame) -> str:
    mask, unit = frame.mask, frame.range_unit
    height, width = mask.shape
    period = "no fringe was found" if frame.period_px is None else f"{frame.period_px:.2f} px"
    figures = {
        "size": f"{width} x {height} px",
        "period": period,
        "noise": f"{frame.noise_levels:.3g} grey levels",
        **_range_figures(frame.range_image, mask, unit),
        "regions": str(len(frame.orders_known) - 1),
        "absolute": _share(frame.absolute[mask]),
        "phase sigma, median": _median(frame.phase_sigma[mask], "rad"),
    }
    if frame.point_sigma is not None:
        figures["point sigma, median"] = _median(frame.point_sigma[mask], "mm")
    return html_block("Decoded frame", figures, frame.warnings, encode_png(shade_frame(frame)))


@to_html.register
def _result_html(result: StoredResult) -> str:
    unit = "mm" if result.in_mm else "rad"
    width, height = result.size_px
    footage = result.attributes.get("footage", {})
    figures = {
        "footage": str(footage.get("name", "a picture")),
        "frames": f"{len(result.done)} of {len(result.wanted)} done",
        "size": f"{width} x {height} px",
        "fields": ", ".join(sorted(result.fields)),
        "decoded by": f"colorphase {result.attributes['colorphase_version']}",
    }
    picture, warnings = None, [] if result.done else ["no frame is done"]
    if result.done:
        frame = result[0]
        try:
            warnings = [f"frame {frame.number}: {text}" for text in frame.warnings]
            if {"mask", "points"} <= result.fields or {"mask", "range_image"} <= result.fields:
                points = frame.points if "points" in result.fields else None
                depth, mask = frame.range_image if points is None else points[..., 2], frame.mask
                spans = _range_figures(depth, mask, unit)
                figures |= {f"frame {frame.number}, {name}": text for name, text in spans.items()}
                picture = encode_png(shade_frame(frame))
        except FootageError as error:
            warnings.append(str(error))
    return html_block("Stored result", figures, warnings, picture)


@to_html.register
def _mesh_html(mesh: Mesh) -> str:
    figures = {"vertices": f"{len(mesh.vertices):,}", "triangles": f"{len(mesh.faces):,}"}
    if len(mesh.vertices):
        low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        units = ("mm",) * 3 if mesh.unit == "mm" else ("px", "px", "rad")
        for axis, unit, least, most in zip("xyz", units, low, high, strict=True):
            figures[axis] = f"{least:.4g} to {most:.4g} {unit}"
    if mesh.flags is not None:
        for name, count in flag_counts(mesh.flags).items():
            figures[name] = f"{count:,} vertices"
    known = [name for name in ("colors", "normals") if getattr(mesh, name) is not None]
    figures["of each vertex"] = ", ".join([*known, *mesh.properties]) or "its place only"
    warnings = [] if mesh.unit == "mm" else ["not metric: z is relative phase in rad, x and y are px"]
    return html_block("Mesh", figures, warnings, _mesh_picture(mesh))


@to_html.register
def _calibration_html(calibration: Calibration) -> str:
    return html_block("Calibration", calibration_figures(calibration), calibration_warnings(calibration))


def calibration_warnings(calibration: Calibration) -> list[str]:
    """Return what the user should know of a calibration."""
    return [] if calibration.has_geometry else ["no geometry: frames are decoded to phases, in rad"]


def calibration_figures(calibration: Calibration) -> dict[str, str]:
    """Return the figures of a calibration, by name, in words."""
    figures = {}
    for name, lens in (("camera", calibration.camera), ("projector", calibration.projector)):
        if lens is not None:
            width, height = lens.size_px
            focal = f"{lens.matrix[0, 0]:.1f}, {lens.matrix[1, 1]:.1f}"
            figures[name] = f"{width} x {height} px, focal lengths {focal} px"
    if calibration.translation_mm is not None:
        figures["baseline"] = f"{np.linalg.norm(calibration.translation_mm):.1f} mm"
    if calibration.pattern is not None:
        pattern = calibration.pattern
        code = "no code" if pattern.code is None else f"code {pattern.code}"
        figures["pattern"] = f"{pattern.stripes}, {pattern.period_px:g} px a cycle, {code}"
    if calibration.depth_range_mm is not None:
        nearest, farthest = calibration.depth_range_mm
        figures["depth range"] = f"{nearest:g} to {farthest:g} mm"
    figures["crosstalk"] = "not measured" if calibration.crosstalk_matrix is None else "measured"
    figures["response"] = "not measured" if calibration.response is None else "measured"
    if calibration.has_geometry:
        proof = calibration.scale_proof
        figures["scale"] = "by the side of the board's squares alone" if proof is None else f"proved by a {proof}"
    known = calibration.uncertainty
    if known is not None and known.reprojection_px is not None:
        camera, projector = known.reprojection_px
        figures["reprojection, RMS"] = f"camera {camera:.3f} px, projector {projector:.3f} px"
    if known is not None and known.depth_bias_mm is not None:
        figures["depth, sigma by the calibration"] = f"{known.depth_bias_mm:.3g} mm"
    for name, key, unit in _SIGMAS:
        if (values := getattr(known, key, None)) is not None:
            figures[f"{name}, sigma"] = f"{', '.join(f'{value:.3f}' for value in values[:4])} {unit}"
    return figures


@to_pyvista.register
def mesh_surface(mesh: Mesh) -> Any:
    """Return a mesh as `pyvista.PolyData`; see `DecodedFrame.to_pyvista`."""
    import pyvista  # slow to import, and only needed here

    surface = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)
    surface.field_data["unit"] = [mesh.unit]
    if not len(mesh.vertices):  # PyVista takes no empty arrays
        return surface
    known = {**mesh.properties, "colors": mesh.colors, "flags": mesh.flags, "Normals": mesh.normals}
    for name, values in known.items():
        if values is not None:
            surface.point_data[name] = values
    if mesh.normals is not None:
        surface.point_data.active_normals_name = "Normals"
    return surface


@to_pyvista.register
def _frame_surface(frame: FrameFields) -> Any:
    return mesh_surface(frame_mesh(frame))


@save_frame.register
def _save_frame(frame: FrameFields, path: Path) -> None:
    kind = path.suffix.lower().removeprefix(".")
    if kind == "zarr" and isinstance(frame, DecodedFrame):
        write_store(path, frame)
        return
    try:
        form = format_of(kind)
    except SettingsError as error:
        raise OutputError(f"cannot write {path}: {error}") from None
    if form.holds_all_frames:
        raise OutputError(f"cannot write {path}: {form.meaning} holds all frames of a film")
    if form.encode_mesh is not None:
        write_mesh(frame_mesh(frame), path)
        return
    grid = frame_grid(frame)
    farthest_mm = float(np.nanmax(grid.depth, initial=0.0, where=np.isfinite(grid.depth)))
    for suffix, content in encode_as(form, grid, path.stem, farthest_mm).items():
        write_atomically(path.with_suffix(suffix), content)


def _range_figures(values: Floats, mask: Pixels, unit: str) -> dict[str, str]:
    known = values[mask & np.isfinite(values)]
    if not known.size:
        return {"coverage": _share(mask)}
    low, middle, high = np.percentile(known, (1, 50, 99))
    span = f"{low:.4g} to {high:.4g} {unit}, median {middle:.4g} {unit}"
    return {"coverage": _share(mask), "range, 1 to 99 %": span}


def _share(flags: Pixels) -> str:
    return f"{100 * flags.mean():.1f} %" if flags.size else "nothing is measured"


def _median(values: Floats, unit: str) -> str:
    known = values[np.isfinite(values)]
    return f"{np.median(known):.3g} {unit}" if known.size else "unknown"


def _mesh_picture(mesh: Mesh) -> bytes | None:
    """Return a mesh as it is seen along z, by its vertices."""
    if not len(mesh.faces):
        return None
    every = math.ceil(len(mesh.vertices) / _MOST_VERTICES)
    some = mesh.vertices[::every]
    order = np.argsort(-some[:, 2])  # the nearest comes last, and stays
    places, normals = some[order], vertex_normals(mesh)[::every][order]
    low, span = places.min(axis=0), np.ptp(places, axis=0)
    pixel = max(math.sqrt(_VERTICES_A_PIXEL * span[0] * span[1] / len(places)), span[:2].max() / (_WIDTH_PX - 1))
    column, row = ((places[:, :2] - low[:2]) / pixel).astype(np.intp).T
    picture = np.full((row.max() + 1, column.max() + 1, 3), HIDDEN, np.uint8)
    picture[row, column] = shade_normals(normals, mesh.unit)
    return encode_png(picture)
