"""Folders from strangers: what is no plain file in them is not waited for, takes no memory, and leads nowhere."""

import os
import shutil

import pytest
from support.command_in_process import command as command
from support.file_samples import make_samples
from support.recorded_footage import record

from pipeline.cli.console import SOME_ARE_BAD

pytestmark = [
    pytest.mark.usefixtures("cpu"),
    pytest.mark.skipif(os.name == "nt", reason="this system has no pipes among its files"),
    pytest.mark.timeout(120),
]


def sparse(path):
    path.touch()
    os.truncate(path, 2**36)


#: What takes the place of a file.
PLANTS = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "sparse": sparse,
    "circle": lambda path: path.symlink_to(path.name),
    "folder": os.mkdir,
}
#: Files, and the commands that read them.
READ = {
    "out/result.zarr/zarr.json": ("verify out", "export out", "decode frame.png --out out"),
    "out/result.zarr/mask/zarr.json": ("verify out", "export out", "decode frame.png --out out"),
    "out/result.zarr/x/c.0": ("verify out", "export out"),
    "out/result.zarr/points/c.1.0.0.0": ("verify out", "export out"),
    "out/result.zarr/done/c.1.0": ("verify out", "export out"),
    "out/.result.zarr.lock": ("verify out", "decode frame.png --out out"),
    "out/report.json": ("verify out", "decode frame.png --out out"),
    "out/mesh.ply": ("verify out", "decode frame.png --out out"),
    "out/meshes/exported.json": ("export out --out out/meshes",),
    "out/meshes/frame_000000.ply": ("export out --out out/meshes",),
    "captured/recording.zarr/zarr.json": ("verify captured", "inspect captured/recording.zarr"),
    "captured/recording.zarr/frames/zarr.json": ("verify captured", "inspect captured/recording.zarr"),
    "captured/recording.zarr/frames/c.1.0.0.0": ("verify captured", "export captured/recording.zarr --kind mkv"),
    "captured/log.jsonl": ("verify captured", "decode captured/recording.zarr --out film --stop 1"),
    "killed/recording.part.zarr/frames/zarr.json": ("verify killed",),
    "killed/log.jsonl": ("verify killed",),
    "frame.png": ("decode frame.png --out new", "inspect frame.png", "verify frame.png"),
    "pictures/1.png": ("decode pictures --out new", "inspect pictures"),
    "recording.mkv": ("inspect recording.mkv", "verify recording.mkv"),
    "calibration.json": ("decode frame.png --out new --calibration calibration.json",),
    "settings.toml": ("decode frame.png --out new --settings settings.toml",),
    "rig.toml": ("capture --rig rig.toml --out taken",),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory, cpu):
    """Return a folder of whole files."""
    folder = tmp_path_factory.mktemp("whole")
    make_samples(folder)
    for name in ("out", "captured", "killed"):
        (folder / name).mkdir()
    (folder / "result.zarr").rename(folder / "out" / "result.zarr")
    (folder / "out" / "mesh.ply").write_text("mesh")
    (folder / "out" / "report.json").write_text('{"files": {"mesh.ply": "0", "/dev/zero": "0", "../mine": "0"}}')
    (folder / "out" / "meshes").mkdir()
    (folder / "pictures").mkdir()
    for number in range(3):
        shutil.copy(folder / "frame.png", folder / "pictures" / f"{number}.png")
    record(folder / "captured" / "recording.zarr", 3, (64, 48))
    (folder / "captured" / "log.jsonl").write_text('{"event": "start"}\n')
    shutil.copytree(folder / "captured" / "recording.zarr", folder / "killed" / "recording.part.zarr")
    (folder / "killed" / "log.jsonl").write_text('{"event": "start"}\n')
    return folder


@pytest.mark.parametrize("plant", [*PLANTS, "link"])
@pytest.mark.parametrize("name", READ)
def test_what_is_no_plain_file(whole, tmp_path, command, name, plant):
    """Commands end as they do where it is missing or damaged, and the file that a link leads to stays as it is."""
    mine = tmp_path / "mine"
    mine.write_text("mine")
    folder = shutil.copytree(whole, tmp_path / "stranger", symlinks=True)
    (folder / name).unlink(missing_ok=True)
    if plant == "link":
        (folder / name).symlink_to(mine)
    else:
        PLANTS[plant](folder / name)
    for words in READ[name]:
        arch = ["--arch", "cpu"] if words.startswith(("decode", "inspect")) else []
        done = command(*words.split(), *arch, cwd=folder)
        assert done.returncode in (0, 1, SOME_ARE_BAD), done.stderr
        assert done.returncode != 1 or done.stderr.count("error: ") == 1
        assert mine.read_text() == "mine"
