"""One picture into a folder: what a picture that cannot be decoded leaves, and what is said meanwhile."""

import subprocess
import sys
import warnings

import numpy as np
import pytest

from pipeline.batch.one_frame import decode_picture
from pipeline.errors import DecodeWarning, FootageError, OutputError
from pipeline.footage.footage import StoredAs
from pipeline.output.mesh_files import read_mesh
from pipeline.output.range_image import write_png
from pipeline.output.surface_mesh import MeshOptions
from pipeline.settings import DecodeSettings

AS_IT_SAYS = StoredAs()
#: Decodes a picture, and prints the names of the threads that have parsed source meanwhile.
PARSED = """
import ast, builtins, sys, threading, warnings
sys.path[:] = sys.argv[1:]
threads, compiled = set(), builtins.compile

def noted(source, filename, mode, flags=0, *more, **named):
    if flags & ast.PyCF_ONLY_AST:
        threads.add(threading.current_thread().name)
    return compiled(source, filename, mode, flags, *more, **named)

builtins.compile = noted
warnings.simplefilter("ignore")
from pathlib import Path
from pipeline.batch.one_frame import decode_picture
from pipeline.footage.footage import StoredAs
from pipeline.output.surface_mesh import MeshOptions
from pipeline.settings import DecodeSettings
how = (DecodeSettings(), None, StoredAs(), "cpu", MeshOptions())
decode_picture(Path("fringes.png"), "out", *how, force=False, notify=lambda what: None)
print(threads)
"""


def decode(picture, out, *, force=False):
    said = []
    frame, _ = decode_picture(
        picture, out, DecodeSettings(), None, AS_IT_SAYS, "cpu", MeshOptions(), force=force, notify=said.append
    )
    return frame, said


def fringes(path):
    """Write a picture of 12 px a cycle."""
    place = np.arange(96)[:, None, None] * (2 * np.pi / 12) + np.array([-1, 0, 1]) * 2 * np.pi / 3
    write_png(path, np.broadcast_to(np.rint(120 + 80 * np.cos(place)), (96, 128, 3)).astype(np.uint8))


def test_a_picture_gives_all_files(tmp_path):
    fringes(tmp_path / "fringes.png")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)
        frame, said = decode(tmp_path / "fringes.png", tmp_path / "out")
    n_triangles = len(read_mesh(tmp_path / "out" / "mesh.ply").faces)
    assert frame.mask.any() and said == [
        "reading",
        "compiling kernels, and decoding 128x96 px",
        "reading every field",
        "meshing and storing",
        f"writing a mesh of {n_triangles:,} triangles, and drawing range.png",
        f"moving all into {tmp_path / 'out'}",
    ]
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["mesh.ply", "range.png", "report.json", "result.zarr", "shaded.png"]


def test_a_picture_without_fringes_is_told_of_once(tmp_path):
    write_png(tmp_path / "black.png", np.zeros((48, 64, 3), np.uint8))
    with pytest.warns(DecodeWarning, match="no fringe stands out") as warned, pytest.raises(FootageError):
        decode(tmp_path / "black.png", tmp_path / "black")
    assert len(warned) == 1


def test_source_is_parsed_by_one_thread_only(tmp_path):
    """Python 3.11 raises SystemError where two do at once; compiling kernels and importing matplotlib parse."""
    fringes(tmp_path / "fringes.png")
    done = subprocess.run([sys.executable, "-c", PARSED, *sys.path], cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stdout.splitlines()[-1]) == (0, "{'MainThread'}"), done.stderr


def test_a_black_picture_leaves_nothing(tmp_path):
    write_png(tmp_path / "black.png", np.zeros((48, 64, 3), np.uint8))
    with pytest.warns(DecodeWarning, match="no fringe stands out"):
        with pytest.raises(FootageError, match=r"nothing was measured in black\.png, so nothing is written"):
            decode(tmp_path / "black.png", tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == ["black.png"]


def test_what_cannot_be_read_leaves_no_folder(tmp_path):
    write_png(tmp_path / "whole.png", np.zeros((48, 64, 3), np.uint8))
    (tmp_path / "half.png").write_bytes((tmp_path / "whole.png").read_bytes()[:60])
    for name in ("half.png", "none.png"):
        with pytest.raises(FootageError):
            decode(tmp_path / name, tmp_path / "out")
        assert not (tmp_path / "out").exists()


def test_a_folder_that_holds_something_else_is_kept(tmp_path):
    fringes(tmp_path / "fringes.png")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    with pytest.raises(OutputError, match="holds something else"):
        decode(tmp_path / "fringes.png", tmp_path / "out")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)
        decode(tmp_path / "fringes.png", tmp_path / "out", force=True)
    assert (tmp_path / "out" / "thesis.tex").exists()
