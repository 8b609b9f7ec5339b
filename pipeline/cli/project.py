"""`colorphase pattern`, `colorphase project` and `colorphase projector ...`: what the projector shows."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter
from rich.table import Table

from hardware.display import Display
from hardware.projector import open_projector
from hardware.protocols import Projector
from pipeline.acquisition.chosen_rig import read_rig
from pipeline.calibration.board import Board
from pipeline.calibration.model import DEFAULT_PROJECTOR_PX, Calibration, Pattern, choose_pattern
from pipeline.cli.console import RigFile, above_zero, read_calibration, remark, say, size_of, stderr, stdout
from pipeline.errors import CalibrationError, SettingsError
from pipeline.footage.image_file import read_codes
from pipeline.models import CodeChoice, build
from pipeline.text import sizes_differ

projector = App(name="projector", help="Switch the rig's projector, over PJLink or InFocus's RS-232 commands.")


@Parameter(name="*")
@dataclass(frozen=True)
class BoardOptions:
    """The options that describe a board."""

    squares: str = "11x8"
    """The board's squares, columns and rows."""
    square_mm: Annotated[float, Parameter(validator=above_zero)] = 20.0
    """The side of a square."""
    marker_mm: Annotated[float | None, Parameter(validator=above_zero)] = None
    """The side of a ChArUco marker; left out, three quarters of a square."""
    dictionary: str = "DICT_5X5_250"
    """The markers' dictionary, as OpenCV names it."""

    def with_square(self, square_mm: float) -> "BoardOptions":
        """Return the options of the same board, printed in another size."""
        marker = None if self.marker_mm is None else self.marker_mm * square_mm / self.square_mm
        return replace(self, square_mm=square_mm, marker_mm=marker)

    def board(self, kind: str) -> Board:
        """Return the board.

        Raises
        ------
        SettingsError
            There is no such board.
        """
        sides = {
            "squares": size_of(self.squares, "--squares"),
            "square_mm": self.square_mm,
            "marker_mm": self.marker_mm,
        }
        return build(Board, {"kind": kind, "dictionary": self.dictionary, **sides}, SettingsError, "board")


@Parameter(name="*")
@dataclass(frozen=True)
class PatternOptions:
    """The options that describe the fringes."""

    period: float | None = None
    """Projector px per cycle; left out, the calibration's, else 17.4545."""
    stripes: Literal["horizontal", "vertical"] | None = None
    """The direction of the stripes; left out, the calibration's, else horizontal."""
    code: CodeChoice | None = None
    """"contrast": the modulation of each cycle identifies it, so that one frame gives absolute depth; "contrast2": that
    of cells within it, by which much smaller surfaces have it, but only with a calibrated geometry; "none": a plain
    pattern, whose depth is relative. Left out, the calibration's, else contrast."""

    def pattern(self, calibration: Calibration | None) -> Pattern:
        """Return the pattern; see `choose_pattern`."""
        return choose_pattern(calibration, self.period, self.stripes, self.code)

    def shown_to(self, calibration: Calibration) -> Calibration:
        """Return the calibration of the same rig under that pattern."""
        return calibration.with_pattern(self.period, self.stripes, self.code)


_BOARD, _FRINGES = BoardOptions(), PatternOptions()


