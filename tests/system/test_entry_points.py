"""Drivers and formats that installed packages announce by entry points."""

import subprocess
import sys
from pathlib import Path

import pytest
from support.own_drivers import DRIVERS
from support.tilted_sheets import tilted_mesh

from hardware.camera import open_camera
from hardware.errors import CameraError, RigError
from hardware.instruments import open_instruments
from hardware.models import allowed_values
from hardware.projector import open_projector
from hardware.rig import Rig
from hardware.settings import CameraSettings, RigSettings, TriggerSettings
from pipeline.errors import OutputError, SettingsError
from pipeline.output.formats.table import FORMATS, format_of
from pipeline.output.mesh_files import write_mesh

MODULE = f"""{DRIVERS}
from pipeline.output.formats.table import OPTICAL, FileFormat

def encode(mesh, heading):
    return {{".lab": f"{{len(mesh.vertices)}} of {{heading.stem}}, {{heading.remarks['unit']}}".encode()}}

LAB = FileFormat("the lab's own", "a count", "m", OPTICAL, encode)
"""
ENTRIES = """
[colorphase.cameras]
lab = lab_rig.drivers:OwnCamera
broken = lab_rig.missing:Camera
gone = lab_rig.drivers:Gone
basler = lab_rig.drivers:OwnCamera
simulated = lab_rig.drivers:OwnCamera
twice = lab_rig.drivers:OwnCamera

[colorphase.triggers]
lab-pulses = lab_rig.drivers:open_own_trigger

[colorphase.projectors]
lab-wall = lab_rig.drivers:OwnProjector

[colorphase.formats]
lab = lab_rig.drivers:LAB
wrong = lab_rig.drivers:encode
ply = lab_rig.drivers:LAB
"""


def install(folder: Path, package: str, entries: str) -> None:
    """Leave in a folder what pip leaves of a package's announcements."""
    info = folder / f"{package.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(entries, encoding="utf-8")


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Two packages, of which one holds drivers and a format."""
    site = tmp_path / "site"
    (site / "lab_rig").mkdir(parents=True)
    (site / "lab_rig" / "__init__.py").touch()
    (site / "lab_rig" / "drivers.py").write_text(MODULE, encoding="utf-8")
    install(site, "lab-rig", ENTRIES)
    install(site, "other-rig", "[colorphase.cameras]\ntwice = nowhere:Camera\n")
    monkeypatch.syspath_prepend(site)
    yield site
    for name in [name for name in sys.modules if name.partition(".")[0] == "lab_rig"]:
        del sys.modules[name]


def test_a_rig_of_announced_drivers_makes_a_burst(packages):
    settings = RigSettings(
        trigger={"driver": "lab-pulses"},
        timing={"period_s": 0.02, "frames": 3},
        camera={"driver": "lab", "exposure_s": 1e-3},
        projector={"control": "lab-wall"},
    )
    assert "lab_rig" not in sys.modules  # before it is opened
    with Rig(settings, lambda: open_instruments(settings)) as rig:
        assert [paired.pulse for paired in next(rig.bursts()).frames] == [0, 1, 2]
    assert type(open_projector(settings.projector)).__module__ == "lab_rig.drivers"
    with pytest.raises(CameraError, match=r"^no camera of that number: connect it"):
        open_camera(settings.camera.replace(serial="absent"))


def test_their_names_are_listed_where_one_is_wrong(packages):
    with pytest.raises(
        RigError, match=r'^driver: must be .*"simulated", "broken", "gone", "lab", "twice" or .* got .leica'
    ):
        CameraSettings(driver="leica", exposure_s=1)
    assert '"lab-pulses"' in allowed_values(TriggerSettings, "driver")
    with pytest.raises(SettingsError, match=r"^'fbx' is no format: choose one of ply, .*, mcap, lab, ply, wrong"):
        format_of("fbx")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "broken",
            "camera.driver: lab_rig.missing of the package lab-rig 1.0 cannot be imported .ModuleNotFoundError: .*: "
            "update that package, or uninstall it",
        ),
        ("gone", "camera.driver: lab_rig.drivers of the package lab-rig 1.0 .* has no Gone: update that package"),
        ("basler", "driver: lab-rig 1.0 announces 'basler' in colorphase.cameras, which is a built-in name: uninstall"),
        ("simulated", "driver: lab-rig 1.0 announces 'simulated' in colorphase.cameras, which is a built-in name"),
        ("twice", "driver: lab-rig 1.0 and other-rig 1.0 both announce 'twice' in colorphase.cameras: uninstall one"),
    ],
)
def test_one_line_names_the_package_at_fault(packages, name, message):
    with pytest.raises(RigError, match=f"^{message}") as fault:
        open_camera(CameraSettings(driver=name, exposure_s=1))
    assert "\n" not in str(fault.value)
    assert CameraSettings(driver="aravis", exposure_s=1).driver == "aravis"  # nobody else pays


def test_a_format_of_another_package(packages, tmp_path):
    mesh = tilted_mesh()
    write_mesh(mesh, tmp_path / "sheet.lab")
    assert (tmp_path / "sheet.lab").read_text() == f"{len(mesh.vertices)} of sheet, m"
    for kind, message in (
        ("wrong", "format wrong: lab_rig.drivers:encode of the package lab-rig 1.0 is no FileFormat with an encoder"),
        ("ply", "lab-rig 1.0 announces 'ply' in colorphase.formats, which is a built-in name"),
    ):
        with pytest.raises(SettingsError, match=f"^{message}"):
            format_of(kind)
        with pytest.raises(OutputError, match=f"^cannot write .*: {message}"):
            write_mesh(mesh, tmp_path / f"sheet.{kind}")
    assert format_of("obj") is FORMATS["obj"]


def test_devices_lists_what_is_announced_and_imports_none_of_it(packages):
    program = (
        f"import sys; sys.path.insert(0, {str(packages)!r})\n"
        "from pipeline.cli.devices import devices\n"
        "from pipeline.cli.console import stdout\n"
        "stdout.width = 300\n"
        "devices()\n"
        "assert 'lab_rig' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=200, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    rows = [" ".join(line.replace("│", " ").split()) for line in done.stdout.splitlines()]
    assert "colorphase.triggers lab-pulses lab_rig.drivers:open_own_trigger of the package lab-rig 1.0" in rows
    both = "lab_rig.drivers:OwnCamera of the package lab-rig 1.0 and nowhere:Camera of the package other-rig 1.0"
    assert f"colorphase.cameras twice {both}" in rows
    assert "colorphase.formats lab lab_rig.drivers:LAB of the package lab-rig 1.0" in rows
