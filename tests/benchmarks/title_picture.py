"""Draw README's picture from the demo: one simulated frame, the depth measured from it, and its surface.

python tests/benchmarks/title_picture.py
"""

import argparse
import tempfile
from pathlib import Path

import _tests_path  # noqa: F401 - puts `support` on the path
import cv2
import numpy as np
from support.picture_sheet import enlarged, write_sheet

from pipeline.batch.one_frame import decode_simulated
from pipeline.output.pictures.drawing_process import PictureOptions
from pipeline.output.pictures.picture_overlay import ColorScale
from pipeline.output.pictures.viewpoint import Viewpoint
from pipeline.output.range_image import depth_colors, with_color_bar
from pipeline.output.render import render_mesh
from pipeline.output.stored_result import StoredResult
from pipeline.output.surface_mesh import MeshOptions, frame_mesh

_PATH = Path(__file__).resolve().parents[2] / "docs" / "demo.jpg"
_HEIGHT_PX, _SURFACE_PX = 640, 680
# From the upper left, as little as relief needs: what the camera has not seen is not there.
_EYE = Viewpoint(position=(-215.0, -110.0, 0.0), focal_point=(0.0, 22.0, 850.0))
# Rows and columns of the frame that are shown: the head and its shoulders.
_PART = np.s_[0:480, 115:515]


def main() -> None:
    """Decode, draw, and write the picture."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "demo")
        decode_simulated(out, "cpu", force=False, notify=print)
        frame = StoredResult(out / "result.zarr")[0]
        surface = frame_mesh(frame, MeshOptions(without_background=True))
        render_mesh(surface, out / "surface.png", PictureOptions(size_px=(_SURFACE_PX, _HEIGHT_PX), camera=_EYE))
        photograph, drawn = (cv2.imread(str(out / name))[..., ::-1] for name in ("frame.png", "surface.png"))
    depth = np.full(frame.mask.shape, np.nan, np.float32)
    column, row = np.rint(surface.pixels).astype(int).T
    depth[row, column] = surface.vertices[:, 2]
    scale = ColorScale.over(surface.vertices[:, 2], "", "mm")
    colors = depth_colors(depth, np.isfinite(depth), scale)[_PART]
    colors = with_color_bar(enlarged(colors, _HEIGHT_PX), scale)
    panels = [
        ("one colour photograph", enlarged(photograph[_PART], _HEIGHT_PX)),
        ("its depth", colors),
        ("its surface", drawn),
    ]
    write_sheet(_PATH, panels, 3)


if __name__ == "__main__":
    main()
