"""Statistics that a few outliers do not move."""

import numpy as np

from pipeline.models import FloatArray


def robust_sigma(residuals: FloatArray) -> float:
    """Return the standard deviation that normal residuals about zero have, from the median of their sizes."""
    return 1.4826 * float(np.median(np.abs(residuals)))
