"""A mesh for the tests of several formats."""

from support.sheet_mesh import mesh

__all__ = ["mesh"]
