"""Where the camera's rays end, found by Mitsuba: projector row, shading, paint and body of every sample of the film.

W. Jakob et al., Mitsuba 3 renderer, 2022, https://mitsuba-renderer.org. Only its intersection of rays is used; light is
added in `camera_film`. It needs libLLVM beside the package (version 19 works).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from rendered_scenes import Body, RenderedScene, mesh_of

from pipeline.calibration.model import Geometry
from pipeline.simulation import simulated_rig

F32 = npt.NDArray[np.float32]
U8 = npt.NDArray[np.uint8]

#: No body.
NOTHING = 255
# Rays at a time: some 300 MB.
_RAYS = 1_000_000
# Shading is one for a surface that faces the projector at this distance, mm.
_REFERENCE_MM = 918.0
#: Cycles of the pattern over the projector's rows.
_CYCLES = 44


def rig() -> Any:
    """Return the rig of all frames: a 640x480 camera of 1.9 widths focal length, 44 cycles in 768 rows, 900 mm away."""
    rig = simulated_rig(period_px=768 / _CYCLES)
    matrix = np.array([[1216.0, 0, 319.5], [0, 1216.0, 239.5], [0, 0, 1]])
    return rig.model_copy(update={"camera": rig.camera.model_copy(update={"matrix": matrix})})


@dataclass(frozen=True)
class Samples:
    """What the rays found, one entry each."""

    row: F32  # projector row; nonsense where nothing is lit
    depth: F32  # mm along the camera's axis; NaN where there is nothing
    distance: F32  # mm along the projector's axis
    diffuse: F32  # irradiance, 1 for a surface that faces the projector at the working distance; 0 unlit
    glossy: F32  # the same, of what a clear coat mirrors into the camera
    paint: U8  # number in the scene's list of paints; NOTHING
    body: U8  # number of the body; NOTHING
    surface: U8  # number of the surface; NOTHING


def paints_of(scene: RenderedScene) -> tuple[str, ...]:
    """Return the names of a scene's paints, body by body, in the order of their numbers in `Samples.paint`."""
    return tuple(paint for body in scene.bodies for paint in body.paints)


