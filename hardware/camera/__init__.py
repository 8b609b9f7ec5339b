"""Cameras: one file a maker or library, each with the methods of `hardware.protocols.Camera`."""

from collections.abc import Callable
from dataclasses import dataclass
from queue import Empty, Queue
from threading import Thread
from time import monotonic

from hardware.errors import CameraError, RigError
from hardware.protocols import Camera, Identity
from hardware.settings import CameraSettings

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
        Which camera, and what is fixed in it.

    Raises
    ------
    CameraError
        Its library is not installed, the camera is not there, in use, or refuses.
    RigError
        The settings ask for what this camera cannot do, or for the simulated one, which only a simulated rig has.
    """
    if settings.driver == "basler":
        from hardware.camera.basler import BaslerCamera

        return BaslerCamera(settings)
    if settings.driver == "aravis":
        from hardware.camera.aravis import AravisCamera

        return AravisCamera(settings)
    if settings.driver == "opencv":
        from hardware.camera.opencv import OpenCVCamera

        return OpenCVCamera(settings)
    raise RigError("camera.driver: a file's rig is real; without one, use `colorphase capture --rig simulated`")


def list_cameras() -> list[CameraListing]:
    """Return the cameras that can be seen, and what is missing to see more; takes seconds at most."""
    answers: Queue[tuple[str, list[CameraListing]]] = Queue()
    # A library that hangs must not take the others with it.
    for driver, look in _LISTS.items():
        Thread(target=_look, args=(driver, look, answers), daemon=True).start()
    found: dict[str, list[CameraListing]] = {}
    deadline = monotonic() + _PATIENCE_S
    while len(found) < len(_LISTS):
        try:
            driver, listed = answers.get(timeout=max(0.0, deadline - monotonic()))
        except Empty:
            break
        found[driver] = listed
    late = f"no answer in {_PATIENCE_S:g} s"
    return [row for driver in _LISTS for row in found.get(driver, [CameraListing(driver, note=late)])]


def _look(driver: str, look: Callable[[], list[Identity]], answers: Queue[tuple[str, list[CameraListing]]]) -> None:
    try:
        answers.put((driver, [CameraListing(driver, identity) for identity in look()]))
    except CameraError as error:
        answers.put((driver, [CameraListing(driver, note=str(error))]))


def _basler() -> list[Identity]:
    from hardware.camera.basler import list_basler_cameras

    return list_basler_cameras()


def _aravis() -> list[Identity]:
    from hardware.camera.aravis import list_aravis_cameras

    return list_aravis_cameras()


def _opencv() -> list[Identity]:
    from hardware.camera.opencv import list_webcams

    return list_webcams()


_LISTS = {"basler": _basler, "aravis": _aravis, "opencv": _opencv}
