"""Bags, read back by rosbags."""

import builtins
from dataclasses import replace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from support.tilted_sheets import HEIGHT, WIDTH, tilted_grid

from pipeline.errors import OutputError
from pipeline.output.formats.ros_bag import FRAME_ID, write_bag


@pytest.fixture
def messages(tmp_path):
    """Write two frames, and return the messages of each topic with their times, ns."""
    later = replace(tilted_grid(), time_s=1_700_000_000.5, points=tilted_grid().points + np.float32(1))
    write_bag(tmp_path / "bag", iter([tilted_grid(), later]), {"software": "colorphase 1"})
    found = {}
    with AnyReader([tmp_path / "bag"]) as reader:
        for connection, time_ns, data in reader.messages():
            found.setdefault(connection.topic, []).append((time_ns, reader.deserialize(data, connection.msgtype)))
    return found


def test_every_frame_has_its_messages_at_its_time(messages, tmp_path):
    assert messages.keys() == {f"/camera/{name}" for name in ("points", "depth", "image", "camera_info")}
    for topic in messages.values():
        assert [time_ns for time_ns, _ in topic] == [250_000_000, 1_700_000_000_500_000_000]
        for time_ns, message in topic:
            assert message.header.frame_id == FRAME_ID
            assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == time_ns
    assert sorted(path.name for path in (tmp_path / "bag").iterdir()) == ["bag.mcap", "metadata.yaml"]
    assert "software: colorphase 1" in (tmp_path / "bag" / "metadata.yaml").read_text()


def test_points_are_organised_in_metres(messages):
    grid, (_, cloud) = tilted_grid(), messages["/camera/points"][0]
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (HEIGHT, WIDTH, 20, 20 * WIDTH)
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb", "sigma_mm"]
    assert [(field.offset, field.datatype, field.count) for field in cloud.fields] == [(4 * i, 7, 1) for i in range(5)]
    values = cloud.data.view("<f4").reshape(HEIGHT, WIDTH, 5)
    np.testing.assert_allclose(values[..., :3], grid.points / 1000, rtol=1e-6)
    packed = np.ascontiguousarray(values[..., 3]).view(np.uint32)
    np.testing.assert_array_equal(packed >> 16, grid.texture[..., 0])
    np.testing.assert_array_equal(packed & 255, grid.texture[..., 2])
    assert not cloud.is_dense and not cloud.is_bigendian


def test_pictures_and_their_camera(messages):
    grid = tilted_grid()
    (_, image), (_, depth), (_, camera) = (messages[f"/camera/{name}"][0] for name in ("image", "depth", "camera_info"))
    assert (image.encoding, image.step, depth.encoding, depth.step) == ("rgb8", 3 * WIDTH, "32FC1", 4 * WIDTH)
    np.testing.assert_array_equal(image.data.reshape(HEIGHT, WIDTH, 3), grid.texture)
    np.testing.assert_allclose(depth.data.view("<f4").reshape(HEIGHT, WIDTH), grid.depth / 1000, rtol=1e-6)
    assert (camera.width, camera.height, camera.distortion_model) == (WIDTH, HEIGHT, "plumb_bob")
    np.testing.assert_array_equal(camera.k.reshape(3, 3), grid.camera.matrix)
    np.testing.assert_array_equal(camera.p.reshape(3, 4)[:, :3], grid.camera.matrix)
    # A point lands on the pixel that saw it.
    x, y, z = grid.points[3, 5]
    np.testing.assert_allclose((camera.k.reshape(3, 3) @ (x / z, y / z, 1))[:2], (5, 3), atol=1.1)


def test_without_the_package_it_says_what_to_install(tmp_path, monkeypatch):
    whole = builtins.__import__

    def lacking(name, *more):
        if name.startswith("rosbags"):
            raise ImportError(name)
        return whole(name, *more)

    monkeypatch.setattr(builtins, "__import__", lacking)
    with pytest.raises(OutputError, match=r"pip install 'colorphase\[mcap\]'"):
        write_bag(tmp_path / "bag", [], {})
