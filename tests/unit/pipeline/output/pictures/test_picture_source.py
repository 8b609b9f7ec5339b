"""Where surfaces of pictures come from."""

import numpy as np
import pytest
from support.drawn_surfaces import dome
from support.stored_planes import store

from pipeline.errors import FootageError, RenderError
from pipeline.output.mesh_files import write_mesh
from pipeline.output.pictures.picture_source import MeshSource, StoreSource

pytestmark = pytest.mark.usefixtures("cpu")


def test_a_mesh_is_the_same_for_all_pictures(tmp_path):
    write_mesh(dome(), tmp_path / "mesh.ply")
    source = MeshSource(tmp_path / "mesh.ply")
    assert source.mesh(0) is source.mesh(7) is source.samples()[0]
    write_mesh(dome(at_mm=500.0), tmp_path / "other.ply")
    assert source.digest(0) != MeshSource(tmp_path / "other.ply").digest(0)


@pytest.mark.parametrize("in_mm", [True, False])
def test_frames_and_samples_of_a_store(tmp_path, in_mm):
    path = store(tmp_path / "r.zarr", [400.0, None, 403.0], missing=(0,), in_mm=in_mm)
    source = StoreSource(path, "sigma")
    assert source.mesh(0) is None and source.mesh(1) is None
    mesh = source.mesh(2)
    (sample,) = source.samples()
    assert mesh is not None and f"sigma_{mesh.unit}" in mesh.properties
    assert sample.unit == mesh.unit == ("mm" if in_mm else "rad") and f"sigma_{mesh.unit}" in sample.properties
    assert np.median(sample.vertices[:, 2]) == pytest.approx(np.median(mesh.vertices[:, 2]), abs=0.01)
    assert len({source.digest(number) for number in range(3)}) == 3
    assert source.broken == {}


def test_a_damaged_frame_is_named(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0, 401.0])
    chunk = next((path / "mask").glob("c.1.*"))
    chunk.write_bytes(chunk.read_bytes()[:-3])
    source = StoreSource(path, "clay")
    assert source.mesh(0) is not None and source.mesh(1) is None
    assert "frame 1" in source.broken[1]
    assert len(source.samples()) == 1


def test_what_is_missing(tmp_path):
    path = store(tmp_path / "r.zarr", [400.0], leave_out=("modulation",))
    with pytest.raises(FootageError, match="holds no texture"):
        StoreSource(path, "texture")
    with pytest.raises(RenderError, match="no frame shows a surface"):
        StoreSource(store(tmp_path / "empty.zarr", [None]), "clay").samples()
