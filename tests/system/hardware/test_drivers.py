"""The table of drivers, and drivers of the user's own."""

import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from support.own_drivers import DRIVERS

from hardware import protocols
from hardware.camera import open_camera
from hardware.drivers import CAMERAS, PROJECTORS, TRIGGERS
from hardware.errors import CameraError, RigError
from hardware.instruments import open_instruments
from hardware.plugins import Plugin, load
from hardware.projector import open_projector
from hardware.rig import Rig
from hardware.settings import CameraSettings, ProjectorSettings, RigSettings, TriggerSettings
from hardware.trigger import open_trigger

#: Drivers in the user's own module, and some that lack methods.
MODULE = f"""{DRIVERS}
class WithoutTwo:
    identity = limits = exposure_s = None
    unlocked = ()
    def __init__(self, settings): raise AssertionError("it is opened although methods are missing")
    def arm(self, count): pass
    def frame(self, timeout_s): pass
    def trigger(self): pass

class WithoutLimits(OwnProjector):
    def configure(self, train): return train
    def arm(self): pass
    def fire(self): pass
    def strobes(self): return ()
    def abort(self): pass
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Put a module of the user's own on the path."""
    (tmp_path / "own_drivers.py").write_text(MODULE, encoding="utf-8")
    (tmp_path / "needs_more.py").write_text("import a_library_that_is_not_there", encoding="utf-8")
    (tmp_path / "misspelled.py").write_text("class Camera: def", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in ("own_drivers", "needs_more", "misspelled"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("table", [CAMERAS, TRIGGERS, PROJECTORS], ids=["cameras", "triggers", "projectors"])
def test_every_place_in_the_tables_is_there(table):
    for driver in table.values():
        assert callable(load("driver", Plugin(driver.place), RigError))
        assert driver.listing is None or callable(load("driver", Plugin(driver.listing), RigError))


def test_the_tables_are_read_without_loading_any_driver():
    program = (
        "import sys, hardware\n"
        "from hardware.drivers import CAMERAS, PROJECTORS, TRIGGERS\n"
        "places = {d.place.split(':')[0] for t in (CAMERAS, PROJECTORS, TRIGGERS) for d in t.values()}\n"
        "print(sorted(places & set(sys.modules)))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"


def test_the_simulated_camera_has_the_one_format_that_it_sends():
    for name in (None, "RGB8"):
        assert CameraSettings(driver="simulated", exposure_s=1, pixel_format=name).pixel_format == name
    with pytest.raises(RigError, match=r'must be "RGB8" with the simulated camera, got .BayerRG8'):
        CameraSettings(driver="simulated", exposure_s=1, pixel_format="BayerRG8")


def test_settings_accept_the_tables_names_and_nothing_else():
    for name in (*TRIGGERS, "software", "simulated", "own_drivers:OwnTrigger"):
        assert TriggerSettings(driver=name).driver == name
    for name in (*CAMERAS, "simulated", "some.own_drivers:OwnCamera"):
        assert CameraSettings(driver=name, exposure_s=1).driver == name
    for name in (*PROJECTORS, None, "own_drivers:OwnProjector"):
        assert ProjectorSettings(control=name).control == name
    for name in ("leica", "software", "own_drivers", "own_drivers:", ":Own", "own-drivers:Own", "a:b:c", "a..b:c", ""):
        with pytest.raises(RigError, match=r'^driver: must be "basler", "aravis", "opencv", "simulated" or'):
            CameraSettings(driver=name, exposure_s=1)


def test_a_rig_of_the_users_own_drivers_makes_a_burst(own):
    settings = RigSettings.model_validate(
        {
            "trigger": {"driver": "own_drivers:open_own_trigger"},
            "timing": {"period_s": 0.02, "frames": 3},
            "camera": {"driver": "own_drivers:OwnCamera", "exposure_s": 1e-3},
        }
    )
    with Rig(settings, lambda: open_instruments(settings)) as rig:
        burst = next(rig.bursts())
    assert [paired.pulse for paired in burst.frames] == [0, 1, 2]
    assert burst.frames[0].image.shape == (4, 6, 3)
    projector = open_projector(ProjectorSettings(control="own_drivers:OwnProjector"))
    assert type(projector).__name__ == "OwnProjector"


def test_what_an_own_driver_raises_comes_through(own):
    with pytest.raises(CameraError, match="no camera of that number"):
        open_camera(CameraSettings(driver="own_drivers:OwnCamera", exposure_s=1, serial="absent"))


@pytest.mark.parametrize(
    ("driver", "message"),
    [
        ("no_such_module:Own", "no_such_module cannot be imported .*: install it, or put its folder on PYTHONPATH"),
        ("needs_more:Own", "needs_more cannot be imported .*No module named 'a_library_that_is_not_there'.*: install"),
        ("misspelled:Own", "misspelled cannot be imported .SyntaxError: .*: correct it"),
        ("own_drivers:Misspelled", r"own_drivers .*own_drivers\.py.* has no Misspelled: correct it"),
        (
            "own_drivers:WithoutTwo",
            "own_drivers:WithoutTwo lacks disarm, close: give it what hardware.protocols.Camera",
        ),
        ("os:abort", "os:abort cannot be opened .TypeError: .*: correct it"),
        ("own_drivers:WIRES", "own_drivers:WIRES cannot be called: name a class, or a function that opens a camera"),
    ],
)
def test_one_line_says_what_is_wrong_with_a_driver(own, driver, message):
    with pytest.raises(RigError, match=f"^camera.driver: {message}") as fault:
        open_camera(CameraSettings(driver=driver, exposure_s=1))
    assert "\n" not in str(fault.value)


def test_what_a_trigger_lacks_once_it_is_open_is_told_too(own):
    with pytest.raises(RigError, match=r"^trigger\.driver: own_drivers:WithoutLimits lacks limits: give it what"):
        open_trigger(TriggerSettings(driver="own_drivers:WithoutLimits"))


def test_the_camera_in_the_docs_has_what_it_must_have(tmp_path, monkeypatch):
    text = (Path(__file__).resolve().parents[3] / "docs" / "cameras.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (tmp_path / "lab_camera.py").write_text(program, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    camera = open_camera(CameraSettings(driver="lab_camera:LabCamera", exposure_s=0.004, serial="7"))
    assert str(camera.identity) == "Lab camera 7"


@pytest.mark.parametrize("protocol", [protocols.Trigger, protocols.Camera, protocols.Projector])
def test_protocols_stand_by_themselves(protocol):
    """A base class's methods would be looked for in vain in the protocol's own."""
    assert protocol.__bases__[0].__name__ == "Protocol" and not get_args(protocol)