def pattern(
    file: Path,
    /,
    *,
    size: str | None = None,
    display: int | None = None,
    fringes: PatternOptions = _FRINGES,
    calibration: Path | None = None,
    brightness: float = 1.0,
    board: Literal["charuco", "chessboard"] | None = None,
    options: BoardOptions = _BOARD,
) -> None:
    """Write the picture that the projector shows, and its description as JSON next to it; or a board to be printed.

    Example: colorphase pattern pattern.png --size 1024x768 --period 17.4545 --stripes horizontal, or
    colorphase pattern board.pdf --board charuco --squares 11x8 --square-mm 20

    Parameters
    ----------
    file
        The PNG to write; a board may be a PDF or SVG.
    size
        The projector's width and height in px; left out, the calibration's, else 1024x768.
    display
        Instead of a size: the display that `colorphase project` shows it on, as `colorphase devices` numbers them.
    calibration
        The rig's calibration.json; the projector's response is then undone in the pattern.
    brightness
        Show the same with this share of the light, above 0 to 1; without a calibration as if light were linear in the
        codes. A rig that alternates two pictures distinguishes them by it.
    board
        Write this kind of calibration board instead, in its true size, as PDF, SVG or PNG.
    """
    if board is not None:
        options.board(board).write(file)
        say(f"wrote {file}: print it in its true size, so that its ruler is 100 mm long, and glue it on something flat")
        return
    from pipeline.pattern import write_pattern

    rig = read_calibration(calibration)
    if rig is not None and rig.response is None:
        raise CalibrationError(f"{calibration} holds no response: run colorphase calibrate radiometry")
    calibrated_px = None if rig is None or rig.projector is None else rig.projector.size_px
    size_px = calibrated_px or DEFAULT_PROJECTOR_PX
    if display is not None:
        size_px = _display_size(display, size, calibrated_px)
    elif size is not None:
        size_px = size_of(size)
    response = None if rig is None else rig.response
    chosen = fringes.pattern(rig)
    write_pattern(file, size_px, chosen, response, brightness)
    if chosen.code == "contrast2" and (rig is None or not rig.has_geometry):
        remark(
            "note: contrast2 is decoded by a calibrated geometry only: run colorphase calibrate geometry --code "
            "contrast2, and write the pattern again with its --calibration"
        )


def _display_size(number: int, size: str | None, calibrated_px: tuple[int, int] | None) -> tuple[int, int]:
    """Return a display's size in px, as a picture on it must have it."""
    if size is not None:
        raise SettingsError("give --size or --display, not both")
    with Display(number) as screen:
        size_px = screen.size_px
    if calibrated_px is not None and calibrated_px != size_px:
        sizes = sizes_differ(f"display {number}", size_px, "the calibrated projector is", calibrated_px)
        raise CalibrationError(f"{sizes}: choose its display, or set that size")
    return size_px


def project(
    picture: Path,
    /,
    *,
    display: int | None = None,
    seconds: Annotated[float | None, Parameter(validator=above_zero)] = None,
) -> None:
    """Show a picture full-screen, pixel for pixel, until Esc, q or Ctrl-C. Needs the extra `project`.

    Example: colorphase project pattern.png --display 1

    Parameters
    ----------
    picture
        The PNG, of the display's size.
    display
        Its number, as `colorphase devices` numbers them; left out, the only one there is.
    seconds
        Stop after this time, s.
    """
    codes = read_codes(picture)
    with suppress(KeyboardInterrupt), Display(display) as screen:
        screen.show(codes)
        if screen.note is not None:
            remark(f"note: {screen.note}")
        what = f"{picture} is on display {screen.number}, {{}}x{{}}".format(*screen.size_px)
        say(f"{what}; Esc, q or Ctrl-C ends it")
        screen.wait(seconds)


@projector.command
def on(*, rig: RigFile) -> None:
    """Switch it on, and wait until it is.

    Example: colorphase projector on --rig rig.toml
    """
    _switch(rig, on=True)


@projector.command
def off(*, rig: RigFile) -> None:
    """Switch it off, and wait until it has cooled."""
    _switch(rig, on=False)


@projector.command
def blank(*, rig: RigFile) -> None:
    """Show black, the lamp staying on."""
    with _opened(rig) as device:
        device.blank(True)


@projector.command
def unblank(*, rig: RigFile) -> None:
    """Show the picture again."""
    with _opened(rig) as device:
        device.blank(False)


@projector.command(name="input")
def choose_input(source: str, /, *, rig: RigFile) -> None:
    """Choose what it shows.

    Example: colorphase projector input 31 --rig rig.toml

    Parameters
    ----------
    source
        As the projector's manual numbers them for its control: of PJLink 31 is the first digital input.
    """
    with _opened(rig) as device:
        device.input(source)


@projector.command
def status(*, rig: RigFile) -> None:
    """Say what it does, and what is wrong with it."""
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
        table.add_row(name, value or "unknown")
    stdout.print(table)


def _switch(rig: Path, on: bool) -> None:
    with _opened(rig) as device, stderr.status("asking") as shown:
        notify: Callable[[str], None] = shown.update
        sure = device.power(on, notify)
    what = "the projector is" if sure else "the projector does not report whether it is, but was switched"
    stdout.print(f"{what} {'on' if on else 'off'}")


@contextmanager
def _opened(rig: Path) -> Iterator[Projector]:
    with closing(open_projector(read_rig(rig).projector)) as device:
        yield device
