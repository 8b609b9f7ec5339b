"""The command line: its commands, one file a family."""

from importlib.metadata import version

from cyclopts import App
from rich.text import Text

from pipeline.cli.calibrate import calibrate
from pipeline.cli.capture import capture
from pipeline.cli.console import run, without_controls
from pipeline.cli.decode import decode
from pipeline.cli.demo import demo
from pipeline.cli.devices import devices
from pipeline.cli.drawing import render
from pipeline.cli.export import export
from pipeline.cli.inspect import inspect
from pipeline.cli.plan import plan
from pipeline.cli.project import pattern, project, projector
from pipeline.cli.templates import rig, settings
from pipeline.cli.verify import verify

app = App(
    name="colorphase",
    help="Measure shape from ONE colour photograph of three phase-shifted sinusoids.",
    version=lambda: version("colorphase"),
    version_flags=["--version"],
    suppress_keyboard_interrupt=False,  # `run` says what it has stopped
    error_formatter=lambda error: Text(without_controls(f"error: {' '.join(str(error).split())}"), style="red"),
)
_MAKING = (demo, plan, calibrate, capture, project, projector, pattern)
_USING = (settings, rig, decode, inspect, render, export, verify, devices)
for command in (*_MAKING, *_USING):
    app.command(command)


def main() -> None:
    """Run the command that the program was called with."""
    run(app)
