"""A folder of pictures becomes depth over time, with labels, and a figure of it.

python docs/examples/depth_over_time.py

It needs the extra `xarray`. The pictures are simulated: a sheet that moves away by 2 mm from one to the next. With your
own, leave `take_pictures` out and read the calibration from calibration.json.
"""

from pathlib import Path

import cv2
import matplotlib.figure
import numpy as np
import xarray

import colorphase


def take_pictures(folder: Path) -> colorphase.Calibration:
    """Write six pictures into a folder, and return the calibration of the rig that took them."""
    folder.mkdir(exist_ok=True)
    rig = colorphase.simulated_rig((320, 240), period_px=35, code="contrast")
    for k in range(6):
        simulation = colorphase.SimulationSettings(scene="plane", object_motion_mm=(0.0, 0.0, 2.0 * k), seed=k)
        image = np.asarray(colorphase.simulate_frame(rig, simulation).image, np.uint8)
        cv2.imwrite(str(folder / f"{k:03d}.png"), image[..., ::-1])  # OpenCV writes blue first
    return rig


def main() -> None:
    """Decode the folder frame by frame, keep the depth of each, and draw its median over time."""
    calibration = take_pictures(Path("pictures"))
    decoder = colorphase.Decoder(colorphase.DecodeSettings(transfer="linear"), calibration, arch="cpu")
    with colorphase.open_footage("pictures") as footage:
        frames = [frame.to_xarray()[["range_image", "mask"]] for frame in decoder.decode_all(footage)]
    film = xarray.concat(frames, "frame")
    depth = film.range_image.where(film.mask).median(("y", "x"))
    figure = matplotlib.figure.Figure()
    depth.plot(ax=figure.subplots(), marker="o")
    figure.savefig("depth.png")
    step = float(np.polyfit(film.frame, depth, 1)[0])
    print(f"{film.sizes['frame']} frames: from {depth[0]:.1f} mm, {step:.2f} mm farther from frame to frame")


if __name__ == "__main__":
    main()
