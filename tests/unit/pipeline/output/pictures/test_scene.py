"""What the pictures of a film share; drawn they are in test_render.py and test_film.py."""

import numpy as np
import pytest
from support.drawn_surfaces import dome

from pipeline.errors import RenderError
from pipeline.output.mesh import Mesh
from pipeline.output.pictures.drawing_process import PictureOptions
from pipeline.output.pictures.scene import Scene
from pipeline.output.pictures.viewpoint import FIELD_OF_VIEW_DEG, CameraPath, Keyframe, Viewpoint

HALF = np.tan(np.radians(FIELD_OF_VIEW_DEG / 2))


@pytest.mark.parametrize("motion", [{"turn_deg": 360.0}, {"sway_deg": 70.0}, {"turn_deg": -90.0, "view": "top"}])
def test_all_stays_in_the_picture_on_the_eyes_way(motion):
    options = PictureOptions(size_px=(400, 300), **motion)
    scene = Scene([dome()], options)
    reach = []
    for part in np.linspace(0, 1, 25):
        eye = scene.viewpoint(part)
        right, down, _ = eye.axes() @ (dome().vertices - np.array(eye.position)).T
        depth = eye.depth_of(dome().vertices)
        reach.append(max(abs(right / depth).max() / (HALF * 4 / 3), abs(down / depth).max() / HALF))
    assert max(reach) < 1.0
    assert max(reach) > 0.75, "it is not far away either"


def test_a_full_turn_ends_where_it_began():
    scene = Scene([dome()], PictureOptions(turn_deg=360))
    assert scene.viewpoint(1.0).position == pytest.approx(scene.viewpoint(0.0).position)
    assert scene.viewpoint(0.25).position[0] < scene.viewpoint(0.0).position[0]


def test_cameras_by_numbers_and_along_a_path():
    eye = Viewpoint(position=(0, 0, -100), focal_point=(0, 0, 400))
    assert Scene([dome()], PictureOptions(camera=eye)).viewpoint(0.5) == eye
    moving = Scene([dome()], PictureOptions(camera=eye, turn_deg=180))
    assert moving.viewpoint(1.0).position == pytest.approx((0, 0, 900))
    keys = [Keyframe(at=at, position=(100 * at, 0, 0), focal_point=(0, 0, 400)) for at in (0, 1)]
    path = CameraPath(keyframes=tuple(keys))
    assert Scene([dome()], PictureOptions(path=path)).viewpoint(0.5).position == pytest.approx((50, 0, 0))


def test_a_surface_in_rad_has_no_camera_in_mm_and_shows_relief():
    flat = Mesh(dome().vertices * np.array([1, 1, 0.01], np.float32), dome().faces, unit="rad")
    scene = Scene([flat], PictureOptions(view="left"))
    steep = scene.viewpoint(0.0)
    assert np.subtract(steep.focal_point, steep.position)[0] > 100, "the depth is scaled to be seen"
    with pytest.raises(RenderError, match="a camera in mm needs a surface in mm"):
        Scene([flat], PictureOptions(camera=Viewpoint(position=(0, 0, 0), focal_point=(0, 0, 1))))
