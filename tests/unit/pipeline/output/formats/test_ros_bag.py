"""Bags, read back by rosbags."""

import builtins
from dataclasses import replace

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from support.tilted_sheets import HEIGHT, WIDTH, tilted_grid

from pipeline.errors import FootageError, OutputError
from pipeline.output.formats.ros_bag import FRAME_ID, read_bag, write_bag
from pipeline.output.mesh_files import read_mesh


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
    with pytest.raises(ValueError, match=r"pip install 'colorphase\[mcap\]'"):
        read_bag(tmp_path / "bag.mcap")


def bag_of(folder, n_frames):
    """Write frames, each 10 mm behind the one before, and return the file."""
    grid = tilted_grid()
    shifts = (np.array([0, 0, 10 * k], np.float32) for k in range(n_frames))
    write_bag(folder / "bag", (replace(grid, points=grid.points + shift) for shift in shifts), {})
    return folder / "bag" / "bag.mcap"


def test_frames_are_read_back(tmp_path):
    path, grid = bag_of(tmp_path, 3), tilted_grid()
    for number in range(3):
        read = read_bag(path, number)
        np.testing.assert_allclose(read.depth, grid.depth + 10 * number, rtol=1e-6)  # NaN where it is NaN
        np.testing.assert_array_equal(read.texture, grid.texture)
        np.testing.assert_allclose(read.properties["sigma_mm"], grid.properties["sigma_mm"])


def test_a_frame_becomes_a_mesh(tmp_path, cpu):
    mesh = read_mesh(bag_of(tmp_path, 1))
    assert len(mesh.faces) > HEIGHT * WIDTH and {*mesh.properties} >= {"sigma_mm"}
    assert mesh.colors is not None and (mesh.vertices[:, 2] > 499).all()


def test_wrong_numbers_and_damage_are_a_line(tmp_path, cpu):
    path = bag_of(tmp_path, 2)
    with pytest.raises(ValueError, match="it holds 2 frames: choose one by its number, from 0"):
        read_bag(path)
    for number in (2, -1):
        with pytest.raises(ValueError, match=f"it has no frame {number}: its 2 are numbered from 0"):
            read_bag(path, number)
    whole = path.read_bytes()
    for damaged in (b"", whole[:100], whole[:-40], whole[: len(whole) // 2] + b"x" * (len(whole) // 2)):
        path.write_bytes(damaged)
        with pytest.raises(FootageError, match=r"cannot read .*bag\.mcap as a surface \(MCAP\): it is damaged"):
            read_mesh(path, 0)


def test_a_damaged_length_is_not_allocated(tmp_path, cpu):
    path = bag_of(tmp_path, 1)
    path.write_bytes(path.read_bytes()[:9] + (2**62).to_bytes(8, "little") + path.read_bytes()[17:])
    with pytest.raises(FootageError, match=r"it is damaged \(ReaderError\)"):
        read_mesh(path)


def test_a_bag_that_holds_other_things(tmp_path):
    grid = tilted_grid()
    write_bag(tmp_path / "bag", [], {})
    with pytest.raises(ValueError, match="it has 0 topics of points, and one is read"):
        read_bag(tmp_path / "bag" / "bag.mcap")
    write_bag(tmp_path / "line", [replace(grid, points=grid.points[:1], texture=None, properties={}, camera=None)], {})
    with pytest.raises(ValueError, match="32 times 1 points are no grid"):
        read_bag(tmp_path / "line" / "line.mcap")
