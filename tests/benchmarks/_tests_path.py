"""Importing this puts `tests` on the path, whose `support` and `reference` benchmarks share with the tests."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
