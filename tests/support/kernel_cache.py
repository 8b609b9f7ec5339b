"""The tests' compiled kernels on disk: shared by all processes of a run, and kept for the next run.

The kernel language writes what it has compiled when a device ends, so without this each process of a run would compile
the decoder's kernels for itself.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# A folder that no run has used for so long belongs to kernels that have changed since, s.
_KEPT_S = 7 * 24 * 3600
# In the folder, once the kernels that decode are in it.
_FILLED = "filled"


def kernel_settings() -> dict[str, str]:
    """Return the environment that keeps kernels in a folder of the user's, one folder for each state of the sources.

    One thread runs a kernel in all processes: each number of threads compiles kernels of its own.
    """
    sources = hashlib.sha256()
    for path in sorted((ROOT / "tikernels").rglob("*.py")):
        sources.update(path.read_bytes())
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "colorphase-tests"
    folder = caches / sources.hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    os.utime(folder)
    for other in caches.iterdir():
        if time.time() - other.stat().st_mtime > _KEPT_S:
            shutil.rmtree(other, ignore_errors=True)
    settings = {}
    for language in ("TI", "QD"):
        settings[f"{language}_OFFLINE_CACHE_FILE_PATH"] = str(folder / language.lower())
        settings[f"{language}_OFFLINE_CACHE_CLEANING_POLICY"] = "never"
        settings[f"{language}_CPU_MAX_NUM_THREADS"] = "1"
    return settings


def fill_kernel_cache() -> None:
    """Compile the kernels that decode in a child, unless an earlier run has."""
    filled = Path(os.environ["TI_OFFLINE_CACHE_FILE_PATH"]) / _FILLED
    if not filled.exists():
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        program = [sys.executable, "-W", "ignore", "-m", "support.kernel_cache"]
        subprocess.run(program, env=environment, check=True)
        filled.touch()


def _decode_frames() -> None:
    """Decode frames of both patterns with and without a calibration, read all fields, and make meshes."""
    import numpy as np

    from pipeline import Decoder, DecodeSettings
    from pipeline.decoding.frame import FIELDS
    from pipeline.output.surface_mesh import frame_mesh
    from pipeline.simulation import TYPICAL_CROSSTALK, simulate_frame, simulated_rig
    from tikernels import runtime
    from tikernels.raw.development import develop
    from tikernels.raw.pixel_format import PixelFormat

    runtime.init("cpu")
    for code, stripes in ((None, "horizontal"), ("contrast", "horizontal"), (None, "vertical")):
        rig = simulated_rig((160, 120), period_px=4 * 768 / 44, code=code, stripes=stripes)
        image = simulate_frame(rig).image
        calibration = rig.model_copy(update={"crosstalk_matrix": np.array(TYPICAL_CROSSTALK)})
        for known, smoothing_px in ((None, 0), (calibration, 7)):
            settings = DecodeSettings(code=code, stripes=stripes, smoothing_px=smoothing_px)
            frame = Decoder(settings, known, arch="cpu").decode(develop((image,), PixelFormat("rgb")))
            for name in FIELDS:
                getattr(frame, name)
            frame_mesh(frame)
    runtime.stop()


if __name__ == "__main__":
    _decode_frames()
