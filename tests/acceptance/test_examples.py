"""The examples of the documentation run as they stand."""

import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.missing import import_but_fail_in_ci

EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"


def printed(name: str, folder: Path, **environment: str) -> str:
    """Run an example as a user does, in a folder of its own, and return what it prints."""
    program = [sys.executable, EXAMPLES / name]
    done = subprocess.run(
        program, cwd=folder, capture_output=True, text=True, timeout=240, check=False, env={**os.environ, **environment}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_example_has_a_test():
    tested = set(re.findall(r'printed\("(\w+\.py)"', Path(__file__).read_text(encoding="utf-8")))
    assert tested == {path.name for path in EXAMPLES.glob("*.py")}


def test_the_chain_of_2004_measures_a_bust(tmp_path):
    """0.05 rad are 0.36 mm on this rig; a plain arctangent leaves 0.3 rad."""
    said = printed("paper_chain.py", tmp_path)
    found = re.search(r"([\d.]+)% of the lit pixels, phase error ([\d.]+) rad RMS", said)
    assert found is not None, said
    assert float(found[1]) > 95
    assert float(found[2]) < 0.05


def test_scikit_image_unwraps_as_the_decoder_does(tmp_path):
    """Waves of one region: the same orders at every pixel of a frame of 640x480."""
    import_but_fail_in_ci("skimage")
    said = printed("own_unwrapper.py", tmp_path)
    found = re.fullmatch(r"(\d+) pixels in both, 0 with different orders\n", said)
    assert found is not None, said
    assert int(found[1]) > 250_000


def test_a_frame_becomes_a_mesh(tmp_path):
    """A ball in front of a wall, 900 mm away, one pixel a point."""
    said = printed("frame_to_mesh.py", tmp_path)
    found = re.search(r"mesh\.ply: (\d+) points between (\d+) and (\d+) mm, (\d+) triangles", said)
    assert found is not None, said
    points, near, far, triangles = map(int, found.groups())
    assert 700 < near < 900 < far < 1100
    assert 1.8 * points < triangles < 2 * points
    assert (tmp_path / "mesh.ply").stat().st_size > 12 * points


def test_sigma_describes_the_errors(tmp_path):
    """68 % and 95 % in a normal distribution; sigma is a little too wide in smooth surfaces."""
    said = printed("how_sure.py", tmp_path)
    found = re.search(r"(\d+)% of the errors within one sigma, (\d+)% within two", said)
    assert found is not None, said
    assert 65 < int(found[1]) < 85 and int(found[2]) > 93


def test_a_plate_is_flat(tmp_path):
    """Noise below 0.15 mm, and below 0.05 mm in averages of 15x15 pixels."""
    said = printed("flatness.py", tmp_path)
    found = re.search(r"points, ([\d.]+) mm RMS from the plane\n([\d.]+) mm RMS of the averages", said)
    assert found is not None, said
    assert 0.01 < float(found[1]) < 0.15 and float(found[2]) < 0.05


def test_a_folder_becomes_depth_over_time(tmp_path):
    """A sheet that moves away by 2 mm a picture."""
    said = printed("depth_over_time.py", tmp_path)
    found = re.fullmatch(r"6 frames: from ([\d.]+) mm, ([\d.]+) mm farther from frame to frame\n", said)
    assert found is not None, said
    assert abs(float(found[1]) - 900) < 0.5 and abs(float(found[2]) - 2) < 0.02
    assert cv2.imread(str(tmp_path / "depth.png")) is not None


def test_open3d_cleans_a_frame(tmp_path):
    """The ball's nearest point is 795.0 mm away, the plane of the wall 982.6 mm."""
    open3d = import_but_fail_in_ci("open3d")
    said = printed("open3d_cleaning.py", tmp_path)
    found = re.search(r"the wall is ([\d.]+) mm away\nball\.ply: (\d+) points, the nearest at ([\d.]+) mm", said)
    assert found is not None, said
    assert abs(float(found[1]) - 982.6) < 1 and abs(float(found[3]) - 795.0) < 1.5
    assert len(open3d.io.read_point_cloud(str(tmp_path / "ball.ply")).points) == int(found[2]) > 5000


@pytest.mark.skipif(os.name == "nt", reason="the stand-in for gphoto2 is a shell script")
def test_a_dslr_is_a_camera(tmp_path):
    """A stand-in for gphoto2 that notes how it is called, and sends a JPEG."""
    cv2.imwrite(str(tmp_path / "grey.jpg"), np.full((48, 64, 3), 90, np.uint8))
    stand_in = tmp_path / "gphoto2"
    stand_in.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\ncat {tmp_path}/grey.jpg\n')
    stand_in.chmod(0o755)
    said = printed("dslr_camera.py", tmp_path, PATH=f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    assert said == "64x48 px, 90 of 255 levels in the mean\n"
    call = "--set-config shutterspeed=1/60 --set-config iso=100 --capture-image-and-download --stdout"
    assert (tmp_path / "calls").read_text().splitlines() == [call, call]
