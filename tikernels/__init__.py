"""Taichi kernels and their host functions: arrays in, arrays out."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from tikernels.depth.meshing import triangulate_mesh
    from tikernels.depth.triangulation import ProjectorGeometry, triangulate
    from tikernels.errors import DeviceNotReady, ShapeError, SlowStart
    from tikernels.phase.color_balance import balance_color
    from tikernels.phase.crosstalk import correct_crosstalk
    from tikernels.phase.equalization import equalize_phase
    from tikernels.phase.smoothing import smooth_phase
    from tikernels.phase.wrapped_phase import compute_wrapped_phase
    from tikernels.raw.development import develop
    from tikernels.raw.linearization import linearize
    from tikernels.raw.pixel_format import PixelFormat
    from tikernels.runtime import init, supported_archs
    from tikernels.unwrapping.order_filter import correct_fringe_order
    from tikernels.unwrapping.unwrapper import unwrap_phase

__all__ = [
    "DeviceNotReady",
    "PixelFormat",
    "ProjectorGeometry",
    "ShapeError",
    "SlowStart",
    "balance_color",
    "compute_wrapped_phase",
    "correct_crosstalk",
    "correct_fringe_order",
    "develop",
    "equalize_phase",
    "init",
    "linearize",
    "smooth_phase",
    "supported_archs",
    "triangulate",
    "triangulate_mesh",
    "unwrap_phase",
]
__getattr__, __dir__ = lazily(__name__)