class Room:
    """A scene that rays can be sent into.

    Parameters
    ----------
    scene : RenderedScene
        The bodies.
    geometry : Geometry
        Camera and projector.
    offset_mm : (3,) float
        How far the bodies that move have moved.
    """

    def __init__(self, scene: RenderedScene, geometry: Geometry, offset_mm: npt.ArrayLike = (0.0, 0.0, 0.0)) -> None:
        import mitsuba as mi

        mi.set_variant("llvm_ad_rgb")
        self._mi = mi
        self.scene, self.geometry = scene, geometry
        self._offset = np.asarray(offset_mm, np.float64)
        shapes = {f"body{number}": self._shape(body) for number, body in enumerate(scene.bodies)}
        self._world = mi.load_dict({"type": "scene", **shapes})
        self._pointers = {shape.id(): mi.ShapePtr(shape) for shape in self._world.shapes()}
        self.projector = -geometry.rotation.T @ geometry.translation_mm

    def _shape(self, body: Body) -> Any:
        mi = self._mi
        offset = self._offset if body.moves else np.zeros(3)
        if body.shape["type"] != "mesh":
            assert not body.moves, "only meshes move"
            made = dict(body.shape)
            if "to_world" in made:
                made["to_world"] = mi.ScalarTransform4f(made["to_world"])
            return made
        vertices, faces = mesh_of(body)
        properties = mi.Properties()
        mesh = mi.Mesh("mesh", len(vertices), len(faces), has_vertex_normals=True, props=properties)
        mesh.set_id(f"body{self.scene.bodies.index(body)}")
        values = mi.traverse(mesh)
        values["vertex_positions"] = (vertices + offset).astype(np.float32).ravel()
        values["faces"] = faces.ravel()
        values.update()
        mesh.recompute_vertex_normals()
        return mesh

    def look(self, pixels: npt.NDArray[np.float64]) -> Samples:
        """Return what camera rays through pixels (N, 2) find."""
        matrix = self.geometry.camera.matrix
        rays = np.empty((len(pixels), 3))
        rays[:, 0] = (pixels[:, 0] - matrix[0, 2]) / matrix[0, 0]
        rays[:, 1] = (pixels[:, 1] - matrix[1, 2]) / matrix[1, 1]
        rays[:, 2] = 1.0
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        parts = [
            self.follow(np.zeros_like(rays[start : start + _RAYS]), rays[start : start + _RAYS])[0]
            for start in range(0, len(rays), _RAYS)
        ]
        return Samples(*(np.concatenate([getattr(part, name) for part in parts]) for name in Samples.__annotations__))

    def follow(
        self, origins: npt.NDArray[np.float64], directions: npt.NDArray[np.float64]
    ) -> tuple[Samples, npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return what rays (N, 3) find, the places (N, 3) mm, and the normals there, turned towards the rays."""
        mi = self._mi
        hit = self._world.ray_intersect(mi.Ray3f(self._point(origins), mi.Vector3f(self._point(directions))))
        found = np.array(hit.is_valid())
        # In double precision from here: float32 would round rows, not distances, by too much.
        places = origins + directions * np.where(found, np.array(hit.t), 0)[:, None].astype(np.float64)
        normals = np.array(hit.sh_frame.n).T.astype(np.float64)
        normals *= -np.sign((normals * directions).sum(axis=1, keepdims=True))
        outward = np.array(hit.n).T.astype(np.float64)
        outward *= -np.sign((outward * directions).sum(axis=1, keepdims=True))
        # A millimetre's thousandth above the surface, where a shadow's ray does not meet the surface itself.
        above = places + 1e-3 * outward
        to_light = self.projector - above
        reach = np.linalg.norm(to_light, axis=1)
        ray = mi.Ray3f(self._point(above), mi.Vector3f(self._point(to_light / reach[:, None])))
        ray.maxt = mi.Float(reach.astype(np.float32))
        shadowed = np.array(self._world.ray_test(ray))
        paint, body, surface = self._painted(hit, found, places)
        return (
            self._lit(places, normals, outward, directions, found & ~shadowed, paint, body, surface),
            places,
            normals,
        )

    def _lit(self, places, normals, outward, directions, seen, paint, body, surface) -> Samples:
        """Return samples, with what of the projector's light arrives."""
        geometry = self.geometry
        at = places @ geometry.rotation.T + geometry.translation_mm
        with np.errstate(divide="ignore", invalid="ignore"):
            pixels = at[:, :2] / at[:, 2:] @ geometry.projector.matrix[:2, :2].T + geometry.projector.matrix[:2, 2]
        width, height = geometry.projector.size_px
        inside = (at[:, 2] > 0) & (np.abs(pixels[:, 0] - (width - 1) / 2) < width / 2)
        inside &= np.abs(pixels[:, 1] - (height - 1) / 2) < height / 2
        to_light = self.projector - places
        reach = np.linalg.norm(to_light, axis=1)
        to_light /= reach[:, None]
        cosine = (normals * to_light).sum(axis=1)
        inside &= seen & ((outward * to_light).sum(axis=1) > 0)
        diffuse = np.where(inside, np.clip(cosine, 0, None) * (_REFERENCE_MM / reach) ** 2, 0)
        glossy = np.zeros(len(places))
        for number, shiny in enumerate(self.scene.bodies):
            if shiny.gloss:
                on = body == number
                glossy[on] = diffuse[on] * _highlight(shiny, normals[on], to_light[on], -directions[on])
        return Samples(
            row=pixels[:, 1].astype(np.float32),
            depth=np.where(body == NOTHING, np.nan, places[:, 2]).astype(np.float32),
            distance=at[:, 2].astype(np.float32),
            diffuse=diffuse.astype(np.float32),
            glossy=glossy.astype(np.float32),
            paint=paint,
            body=body,
            surface=surface,
        )

    def _painted(self, hit: Any, found: npt.NDArray[np.bool_], places: npt.NDArray[np.float64]) -> tuple[U8, U8, U8]:
        """Return the numbers of paint, body and surface."""
        paint, number, surface = (np.full(len(places), NOTHING, np.uint8) for _ in range(3))
        first_paint = first_surface = 0
        for k, body in enumerate(self.scene.bodies):
            on = found & np.array(hit.shape == self._pointers[f"body{k}"])
            at_rest = places[on] - (self._offset if body.moves else 0)
            which = np.zeros(len(at_rest), np.uint8) if body.painter is None else body.painter(at_rest)
            paint[on], number[on] = first_paint + which, k
            surface[on] = first_surface + (which if body.surfaces else 0)
            first_paint += len(body.paints)
            first_surface += len(body.surfaces or (body.name,))
        return paint, number, surface

    def _point(self, values: npt.NDArray[np.floating]) -> Any:
        mi = self._mi
        return mi.Point3f(*(mi.Float(np.ascontiguousarray(column, np.float32)) for column in values.T))


def _highlight(body: Body, normals, to_light, to_camera) -> npt.NDArray[np.float64]:
    """Return what a clear coat mirrors, over what white paint would send back (Blinn 1977, doi:10.1145/563858.563893).

    The lobe is normalised to (n + 8) / (8 pi); what is mirrored rises towards grazing by Schlick's formula.
    """
    half = to_light + to_camera
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    lobe = np.clip((normals * half).sum(axis=1), 0, None) ** body.shininess
    fresnel = body.gloss + (1 - body.gloss) * (1 - np.clip((to_light * half).sum(axis=1), 0, 1)) ** 5
    return lobe * fresnel * (body.shininess + 8) / 8
