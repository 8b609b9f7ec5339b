"""The kernels' cache on the disk, from which every process takes what another one has compiled."""

import numpy as np

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.frame import FIELDS
from pipeline.output.surface_mesh import frame_mesh
from pipeline.simulation import TYPICAL_CROSSTALK, simulate_frame, simulated_rig
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat


def write_kernels() -> None:
    """Decode a frame with and without a calibration, take its fields and its mesh, and write the kernels to the disk.

    The kernel language writes them when a device ends, so the device ends here and is started again.
    """
    runtime.init("cpu")
    rig = simulated_rig((128, 96), period_px=2 * 768 / 44)
    image = simulate_frame(rig).image
    for calibration in (None, rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})):
        frame = Decoder(DecodeSettings(), calibration, arch="cpu").decode(develop((image,), PixelFormat("rgb")))
        for name in FIELDS:
            getattr(frame, name)
        frame_mesh(frame)
    runtime.stop()
    runtime.init("cpu")
