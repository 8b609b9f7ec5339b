"""Distances to solids, joined and cut with fillets (I. Quilez, Smooth minimum, 2013, https://iquilezles.org/articles/smin)."""

from tikernels._taichi import f32, ti, vec3


@ti.func
def ellipsoid(p: vec3, radii: vec3) -> f32:
    """Distance to an ellipsoid, to first order."""
    outer = (p / radii).norm()
    inner = (p / (radii * radii)).norm()
    return outer * (outer - 1.0) / ti.max(inner, 1e-6)


@ti.func
def smooth_union(a: f32, b: f32, blend_mm: f32) -> f32:
    """Return the smaller of two distances, with a fillet."""
    h = ti.max(blend_mm - ti.abs(a - b), 0.0) / blend_mm
    return ti.min(a, b) - h * h * blend_mm * 0.25


@ti.func
def smooth_cut(a: f32, b: f32, blend_mm: f32) -> f32:
    """Return a with b taken away, with a fillet."""
    return -smooth_union(-a, b, blend_mm)
