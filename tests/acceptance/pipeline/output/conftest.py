"""A mesh for the tests of formats and drawing."""

from support.sheet_mesh import mesh

__all__ = ["mesh"]
