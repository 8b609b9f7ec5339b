"""Cameras: one file a maker or library, each with the methods of `hardware.protocols.Camera`."""

from dataclasses import dataclass
from queue import Empty, Queue
from threading import Thread
from time import monotonic

from hardware.drivers import CAMERAS, SIMULATED, open_driver
from hardware.errors import CameraError, RigError
from hardware.plugins import Plugin, load
from hardware.protocols import Camera, Identity
from hardware.settings import CameraSettings

__all__ = ["CameraListing", "list_cameras", "open_camera"]

# Looking around the network takes a second.
_PATIENCE_S = 5.0


@dataclass(frozen=True)
class CameraListing:
    """A camera that can be seen, or why a driver sees none."""

    driver: str
    identity: Identity | None = None  # None: the note says why
    note: str = ""


def open_camera(settings: CameraSettings) -> Camera:
    """Open a camera and set it up; its library is loaded only now.

    Parameters
    ----------
    settings : CameraSettings
        The camera, and what is fixed in it.

    Raises
    ------
    CameraError
        Its library is not installed, the camera is not there, in use, or refuses.
    RigError
        The settings request what this camera cannot do, name a driver that is not there, or the simulated one, which
        only a simulated rig has.
    """
    if settings.driver == SIMULATED:
        raise RigError("camera.driver: a file's rig is real; without one, use `colorphase capture --rig simulated`")
    camera: Camera = open_driver("camera.driver", settings.driver, "colorphase.cameras", settings, Camera)
    return camera


def list_cameras() -> list[CameraListing]:
    """Return the cameras that can be seen, and what is missing to see more; takes seconds at most."""
    answers: Queue[tuple[str, list[CameraListing]]] = Queue()
    places = {name: driver.listing for name, driver in CAMERAS.items() if driver.listing is not None}
    # A library that hangs must not take the others with it.
    for name, place in places.items():
        Thread(target=_look, args=(name, place, answers), daemon=True).start()
    found: dict[str, list[CameraListing]] = {}
    deadline = monotonic() + _PATIENCE_S
    while len(found) < len(places):
        try:
            name, listed = answers.get(timeout=max(0.0, deadline - monotonic()))
        except Empty:
            break
        found[name] = listed
    late = f"no answer in {_PATIENCE_S:g} s"
    return [row for name in places for row in found.get(name, [CameraListing(name, note=late)])]


def _look(name: str, place: str, answers: Queue[tuple[str, list[CameraListing]]]) -> None:
    try:
        identities: list[Identity] = load("camera.driver", Plugin(place), RigError)()
        answers.put((name, [CameraListing(name, identity) for identity in identities]))
    except CameraError as error:
        answers.put((name, [CameraListing(name, note=str(error))]))
