"""A screen that is only memory: Xvfb, whose pixels can be read."""

import os
import shutil
import struct
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
from support.missing import skip_but_fail_in_ci


class Screen:
    """A running Xvfb: `name` is what DISPLAY has to be."""

    def __init__(self, name: str, framebuffer: Path) -> None:
        self.name = name
        self._framebuffer = framebuffer

    def shot(self) -> npt.NDArray[np.uint8]:
        """Return what it shows, (H, W, 3) R, G, B: its memory is a file in X's window dump format."""
        data = self._framebuffer.read_bytes()
        header = struct.unpack(">25I", data[:100])
        width, height, bytes_per_line = header[4], header[5], header[12]
        assert (header[11], header[7]) == (32, 0)  # bits a pixel, least significant byte first: B, G, R, -
        pixels = np.frombuffer(data, np.uint8, bytes_per_line * height, header[0] + 12 * header[19])
        return pixels.reshape(height, -1, 4)[:, :width, 2::-1].copy()

    def wait_for(self, picture: npt.NDArray[np.uint8]) -> None:
        """Wait until it shows exactly this."""
        deadline_s = time.monotonic() + 20
        while not np.array_equal(shot := self.shot(), picture):
            assert time.monotonic() < deadline_s, f"{(shot == picture).all(axis=-1).mean():.1%} of its pixels agree"
            time.sleep(0.05)


@contextmanager
def screen(folder: Path, size: str = "320x240x24") -> Iterator[Screen]:
    """Start one. CI installs Xvfb, so there a missing one is a failure and never skipped."""
    if shutil.which("Xvfb") is None:
        skip_but_fail_in_ci("there is no Xvfb")
    reading, writing = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writing), "-screen", "0", size, "-fbdir", folder, "-nolisten", "tcp", "-noreset"],
        pass_fds=[writing],
        stdin=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(writing)
    try:
        with os.fdopen(reading) as number:
            name = f":{number.readline().strip()}"
        assert name != ":", "Xvfb does not start"
        yield Screen(name, folder / "Xvfb_screen0")
    finally:
        server.terminate()
        server.wait(10)
