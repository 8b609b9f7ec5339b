"""`colorphase calibrate ...`: its commands, one file a family."""

from cyclopts import App

from pipeline.cli.calibrate_check import check
from pipeline.cli.calibrate_geometry import geometry
from pipeline.cli.calibrate_light import radiometry, wavelengths
from pipeline.cli.calibrate_simulate import simulate

calibrate = App(name="calibrate", help="Measure the rig: its light, its geometry, and later whether both still hold.")
for command in (simulate, radiometry, wavelengths, geometry, check):
    calibrate.command(command)
