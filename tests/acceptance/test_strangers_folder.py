"""Every command, called in a stranger's folder that is full of Python's modules: none of them is run."""

import subprocess
import sys

import pytest

NAMES = {
    *sys.stdlib_module_names,
    *("colorphase", "pipeline", "tikernels", "hardware", "taichi", "quadrants", "numpy", "cv2", "pydantic", "zarr"),
    *("PIL", "av", "matplotlib", "pyvista", "vtk", "vtkmodules", "rich", "cyclopts", "trimesh", "numcodecs", "scipy"),
    *("google_crc32c", "threadpoolctl", "sitecustomize", "usercustomize", "pygame", "serial"),
}
#: In the order in which each needs what the one before has made.
COMMANDS = (
    "--version",
    "--help",
    "devices",
    "pattern pattern.png",
    "demo --out demo --arch cpu",
    "capture --rig simulated --out captured --bursts 1 --view --no-browser --arch cpu",
    "verify captured",
    "inspect captured/recording.zarr --arch cpu",
    "export captured/recording.zarr --kind mkv",
    "decode demo/frame.png --out picture --arch cpu",
    "decode captured/recording.mkv --out film --arch cpu --workers 2 --stop 3 --fields mask range_image",
    "export film --out meshes",
    "render film/result.zarr --out film.mp4 --size 320x240",
)


@pytest.mark.timeout(1800)
def test_no_module_of_the_working_folder_is_run(tmp_path):
    """Python is started as an installed command starts it: what is first on its path is the command's own folder."""
    (tmp_path / "bin").mkdir()
    start = tmp_path / "bin" / "colorphase"
    start.write_text("from pipeline.cli.start import main\nif __name__ == '__main__': main()\n")
    folder, run = tmp_path / "stranger", tmp_path / "run"
    folder.mkdir()
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"open({str(run)!r}, 'a').write('{name} ')\nraise SystemExit(9)\n")
    for command in COMMANDS:
        arguments = [sys.executable, str(start), *command.split()]
        done = subprocess.run(arguments, cwd=folder, capture_output=True, text=True)
        assert not run.exists(), f"{command}: {run.read_text()}"
        assert done.returncode in (0, 3) or command.startswith("render"), f"{command}: {done.stderr}"
