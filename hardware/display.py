"""A display that is a projector: pictures full-screen, pixel for pixel.

Shown through pygame-ce (SDL), which needs no OpenGL. It is an extra, so it is taken where it is used.
"""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from types import ModuleType, TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
import numpy.typing as npt

from hardware.errors import ProjectorError

if TYPE_CHECKING:
    import pygame

_INSTALL = "pip install 'colorphase[project]'"
#: Settings of SDL, where its user has not set others.
_SDL = {
    "PYGAME_HIDE_SUPPORT_PROMPT": "1",
    # The picture stays when somebody clicks on another display.
    "SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS": "0",
    # Windows then reports the display's own pixels, and scales nothing.
    "SDL_WINDOWS_DPI_AWARENESS": "permonitorv2",
}
#: A display server that cannot be reached may take minutes to report it.
_LIST_TIMEOUT_S = 5.0
#: How soon a key, Ctrl-C or a display that was pulled out is noticed.
_POLL_S = 0.05


@dataclass(frozen=True)
class DisplayInfo:
    """A display of this machine."""

    number: int
    size_px: tuple[int, int]


def list_displays() -> list[DisplayInfo]:
    """Return the displays that pictures can be shown on; none where there is no screen, or the library is missing.

    A process of its own queries it, because a display server that hangs would hang this one.
    """
    command = [sys.executable, "-P", "-c", "from hardware.display import _print_sizes; _print_sizes()"]
    try:
        done = subprocess.run(command, capture_output=True, timeout=_LIST_TIMEOUT_S, check=True)
        return [DisplayInfo(number, (size[0], size[1])) for number, size in enumerate(json.loads(done.stdout))]
    except (OSError, ValueError, subprocess.SubprocessError):
        return []


def _print_sizes() -> None:
    print(json.dumps(_started().display.get_desktop_sizes()))


