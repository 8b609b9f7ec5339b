"""A process that goes through cases of fuzzing, one a line of its input, and prints what became of each, a line a case.

It may take 2 GB more than it takes before the first case: what wants more raises a MemoryError.
"""

import json
import resource
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

from support.fuzz_cases import run_case, start

_MEMORY = 2 * 2**30


def _taken() -> int:
    """Return how much address space this process has."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def main() -> None:
    """Go through the cases: kind and seed of each."""
    kinds, samples = sys.argv[1].split(","), Path(sys.argv[2])
    warnings.simplefilter("error")  # nobody catches what is warned of, so it is printed past the command's own lines
    start(kinds, samples)
    resource.setrlimit(resource.RLIMIT_AS, (_taken() + _MEMORY,) * 2)
    print("ready", flush=True)
    for line in sys.stdin:
        kind, seed = json.loads(line)
        with tempfile.TemporaryDirectory() as folder:
            try:
                result = run_case(kind, seed, samples, Path(folder))
            except MemoryError:
                result = {"outcome": "memory", "where": traceback.format_exc()}
            except Exception:
                result = {"outcome": "traceback", "where": traceback.format_exc()}
        print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
