"""The renderer itself, in a process of its own, which may die."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from support.drawn_surfaces import require_drawing

_PROGRAM = """
import json, sys
import numpy as np
from pipeline.output.pictures.scene import BLACK, GROUND, SurfaceRenderer
from pipeline.output.pictures.viewpoint import Viewpoint
eye = Viewpoint(position=(0, 0, 0), focal_point=(0, 0, 100))
square = np.array([[-5, -5, 100], [5, -5, 100], [5, 5, 100], [-5, 5, 100]], np.float32)
faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
told = {}
for samples in (1, 2):
    renderer = SurfaceRenderer((80, 60), samples, ground=GROUND if samples == 2 else BLACK)
    renderer.show(square, faces)
    renderer.paint(np.full((4, 3), (200.0, 100.0, 50.0), np.float32))
    image = renderer.image(eye)
    told[samples] = [image.shape, image[30, 40].tolist(), image[0, 0].tolist()]
depth = renderer.depth(eye)
told["ground"] = renderer.ground()[30, 40].tolist()
told["depth"] = float(depth[60, 80])
told["name"] = renderer.name()
print(json.dumps(told))
"""


def test_colours_are_exact_and_edges_smooth(tmp_path: Path) -> None:
    require_drawing(tmp_path)
    done = subprocess.run([sys.executable, "-c", _PROGRAM], capture_output=True, text=True, check=True)
    told = json.loads(done.stdout.splitlines()[-1])
    for samples in ("1", "2"):
        shape, middle, corner = told[samples]
        assert shape == [60, 80, 3] and middle == pytest.approx([200, 100, 50], abs=1)
        assert corner == [0, 0, 0] if samples == "1" else corner[2] > corner[0] > 20
    assert told["depth"] == pytest.approx(100, abs=0.1)
    assert max(told["ground"]) < 80, "nothing is left of the surface"
    assert told["name"].endswith((", EGL", ", OSMesa", ", GLX"))
