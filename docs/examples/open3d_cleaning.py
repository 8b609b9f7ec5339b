"""
Points in Open3D
================

Open3D (``pip install open3d``, or ``open3d-cpu``) thins the points of a frame, removes outliers, and finds the wall
behind the object.
"""

import numpy as np
import open3d
from matplotlib.figure import Figure

import colorphase

rig, scene = colorphase.simulated_rig(code="contrast"), colorphase.SimulationSettings(scene="ball")
calibration = rig.replace(crosstalk_matrix=scene.crosstalk_matrix)
frame = colorphase.Decoder(calibration=calibration, arch="cpu").decode(colorphase.simulate_frame(rig, scene).image)
mesh = colorphase.frame_mesh(frame)
points = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(mesh.vertices.astype(np.float64)))  # mm
points.normals = open3d.utility.Vector3dVector(mesh.normals.astype(np.float64))
points.colors = open3d.utility.Vector3dVector(mesh.colors / 255)

# %%
# Lengths are in mm.

thin = points.voxel_down_sample(2.0)
clean, _ = thin.remove_statistical_outlier(nb_neighbors=20, std_ratio=3.0)
(a, b, c, d), on_wall = clean.segment_plane(distance_threshold=2.0, ransac_n=3, num_iterations=500)
distance = abs(d) / np.linalg.norm((a, b, c))
print(f"{len(points.points)} points, {len(clean.points)} after cleaning; the wall is {distance:.1f} mm away")

# %%
# What is not on the wall is the ball.

ball = clean.select_by_index(on_wall, invert=True)
open3d.io.write_point_cloud("ball.ply", ball)
print(f"ball.ply: {len(ball.points)} points, the nearest at {np.asarray(ball.points)[:, 2].min():.1f} mm")

figure = Figure(layout="compressed")
axes = figure.add_subplot(projection="3d")
x, y, z = np.asarray(ball.points).T
axes.scatter(x, z, -y, c=z, s=1)
axes.set(xlabel="x, mm", ylabel="z, mm", zlabel="up, mm", aspect="equal")
figure.savefig("ball.png")
