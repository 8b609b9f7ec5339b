"""The picture that the projector shows: sinusoids, and the code in their contrast."""

from pipeline.pattern.fringes import make_pattern, write_pattern

__all__ = ["make_pattern", "write_pattern"]
