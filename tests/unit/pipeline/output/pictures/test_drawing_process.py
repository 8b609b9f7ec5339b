"""What the process that draws is told."""

import pytest

from pipeline.errors import SettingsError
from pipeline.output.pictures.drawing_process import FilmPart, PictureJob, PictureOptions
from pipeline.output.pictures.viewpoint import Viewpoint


def test_a_job_survives_its_file():
    options = PictureOptions(camera=Viewpoint(position=(0, 0, -1), focal_point=(0, 0, 1)), turn_deg=20)
    job = PictureJob(options=options, store="r.zarr", numbers=(3, 4), parts=(FilmPart(first=0, stop=2, path="a.mp4"),))
    assert PictureJob.model_validate_json(job.model_dump_json()) == job


def test_whether_the_eye_moves():
    assert not PictureOptions().moves
    assert PictureOptions(sway_deg=1).moves


@pytest.mark.parametrize("wrong", [{"view": "above"}, {"colors": "shaded"}, {"fps": 0}, {"size_px": (8, 8)}, {"x": 1}])
def test_options_are_checked(wrong):
    with pytest.raises(SettingsError):
        PictureOptions(**wrong)


def test_a_job_has_one_subject():
    for subjects in ({}, {"mesh": "m.ply", "store": "r.zarr"}):
        with pytest.raises(SettingsError, match="give a mesh or a store"):
            PictureJob(options=PictureOptions(), numbers=(0,), **subjects)
