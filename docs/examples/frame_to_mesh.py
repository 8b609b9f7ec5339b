"""
A frame becomes a mesh
======================

One colour frame becomes a surface in millimetres. For a picture of yours, read it with ``colorphase.read_image`` and
its rig with ``colorphase.Calibration.read``.
"""

import numpy as np
import pyvista

import colorphase

rig, scene = colorphase.simulated_rig(), colorphase.SimulationSettings(scene="ball")
calibration = rig.replace(crosstalk_matrix=scene.crosstalk_matrix)
decoder = colorphase.Decoder(calibration=calibration, arch="cpu")
frame = decoder.decode(colorphase.simulate_frame(rig, scene).image)
near, far = np.nanpercentile(frame.range_image, (1, 99))
print(f"phase sigma {np.nanmedian(frame.phase_sigma):.4f} rad, depth sigma {np.nanmedian(frame.point_sigma):.3f} mm")
frame.plot().savefig("range.png")

# %%
# Each pixel is a vertex. Triangles connect neighbours of one region, so the ball does not hang on the wall.

mesh = colorphase.frame_mesh(frame)
colorphase.write_mesh(mesh, "mesh.ply")
print(f"mesh.ply: {len(mesh.vertices)} points between {near:.0f} and {far:.0f} mm, {len(mesh.faces)} triangles")

# %%
# PyVista draws it without a screen.

plotter = pyvista.Plotter(off_screen=True, window_size=(800, 600))
plotter.add_mesh(frame.to_pyvista(), color="lightgrey", smooth_shading=True)
plotter.camera_position = [(-400, -250, 100), (0, 0, 900), (0, -1, 0)]  # eye, target, up; mm in the camera's frame
plotter.screenshot("mesh.png")
plotter.close()