class Display:
    """A display that is black at first and then shows pictures, until it is closed.

    Parameters
    ----------
    number : int, optional
        Its number, as `list_displays` counts them; None: the only one there is.

    Raises
    ------
    ProjectorError
        The library is missing, there is no such display, or it does not show what is drawn: it is scaled, or has fewer
        than 8 bits a colour.
    """

    def __init__(self, number: int | None = None) -> None:
        self._pygame = _started()
        self._picture: pygame.Surface | None = None
        self._aside: pygame.Window | None = None
        self._entered = False
        try:
            sizes = self._pygame.display.get_desktop_sizes()
            self._others = [other for other in range(len(sizes)) if other != _chosen(number, sizes)]
            self.number = _chosen(number, sizes)
            # SDL's way to name a display: in the middle of the one of this number.
            middle = self._pygame.WINDOWPOS_CENTERED | self.number
            self._window = self._pygame.Window(
                "colorphase", sizes[self.number], (middle, middle), fullscreen_desktop=True, allow_high_dpi=True
            )
            self._pygame.mouse.set_visible(False)
            self._pygame.display.set_allow_screensaver(False)
            self._settle()
            self._check()
        except self._pygame.error as fault:
            self.close()
            raise ProjectorError(f"display {number or 0} cannot be used: {fault}") from None
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        width, height = self._window.get_surface().get_size()
        return width, height

    @property
    def note(self) -> str | None:
        """Possible cause of a spoilt picture that cannot be detected from here; None: none."""
        if self._pygame.display.get_driver() == "x11" and os.environ.get("WAYLAND_DISPLAY"):
            return "this is a Wayland session, which does not report scaling: set that of every display to 100 %"
        return None

    def show(self, picture: npt.NDArray[np.uint8]) -> None:
        """Show a picture until the next one.

        Parameters
        ----------
        picture : (height, width, 3) uint8
            Codes of R, G, B, as they go to the display.

        Raises
        ------
        ProjectorError
            The picture has not the display's size.
        """
        size_px = (picture.shape[1], picture.shape[0])
        if size_px != self.size_px:
            raise ProjectorError(
                f"the picture is {_times(size_px)}, but display {self.number} is {_times(self.size_px)}, and a scaled "
                f"picture measures nothing: make one with --size {_times(self.size_px)}, or set the display to "
                f"{_times(size_px)}"
            )
        self._picture = self._pygame.image.frombuffer(np.ascontiguousarray(picture).tobytes(), size_px, "RGB")
        self._draw()

    def show_aside(self, picture: npt.NDArray[np.uint8]) -> bool:
        """Show a picture in a window on another display than this one; False: there is no other.

        Parameters
        ----------
        picture : (height, width, 3) uint8
            R, G, B; the window has the size of the first one.
        """
        if not self._others:
            return False
        pygame, size_px = self._pygame, (picture.shape[1], picture.shape[0])
        if self._aside is None:
            middle = pygame.WINDOWPOS_CENTERED | self._others[0]
            self._aside = pygame.Window("colorphase: for the operator", size_px, (middle, middle))
        shown = pygame.image.frombuffer(np.ascontiguousarray(picture).tobytes(), size_px, "RGB")
        self._aside.get_surface().blit(shown, (0, 0))
        self._aside.flip()
        return True

    def entered(self) -> bool:
        """Return whether Enter or Space was pressed in a window since the last call."""
        entered, self._entered = self._entered, False
        return entered

    def wait(self, seconds: float | None = None) -> bool:
        """Return True when Esc or q is pressed or a window closed, and False after `seconds`.

        Raises
        ------
        ProjectorError
            The display was pulled out, or changed its size.
        """
        pygame = self._pygame
        end_s = float("inf") if seconds is None else time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0:
            event = pygame.event.wait(max(1, round(1000 * min(left_s, _POLL_S))))
            if event.type in (pygame.QUIT, pygame.WINDOWCLOSE):
                return True
            if event.type == pygame.KEYDOWN and event.key in (pygame.K_ESCAPE, pygame.K_q):
                return True
            if event.type == pygame.KEYDOWN and event.key in (pygame.K_RETURN, pygame.K_KP_ENTER, pygame.K_SPACE):
                self._entered = True
            if event.type in (pygame.WINDOWEXPOSED, pygame.WINDOWSIZECHANGED, pygame.WINDOWDISPLAYCHANGED):
                self._draw()
        return False

    def close(self) -> None:
        """Give the display back; idempotent."""
        self._pygame.display.quit()

    def _settle(self) -> None:
        """Wait until the window manager has made the window full-screen: before, its size is not the display's."""
        for _ in range(10):
            self._draw()
            self._pygame.event.wait(round(1000 * _POLL_S))
        self._pygame.event.clear()

    def _check(self) -> None:
        """Refuse a display that does not show what is drawn: scaled, or with fewer than 8 bits a colour."""
        if self._window.size != self.size_px:
            raise ProjectorError(
                f"the desktop scales display {self.number} from {_times(self._window.size)} to {_times(self.size_px)}: "
                "set its scaling to 100 %"
            )
        # Of the display: the window's surface always has 8, and is converted. Unknown ones, as of depth 30, are all 0.
        bits = min(mask.bit_count() for mask in self._pygame.display.Info().masks[:3])
        if 0 < bits < 8:
            raise ProjectorError(
                f"display {self.number} has {bits} bits a colour, and pictures 8: set its colour depth to 24 bits"
            )

    def _draw(self) -> None:
        surface = self._window.get_surface()
        surface.fill("black")
        if self._picture is not None:
            if self._picture.get_size() != surface.get_size():
                raise ProjectorError(
                    f"display {self.number} changed to {_times(surface.get_size())} while it was in use: start again"
                )
            surface.blit(self._picture, (0, 0))
        self._window.flip()


def _times(size_px: tuple[int, int]) -> str:
    return "{}x{}".format(*size_px)


def _chosen(number: int | None, sizes: list[tuple[int, int]]) -> int:
    there = ", ".join(f"{i} ({_times(size)})" for i, size in enumerate(sizes))
    if number is None and len(sizes) > 1:
        raise ProjectorError(f"there are several displays: choose one with --display, of {there}")
    if number is not None and not 0 <= number < len(sizes):
        raise ProjectorError(f"there is no display {number}: choose one of {there}")
    return number or 0


def _started() -> ModuleType:
    """Return pygame-ce, its display part running."""
    for name, value in _SDL.items():
        os.environ.setdefault(name, value)
    if sys.platform == "linux" and "SDL_VIDEODRIVER" not in os.environ:
        # Left to itself SDL takes Wayland, where it neither keeps to the requested display nor knows its scaling, or
        # draws into memory that nobody sees.
        if not os.environ.get("DISPLAY"):
            also = " (of a Wayland session, XWayland's)" if os.environ.get("WAYLAND_DISPLAY") else ""
            raise ProjectorError(f"there is no display to show pictures on: DISPLAY names no X11 display{also}")
        os.environ["SDL_VIDEODRIVER"] = "x11"
    try:
        import pygame
    except ImportError as missing:
        raise ProjectorError(f"showing pictures needs pygame-ce ({missing}): {_INSTALL}") from None
    if not getattr(pygame, "IS_CE", False):
        raise ProjectorError(f"pygame-ce is needed in the place of pygame: pip uninstall pygame, then {_INSTALL}")
    try:
        pygame.display.init()
    except pygame.error as fault:
        raise ProjectorError(f"there is no display to show pictures on: {fault}") from None
    return pygame
