"""What files say of how they were made."""

import json

from pipeline.output.mesh import provenance_of

ATTRIBUTES = {
    "colorphase_version": "1.2",
    "settings": {"stripes": "vertical", "code": None},
    "calibration_sha256": "ab",
}


def test_a_frame_of_footage():
    said = provenance_of({**ATTRIBUTES, "footage": {"name": "film.mkv"}}, 12, 0.5)
    assert json.loads(said.pop("settings")) == {"stripes": "vertical"}
    assert said == {
        "software": "colorphase 1.2",
        "source": "film.mkv",
        "frame": "12",
        "time_s": "0.500000",
        "calibration_sha256": "ab",
    }


def test_a_picture_without_a_calibration():
    said = provenance_of({**ATTRIBUTES, "source": "a\nb.png", "calibration_sha256": None})
    assert said.keys() == {"software", "source", "settings"}
    assert said["source"] == "a b.png"  # one line each: it becomes a comment
