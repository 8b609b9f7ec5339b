"""A frame in Open3D: points with colours and normals, thinned out, without outliers, and the wall behind found.

python docs/examples/open3d_cleaning.py

It needs `pip install open3d`, or open3d-cpu. The frame is a simulated one, of a ball before a wall.
"""

import numpy as np
import open3d

import colorphase


def point_cloud(mesh: colorphase.Mesh) -> open3d.geometry.PointCloud:
    """Return the vertices of a mesh, mm in the camera's frame, as Open3D's points."""
    points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)))
    points.normals = open3d.utility.Vector3dVector(mesh.normals.astype(np.float64))
    points.colors = open3d.utility.Vector3dVector(mesh.colors / 255)
    return points


def main() -> None:
    """Decode a frame, clean its points, and write what stands before the wall into `ball.ply`."""
    rig, scene = colorphase.simulated_rig(code="contrast"), colorphase.SimulationSettings(scene="ball")
    calibration = rig.model_copy(update={"crosstalk_matrix": scene.crosstalk_matrix})
    frame = colorphase.Decoder(calibration=calibration, arch="cpu").decode(colorphase.simulate_frame(rig, scene).image)
    points = point_cloud(colorphase.frame_mesh(frame))
    thin = points.voxel_down_sample(2.0)  # mm
    clean, _ = thin.remove_statistical_outlier(nb_neighbors=20, std_ratio=3.0)
    (a, b, c, d), on_wall = clean.segment_plane(distance_threshold=2.0, ransac_n=3, num_iterations=500)
    ball = clean.select_by_index(on_wall, invert=True)
    open3d.io.write_point_cloud("ball.ply", ball)
    distance = abs(d) / np.linalg.norm((a, b, c))
    print(f"{len(points.points)} points, {len(clean.points)} after cleaning; the wall is {distance:.1f} mm away")
    print(f"ball.ply: {len(ball.points)} points, the nearest at {np.asarray(ball.points)[:, 2].min():.1f} mm")


if __name__ == "__main__":
    main()
