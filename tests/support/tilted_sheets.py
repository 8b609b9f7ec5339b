"""A sheet that tells top from bottom, near from far and left from right: red above and nearer, blue below, a hole."""

import numpy as np

from pipeline.calibration.lens import Lens
from pipeline.output.mesh import Mesh, RangeGrid
from pipeline.output.surface_mesh import MeshOptions, surface_mesh

HEIGHT, WIDTH = 24, 32
RED, BLUE = (200, 30, 20), (10, 40, 220)
PROVENANCE = {
    "software": "colorphase 1.2.3",
    "source": "film of Mädchen.mkv".encode("ascii", "replace").decode(),
    "frame": "7",
    "time_s": "0.250000",
    "calibration_sha256": "ab" * 32,
    "settings": '{"stripes": "horizontal"}',
}


def tilted_grid() -> RangeGrid:
    """Return the sheet in the camera's grid: 2 mm a pixel, 500 mm away above, 546 mm below."""
    y, x = np.indices((HEIGHT, WIDTH), np.float32)
    points = np.stack([2 * (x - 4), 2 * (y - 10), 500 + 2 * y], axis=-1).astype(np.float32)
    points[-6:, -8:] = np.nan
    texture = np.where((y < HEIGHT / 2)[..., None], RED, BLUE).astype(np.uint8)
    sigma = np.where(np.isfinite(points[..., 2]), np.float32(0.1), np.float32(np.nan))
    lens = Lens(size_px=(WIDTH, HEIGHT), matrix=np.array([[250.0, 0, 4], [0, 250, 10], [0, 0, 1]]))
    return RangeGrid(points, texture, {"sigma_mm": sigma}, lens, 0.25, PROVENANCE)


def tilted_mesh() -> Mesh:
    """Return the sheet as a mesh, a vertex a pixel; kernels must have been started."""
    grid = tilted_grid()
    mask = np.isfinite(grid.depth)
    properties = {"sigma_mm": grid.properties["sigma_mm"][mask], "order_error_probability": np.zeros(mask.sum(), "f4")}
    options = MeshOptions(smoothed=False)
    mesh, _ = surface_mesh(grid.depth, mask, grid.points, properties, options=options, texture=grid.texture)
    mesh.provenance.update(PROVENANCE)
    return mesh
