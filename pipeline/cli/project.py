"""`colorphase project` and `colorphase projector ...`: parse, call, say what was found."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path

from cyclopts import App
from rich.console import Console
from rich.table import Table

from hardware.display import Display
from hardware.projector import open_projector
from hardware.protocols import Projector
from pipeline.acquisition.rig_file import read_rig
from pipeline.footage.image_file import read_codes

_out = Console(markup=False, emoji=False)
_err = Console(stderr=True, markup=False, emoji=False)

projector = App(name="projector", help="Switch the rig's projector, over PJLink or InFocus's RS-232 commands.")


def project(picture: Path, /, *, display: int | None = None, seconds: float | None = None) -> None:
    """Show a picture full-screen, pixel for pixel, until Esc, q or Ctrl-C. Needs the extra `project`.

    Example: colorphase project pattern.png --display 1

    Parameters
    ----------
    picture
        The PNG, of the display's size.
    display
        Which one, as `colorphase devices` numbers them; left out, the only one there is.
    seconds
        Stop after so long.
    """
    codes = read_codes(picture)
    with suppress(KeyboardInterrupt), Display(display) as screen:
        screen.show(codes)
        if screen.note is not None:
            _err.print(f"note: {screen.note}", style="yellow", highlight=False, soft_wrap=True)
        what = f"{picture} is on display {screen.number}, {{}}x{{}}".format(*screen.size_px)
        _out.print(f"{what}; Esc, q or Ctrl-C ends it", highlight=False, soft_wrap=True)
        screen.wait(seconds)


@projector.command
def on(*, rig: Path) -> None:
    """Switch it on, and wait until it is.

    Example: colorphase projector on --rig rig.toml

    Parameters
    ----------
    rig
        The rig's TOML file, whose section [projector] says how it is spoken to.
    """
    _switch(rig, on=True)


@projector.command
def off(*, rig: Path) -> None:
    """Switch it off, and wait until it has cooled.

    Parameters
    ----------
    rig
        The rig's TOML file.
    """
    _switch(rig, on=False)


@projector.command
def blank(*, rig: Path) -> None:
    """Show black, the lamp staying on.

    Parameters
    ----------
    rig
        The rig's TOML file.
    """
    with _opened(rig) as device:
        device.blank(True)


@projector.command
def unblank(*, rig: Path) -> None:
    """Show the picture again.

    Parameters
    ----------
    rig
        The rig's TOML file.
    """
    with _opened(rig) as device:
        device.blank(False)


@projector.command(name="input")
def choose_input(source: str, /, *, rig: Path) -> None:
    """Choose what it shows.

    Example: colorphase projector input 31 --rig rig.toml

    Parameters
    ----------
    source
        As the projector's manual numbers them for its control: of PJLink 31 is the first digital input.
    rig
        The rig's TOML file.
    """
    with _opened(rig) as device:
        device.input(source)


@projector.command
def status(*, rig: Path) -> None:
    """Say what it does, and what is wrong with it.

    Parameters
    ----------
    rig
        The rig's TOML file.
    """
    with _opened(rig) as device:
        found = device.status()
        table = Table(title=str(device.identity), show_header=False)
    faults = None if found.faults is None else ", ".join(found.faults) or "none"
    hours = None if found.lamp_hours is None else ", ".join(map(str, found.lamp_hours)) or "no lamp"
    blanked = None if found.blank is None else "yes" if found.blank else "no"
    for name, value in (
        ("power", found.power),
        ("input", found.input),
        ("blank", blanked),
        ("faults", faults),
        ("lamp hours", hours),
    ):
        table.add_row(name, value or "not told")
    _out.print(table)


def _switch(rig: Path, on: bool) -> None:
    with _opened(rig) as device, _err.status("asking") as shown:
        tell: Callable[[str], None] = shown.update
        sure = device.power(on, tell)
    what = "the projector is" if sure else "the projector does not tell whether it is, but was told to be"
    _out.print(f"{what} {'on' if on else 'off'}")


@contextmanager
def _opened(rig: Path) -> Iterator[Projector]:
    with closing(open_projector(read_rig(rig).projector)) as device:
        yield device
