"""`colorphase view`."""

import os
import sys
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from pipeline.cli.console import Arch, PageOptions, SettingsFile, read_calibration, read_settings, remark, say, steps
from pipeline.errors import SettingsError
from pipeline.footage.footage import StoredAs
from pipeline.footage.opening import open_footage
from pipeline.output.folder import is_store, store_in
from pipeline.output.mesh_files import read_mesh
from pipeline.view.server import ViewServer
from pipeline.view.subjects import FootageSubject, MeshSubject, ResultSubject, Subject

if TYPE_CHECKING:
    from pipeline.acquisition.live import WatchedFrame

_AS_IT_SAYS = StoredAs()
_MESHES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".wrl")


_ANYWHERE = PageOptions()


def view(
    input: str | None = None,
    /,
    *,
    rig: str | None = None,
    calibration: Path | None = None,
    settings: SettingsFile = None,
    arch: Arch = "auto",
    stored_as: Annotated[StoredAs, Parameter(name="*")] = _AS_IT_SAYS,
    at: PageOptions = _ANYWHERE,
) -> None:
    """Show a result, footage, a picture, a mesh, or what a rig sees now, in the browser, until Ctrl-C.

    Nobody else can open the page: it is served on this machine alone, under a random address. Over SSH choose a --port,
    and open the tunnel that is printed.

    Example: colorphase view film/result.zarr, or
    colorphase view face.png --calibration calibration.json, or
    colorphase view --rig rig.toml

    Parameters
    ----------
    input
        A result.zarr or the folder that it is in; a picture, a folder of pictures, a video or a recording, of which
        each frame is decoded when it is shown; or a mesh.
    rig
        Instead: the rig's TOML file, or "simulated"; its newest frame is shown, and nothing is recorded.
    calibration
        The rig's calibration.json, for footage; with it places are in mm.
    """
    if (input is None) == (rig is None):
        raise SettingsError("name one thing to look at: a file or folder, or --rig rig.toml")
    if rig is not None:
        if calibration is not None or stored_as != _AS_IT_SAYS:
            raise SettingsError("--rig says calibration and pixels itself: leave out --calibration and the like")
        with suppress(KeyboardInterrupt):
            _watch(rig, settings, arch, at)
        return
    with steps() as show:
        show("opening")
        subject = _subject(str(input), calibration, settings, arch, stored_as)
    with suppress(KeyboardInterrupt), closing(subject), served(subject, at):
        threading.Event().wait()


def _watch(rig: str, settings: Path | None, arch: str, at: PageOptions) -> None:
    from pipeline.acquisition.chosen_rig import choose_rig
    from pipeline.acquisition.session import watch_bursts
    from pipeline.view.live_subject import LiveSubject

    with steps() as show:
        chosen = choose_rig(rig, arch, show)
        for note in chosen.differences():
            remark(f"note: {note}")
        show("opening trigger source and camera")
    subject = LiveSubject(Path(rig).stem)
    with chosen.showing_pattern() as keep, served(subject, at):

        def notify(watched: "WatchedFrame", n_rejected: int) -> None:
            subject.hear(watched, n_rejected)
            keep()

        watch_bursts(
            chosen.settings,
            chosen.open_instruments,
            calibration=chosen.calibration,
            decoding=read_settings(settings),
            arch=arch,
            notify=notify,
        )


@contextmanager
def served(subject: Subject, at: PageOptions) -> Iterator[None]:
    """Serve a page meanwhile, and print its address."""
    with ViewServer(subject, at.port) as server:
        thread = threading.Thread(target=server.serve_forever, name="page", daemon=True)
        thread.start()
        say(f"{subject.title} is shown at {server.address}")
        if "SSH_CONNECTION" in os.environ:
            tunnel = f"ssh -L {server.server_port}:127.0.0.1:{server.server_port}"
            remark(f"note: on your own machine run {tunnel} and this machine's name, and open that address there")
        elif at.browser and _has_screen():
            webbrowser.open(server.address)
        try:
            yield
        finally:
            server.shutdown()


def _has_screen() -> bool:
    """Return whether a browser can open a window; a text browser would occupy the terminal."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _subject(input: str, calibration: Path | None, settings: Path | None, arch: str, stored_as: StoredAs) -> Subject:
    store = store_in(input)
    mesh = Path(input).suffix.lower() in _MESHES
    result = mesh or "://" in store or is_store(Path(store))
    if result and (calibration is not None or settings is not None or stored_as != _AS_IT_SAYS):
        what = "a mesh" if mesh else "decoded already"
        raise SettingsError(f"{input} is {what}: leave out --calibration, --settings and what pixels are stored as")
    if mesh:
        return MeshSubject(read_mesh(input), Path(input).name)
    if result:
        return ResultSubject(store)
    footage = open_footage(input, **vars(stored_as))
    return FootageSubject(footage, read_settings(settings), read_calibration(calibration), arch)
