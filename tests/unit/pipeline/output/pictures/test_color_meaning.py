"""What colours show."""

import numpy as np
import pytest
from support.drawn_surfaces import dome, walled

from pipeline.errors import RenderError
from pipeline.output.mesh import Mesh
from pipeline.output.pictures.color_meaning import SurfaceColors
from pipeline.output.pictures.viewpoint import CLAY


def test_clay_and_texture_have_no_scale():
    clay, texture = (SurfaceColors([dome()], colors) for colors in ("clay", "texture"))
    assert clay.scale is None and clay.of(dome()).tolist() == CLAY.tolist()
    np.testing.assert_array_equal(texture.of(dome()), dome().colors)


def test_depth_has_the_limits_of_all_samples_without_the_wall():
    scale = SurfaceColors([walled(dome(at_mm=at)) for at in (400.0, 420.0)], "depth").scale
    assert scale is not None and (scale.name, scale.unit) == ("depth", "mm")
    assert 349 < scale.low < 353 and 418 < scale.high < 422
    assert scale.grey_beyond
    alone = SurfaceColors([dome()], "depth").scale
    assert alone is not None and not alone.grey_beyond


def test_sigma_begins_at_zero_and_a_sphere_fits_itself():
    sigma = SurfaceColors([dome(sigma_mm=0.1)], "sigma").scale
    assert sigma is not None and sigma.low == 0 and sigma.high == pytest.approx(0.1)
    sphere = SurfaceColors([walled(dome())], "sphere").scale
    assert sphere is not None and sphere.diverging and sphere.high < 1e-3
    plane = SurfaceColors([walled(dome())], "plane").scale
    assert plane is not None and plane.high == pytest.approx(250, abs=3), "the dome stands out of the wall"


def test_a_distance_wins():
    colors = SurfaceColors([dome()], "clay", lambda points: points[:, 0])
    assert colors.scale is not None and (colors.scale.name, colors.scale.unit) == ("deviation", "mm")
    painted = colors.of(dome()).astype(int)
    assert (painted[dome().vertices[:, 0] > 20, 0] > painted[dome().vertices[:, 0] > 20, 2]).all()


@pytest.mark.parametrize(
    ("mesh", "colors", "said"),
    [
        (dome(), "modulation", "the mesh holds no modulation"),
        (dome(colors=False), "texture", "has no colours"),
        (dome("rad"), "plane", "decode with a calibration"),
        (Mesh(dome().vertices[:2], np.empty((0, 3), np.int32)), "plane", "cannot be fitted to 2 points"),
    ],
)
def test_what_cannot_be_shown(mesh, colors, said):
    with pytest.raises(RenderError, match=said):
        SurfaceColors([mesh], colors)
