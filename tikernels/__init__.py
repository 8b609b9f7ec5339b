"""Taichi kernels and their host functions: arrays in, arrays out."""

from tikernels.balance import balance_color
from tikernels.crosstalk import correct_crosstalk
from tikernels.development import develop
from tikernels.equalization import equalize_phase
from tikernels.errors import DeviceNotReady, ShapeError
from tikernels.filtering import smooth_along_stripes
from tikernels.fringe_order import correct_fringe_order
from tikernels.linearization import linearize
from tikernels.meshing import triangulate_mesh
from tikernels.pixel_format import PixelFormat
from tikernels.runtime import init, supported_archs
from tikernels.triangulation import ProjectorGeometry, triangulate
from tikernels.unwrapping import unwrap_phase
from tikernels.wrapped_phase import compute_wrapped_phase

__all__ = [
    "DeviceNotReady",
    "PixelFormat",
    "ProjectorGeometry",
    "ShapeError",
    "balance_color",
    "compute_wrapped_phase",
    "correct_crosstalk",
    "correct_fringe_order",
    "develop",
    "equalize_phase",
    "init",
    "linearize",
    "smooth_along_stripes",
    "supported_archs",
    "triangulate",
    "triangulate_mesh",
    "unwrap_phase",
]
