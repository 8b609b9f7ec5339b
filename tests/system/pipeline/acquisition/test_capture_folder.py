"""What a capture's folder asks of a camera; what it keeps is tested with the session."""

import pytest

from hardware.errors import CameraError
from hardware.protocols import FrameFormat
from pipeline.acquisition.capture_folder import pixel_format
from tikernels.raw.pixel_format import PixelFormat


def test_a_cameras_format_is_what_kernels_read():
    assert pixel_format(FrameFormat("rgb", 12)) == PixelFormat("rgb", 12)
    assert pixel_format(FrameFormat("bayer", 10, "gbrg")) == PixelFormat("bayer", 10, bayer="gbrg")


def test_a_mosaic_without_a_name_is_refused():
    with pytest.raises(CameraError, match="Bayer mosaic but not which: set a pixel format that names it"):
        pixel_format(FrameFormat("bayer", 8))
