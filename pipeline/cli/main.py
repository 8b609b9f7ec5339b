"""The command line: its commands, one file a family, each imported when it is called."""

import gc
import sys
from collections.abc import Sequence
from functools import partial

from cyclopts import App, Parameter
from rich.text import Text

from pipeline import __version__
from pipeline.cli.console import run, stdout
from pipeline.text import one_line

# Each command's file, and what `--help` lists without importing it.
COMMANDS = {
    "demo": ("demo", "Simulate a colour frame, decode it, and compare the result with the truth."),
    "plan": ("plan", "Predict what a rig will measure, before it is bought."),
    "calibrate": ("calibrate", "Measure the rig: its light, its geometry, and later whether both still hold."),
    "certify": ("certify", "Certify a rig by a ball bar and a plate: its errors, and the uncertainty of a length."),
    "expose": ("expose", "Set the camera's exposure to the projector's light, and name what is wrong with the rig."),
    "capture": ("capture", "Fire projector and camera, and record every frame with its pulse."),
    "project": ("project", "Show a picture full-screen, pixel for pixel."),
    "projector": ("project", "Switch the rig's projector."),
    "pattern": ("project", "Write the picture that the projector shows, or a board to print."),
    "settings": ("templates", "Write a settings file in which every setting is explained."),
    "rig": ("templates", "Write a rig.toml in which every key is explained."),
    "decode": ("decode", "Decode a picture, or footage: a folder of pictures, a video or a recording."),
    "inspect": ("inspect", "Show what footage will cost in accuracy, and what to change."),
    "view": ("view", "Show a result, footage, a picture or a mesh in the browser."),
    "report": ("report", "Write a result or a calibration as a document: one HTML file that also prints."),
    "render": ("drawing", "Draw a surface: a still picture, a turntable, or a film of all frames."),
    "export": ("export", "Write every frame of a result in a format that other programs open."),
    "verify": ("verify", "Check a result or a recording for damaged frames."),
    "devices": ("devices", "List where kernels can run, cameras, serial ports and displays."),
}


def command_line(words: Sequence[str]) -> App:
    """Return the command line for these words; a command that they name gives its help itself."""
    app = App(
        name="colorphase",
        help="Measure shape from ONE colour photograph of three phase-shifted sinusoids.",
        version=__version__,
        version_flags=["--version"],
        default_parameter=Parameter(negative_iterable=()),  # there is nothing that --empty-... would empty
        console=stdout,
        suppress_keyboard_interrupt=False,  # `run` says what it has stopped
        error_formatter=lambda error: Text(one_line(f"error: {' '.join(str(error).split())}"), style="red"),
    )
    for name, (file, summary) in COMMANDS.items():
        app.command(f"pipeline.cli.{file}:{name}", name=name, help=None if name in words else summary)
    return app


def main() -> None:
    """Run the command that the program was called with."""
    run(partial(_run, sys.argv[1:]))


def _run(words: Sequence[str]) -> None:
    app = command_line(words)
    gc.disable()  # nearly all that importing makes stays, and is not to be looked through again and again
    app.parse_commands(words)  # imports the command that they name
    gc.freeze()
    gc.enable()
    app(words)
