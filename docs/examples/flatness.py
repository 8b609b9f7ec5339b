"""
The flatness of a plate
=======================

A plane is fitted to a plate that was measured. Its residuals separate noise, which differs from pixel to pixel, from
the slow waves that a wrong calibration leaves.
"""

import cv2
import numpy as np
from matplotlib.figure import Figure

import colorphase

rig, scene = colorphase.simulated_rig(code="contrast"), colorphase.SimulationSettings(scene="plane")
calibration = rig.replace(crosstalk_matrix=scene.crosstalk_matrix)
frame = colorphase.Decoder(calibration=calibration, arch="cpu").decode(colorphase.simulate_frame(rig, scene).image)

points = frame.points[frame.mask].astype(np.float64)
centre = points.mean(axis=0)
normal = np.linalg.svd(np.cov((points - centre).T))[2][2]
normal *= -np.sign(normal[2])  # towards the camera
height = (frame.points - centre) @ normal  # mm, (H, W)
print(f"{len(points)} points, {np.nanstd(height):.3f} mm RMS from the plane")

# %%
# Averages over 15x15 pixels show what noise does not explain.

weight = cv2.blur(frame.mask.astype(np.float64), (15, 15))
slow = np.where(frame.mask, cv2.blur(np.where(frame.mask, height, 0), (15, 15)) / np.maximum(weight, 1e-6), np.nan)
print(f"{np.nanstd(slow):.3f} mm RMS of the averages, {np.nanmax(np.abs(slow)):.3f} mm at most")

figure = Figure(figsize=(10, 4), layout="compressed")
for axes, values, title in zip(
    figure.subplots(1, 2), (height, slow), ("each pixel", "averages of 15x15 pixels"), strict=True
):
    limit = np.nanpercentile(np.abs(values), 99)
    image = axes.imshow(values, cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes.set(title=title, xticks=[], yticks=[])
    figure.colorbar(image, ax=axes, label="mm in front of the plane")
figure.savefig("flatness.png")
