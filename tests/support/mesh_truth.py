"""How a mesh of a simulated or rendered frame compares with the surface it was made from."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from pipeline.calibration.lens import Lens
from pipeline.output.mesh import FILLED, RIM, Mesh

#: Neighbouring pixels whose depths differ by this much, mm, see two surfaces.
STEP_MM = 5.0
#: How far the rim of a mesh may be from the edge of what is lit and seen, px.
RIM_PX = 1.5

Pixels = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class MeshQuality:
    """What a mesh is worth, shares in 0..1."""

    vertices: int
    triangles: int
    filled: int
    within_three: float
    """Measured vertices within three of their standard deviations of the true surface."""
    beyond_six: float
    """Measured vertices beyond six."""
    filled_within_three: float
    """The same of those in holes that were filled; NaN: none were."""
    rim_within_three: float
    """The same of those that have moved to a rim, between pixels; NaN: none have."""
    depth_median_mm: float
    """Median size of the depth's error."""
    depth_rms_mm: float
    complete: float
    """Of the pixels that are lit, those that are vertices."""
    across_steps: int
    """Triangles whose corners' true depths are `STEP_MM` or more apart."""
    rims: float
    """Of the mesh's rim, what lies within `RIM_PX` of an edge of what is lit, of a step, or of the picture."""
    normal_deg: float
    """Median angle between a vertex's normal and the true surface's."""
    rim_normal_deg: float
    """The same of the vertices that have moved to a rim; NaN: none have."""


def judge_mesh(mesh: Mesh, depth_mm: npt.NDArray[np.floating], lit: Pixels, camera: Lens) -> MeshQuality:
    """Compare a mesh in mm with the truth.

    Parameters
    ----------
    mesh : Mesh
        Of one camera frame; its vertices lie on pixels' rays, but for those that have moved to a rim.
    depth_mm : (H, W)
        True depth; NaN or infinite where nothing is.
    lit : (H, W) bool
        What projector and camera both see.
    camera : Lens
        Without distortion.
    """
    assert mesh.flags is not None and mesh.normals is not None
    place = (mesh.vertices / mesh.vertices[:, 2:]) @ camera.matrix.T
    x, y = np.rint(place[:, :2]).astype(int).T
    truth = depth_mm[y, x]
    known = np.isfinite(truth)
    error = mesh.vertices[:, 2] - truth
    deviation = np.abs(error) / mesh.properties["sigma_mm"]
    filled, moved = mesh.flags & (FILLED | RIM) == FILLED, mesh.flags & RIM != 0
    measured, made = known & ~filled & ~moved, known & filled
    corners = truth[mesh.faces]
    covered = np.zeros(lit.shape, bool)
    covered[y, x] = True
    off_rim = np.abs(mesh.vertices[moved, 2] - _depth_between(depth_mm, place[moved, :2]))
    off_rim = (off_rim / mesh.properties["sigma_mm"][moved])[np.isfinite(off_rim)]
    cosines = np.einsum("ni,ni->n", mesh.normals, true_normals(depth_mm, camera)[y, x])
    tilt_deg = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return MeshQuality(
        vertices=len(mesh.vertices),
        triangles=len(mesh.faces),
        filled=int(filled.sum()),
        within_three=float((deviation[measured] < 3).mean()),
        beyond_six=float((deviation[measured] > 6).mean()),
        filled_within_three=float((deviation[made] < 3).mean()) if made.any() else float("nan"),
        rim_within_three=float((off_rim < 3).mean()) if len(off_rim) else float("nan"),
        depth_median_mm=float(np.median(np.abs(error[measured]))),
        depth_rms_mm=float(np.sqrt(np.mean(error[measured] ** 2))),
        complete=float((covered & lit).sum() / lit.sum()),
        across_steps=int((np.ptp(corners, axis=1) >= STEP_MM).sum()),
        rims=_share_of_rims(mesh, y, x, depth_mm, lit),
        normal_deg=float(np.nanmedian(tilt_deg)),
        rim_normal_deg=float(np.nanmedian(tilt_deg[moved])) if moved.any() else float("nan"),
    )


def true_normals(depth_mm: npt.NDArray[np.floating], camera: Lens) -> npt.NDArray[np.floating]:
    """(H, W, 3): normals of the true surface towards the camera; NaN beside steps."""
    points = camera.rays().astype(np.float64)
    points = np.concatenate([points, np.ones((*depth_mm.shape, 1))], axis=-1) * depth_mm[..., None]
    along, down = np.full(points.shape, np.nan), np.full(points.shape, np.nan)
    along[:, 1:-1], down[1:-1] = points[:, 2:] - points[:, :-2], points[2:] - points[:-2]
    across = np.cross(down, along)
    across[np.maximum(np.abs(along[..., 2]), np.abs(down[..., 2])) >= STEP_MM] = np.nan
    return across / np.linalg.norm(across, axis=-1, keepdims=True)


def _depth_between(depth_mm: npt.NDArray[np.floating], place: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
    """Return the true depth at places between pixels, (N,); NaN where a step is between them."""
    x, y = place.T
    left = np.clip(np.floor(x).astype(int), 0, depth_mm.shape[1] - 2)
    top = np.clip(np.floor(y).astype(int), 0, depth_mm.shape[0] - 2)
    corners = np.stack([depth_mm[top + j, left + i] for j in (0, 1) for i in (0, 1)])
    u, v = x - left, y - top
    between = (1 - v) * ((1 - u) * corners[0] + u * corners[1]) + v * ((1 - u) * corners[2] + u * corners[3])
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(np.ptp(corners, axis=0) < STEP_MM, between, np.nan))


def _share_of_rims(
    mesh: Mesh, y: npt.NDArray[np.int_], x: npt.NDArray[np.int_], depth_mm: npt.NDArray[np.floating], lit: Pixels
) -> float:
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    edges, count = np.unique(edges, axis=0, return_counts=True)
    rim = np.zeros(lit.shape, bool)
    ends = np.unique(edges[count == 1])
    rim[y[ends], x[ends]] = True
    edge = np.zeros(lit.shape, bool)
    edge[[0, -1]] = edge[:, [0, -1]] = True
    for step in (np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1]):
        one, other = step
        with np.errstate(invalid="ignore"):
            apart = ~(np.abs(depth_mm[one] - depth_mm[other]) < STEP_MM) | (lit[one] != lit[other])
        edge[one] |= apart
        edge[other] |= apart
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float((distance[rim] <= RIM_PX).mean()) if rim.any() else 1.0
