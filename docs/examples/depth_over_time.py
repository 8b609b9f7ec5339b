"""
Depth over time
===============

A folder of pictures becomes a dataset of depth with the time of each frame, and a curve. It needs the extra ``xarray``.
"""

from pathlib import Path

import cv2
import numpy as np
import xarray
from matplotlib.figure import Figure

import colorphase

# %%
# The pictures show a sheet that moves away by 2 mm from frame to frame. Omit this step with pictures of yours.

folder = Path("pictures")
folder.mkdir(exist_ok=True)
rig = colorphase.simulated_rig((320, 240), period_px=35, code="contrast")
for k in range(6):
    simulation = colorphase.SimulationSettings(scene="plane", object_motion_mm=(0.0, 0.0, 2.0 * k), seed=k)
    image = np.asarray(colorphase.simulate_frame(rig, simulation).image, np.uint8)
    cv2.imwrite(str(folder / f"{k:03d}.png"), image[..., ::-1])  # OpenCV writes blue first

# %%
# Frames are decoded in order, each with the one before it, and joined by their number.

decoder = colorphase.Decoder(colorphase.DecodeSettings(transfer="linear"), rig, arch="cpu")
with colorphase.open_footage(folder) as footage:
    frames = [frame.to_xarray()[["range_image", "mask"]] for frame in decoder.decode_all(footage)]
film = xarray.concat(frames, "frame")
depth = film.range_image.where(film.mask).median(("y", "x"))
step = float(np.polyfit(film.frame, depth, 1)[0])
print(f"{film.sizes['frame']} frames: from {depth[0]:.1f} mm, {step:.2f} mm farther from frame to frame")

figure = Figure(layout="compressed")
depth.plot(ax=figure.subplots(), marker="o")
figure.savefig("depth.png")
