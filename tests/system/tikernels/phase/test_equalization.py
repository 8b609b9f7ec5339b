"""Equalisation of values that are missing."""

import subprocess
import sys


def test_a_missing_value_harms_no_other(arch):
    """In a process of its own: what reads beyond the table may take the process down."""
    program = (
        "import numpy as np, tikernels\n"
        f"tikernels.init({arch!r})\n"
        "phase = np.linspace(-3, 3, 4000, dtype=np.float32).reshape(50, 80)\n"
        "mask = np.ones(phase.shape, bool)\n"
        "expected = tikernels.equalize_phase(phase, mask)\n"
        "phase[3, 4] = np.nan\n"
        "difference = np.abs(tikernels.equalize_phase(phase, mask) - expected)\n"
        "assert np.isnan(difference).sum() == 1 and np.nanmax(difference) < 0.01, np.nanmax(difference)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
