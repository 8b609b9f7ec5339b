"""Cameras: one file a maker or library, each with the methods of `hardware.protocols.Camera`."""
