"""Count the numbers that somebody chose on the path of the light, and measure what each does.

    python tests/benchmarks/constants.py            the counts of `tikernels/phase` and `pipeline/decoding`
    python tests/benchmarks/constants.py --list     and every number that is counted, with its place
    python tests/benchmarks/constants.py --ablate   halve and double each; writes a part of docs/studies.md

Counted are numbers in the source but 0, 1, 2, 1/2, pi and their negatives: those of module constants and of class
attributes, defaults of arguments and fields, and literals in code. Subscripts, shapes of types and arrays, axes, and
members of enumerations are not counted. An expression counts by the numbers written in it.

Halved and doubled are module constants, one at a time, in a copy of the source that decodes the frames of the scorecard
with one noise seed. The figures are kept as they come; a run that was killed continues.
"""

import argparse
import ast
import importlib
import json
import math
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from queue import SimpleQueue
from textwrap import shorten
from threading import Lock

from scorecard import Run, frames_folder, measured, product_digest, usable_cores

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("tikernels/phase", "pipeline/decoding")
_FREE = (0, 1, 2, 0.5, math.pi)
# What these take is the length of an axis, such as that of the three channels.
_SHAPES = "range ndrange zeros ones eye empty zero reshape read_array out_array out_buffer".split()

# Frames that tell changes apart: each group of mechanisms has some; those of captures only where these are.
_FRAMES = (
    "bust-skin-1.8 bust-skin-2-coded bust-skin-2-blurred objects-skin-2 waves-white-1.4-coded r-face r-face-coded "
    "r-board r-objects r-objects-coded r-grey-objects-coded r-deep-out-of-focus pile-small-coded touching-coded "
    "film-in-turns film-coded-once capture-parcel-coded"
).split()
# Constants, and whole modules, of which no figure of the scorecard can tell, and why.
_LEFT_OUT = {
    "mathematics": "_DIFFERENCE THIRD_DIFFERENCE MEDIAN_SIZE _ATAN _UNKNOWN _ADDED _GOLDEN",
    "sizes of arrays": "RIPPLE_TERMS HARMONICS AT_ONCE CELL_ROWS NARROW BINS _COLUMNS MOST_COLORS",
    "marks": "NO_PHASE SAYS_NOTHING",
    "limits of input": "MAX_SMOOTHING_PX _MIN_SIZE_PX MIN_PERIOD_PX",
    "rounding of stored fields": "fields",
    "texture": "texture white_light brightness_ripple",
    "warnings": "doubts expected_fringe _ODD _ODD_SHARE",
    "which side faces the camera": "front_side",
    "the frame's constant": "_LEAST_CONSTANT USUAL_TURN MAX_CONSTANT",
}
_PART = """\
## Numbers of the decoder

`python tests/benchmarks/constants.py --ablate`, {date}, one noise seed.

One number at a time is halved or doubled (of a share near one, what is missing to one). A cell lists the frame that
changes most: RMS by {rms:.1%} or more, error over sigma by {sigma:.0%}, coverage or absolute and right orders by
{coverage:.1%} of the lit pixels, wrong orders by {orders:.0f} per 100,000. From seed to seed the RMS of r-face has a
standard deviation of 5 %, that of r-objects-coded 4 %, that of touching-coded 18 %: smaller changes there are chance.
No frame has scattered light, or colours one after another before a free-running camera.

Omitted: {left_out}.

| number | is | meaning | halved | doubled |
|---|---|---|---|---|
"""
# Smaller changes are nothing.
_RMS, _SIGMA, _COVERAGE, _ORDERS = 0.005, 0.02, 0.001, 5.0


def numbers(tree: ast.AST, kind: str) -> Iterator[tuple[str, ast.Constant]]:
    """Yield kind and node of the numbers below a node; `kind` is that of its own."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in _FREE:
            yield kind, node
        elif isinstance(node, ast.ClassDef):
            if not any("Enum" in ast.unparse(base) for base in node.bases):
                yield from numbers(node, "constant")
        elif isinstance(node, (ast.FunctionDef, ast.Lambda)):
            for default in (*node.args.defaults, *node.args.kw_defaults):
                if default is not None:
                    yield from numbers(ast.Expression(default), "default")
            for part in node.body if isinstance(node, ast.FunctionDef) else [node.body]:
                # A statement is walked as an expression is, whatever the type says.
                yield from numbers(ast.Expression(part), "literal")  # type: ignore[arg-type]
        elif isinstance(node, ast.Subscript):
            yield from numbers(ast.Expression(node.value), kind)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).startswith("ti.types."):
            continue
        elif isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in _SHAPES:
            for argument in (node.func, *node.args):
                lengths = argument.elts if isinstance(argument, ast.Tuple) else [argument]
                for part in lengths:
                    if not isinstance(part, ast.Constant):
                        yield from numbers(ast.Expression(part), kind)
        elif isinstance(node, ast.keyword) and node.arg in ("axis", "ndim") and isinstance(node.value, ast.Constant):
            continue
        elif not isinstance(node, ast.arguments):
            yield from numbers(node, kind)


@dataclass(frozen=True)
class Constant:
    """A number of a module constant."""

    path: Path
    name: str  # of the constant; [n]: of several numbers
    node: ast.Constant
    meaning: str  # how the comment above it begins

    @property
    def key(self) -> str:
        """Return module and name."""
        return f"{self.path.stem}.{self.name}"

    @property
    def value(self) -> float:
        """Return the number."""
        assert isinstance(self.node.value, (int, float))
        return self.node.value

    def times(self, factor: float) -> float:
        """Return the number times a factor; of a share near one what is missing to it."""
        if isinstance(self.value, int):
            return max(1, round(self.value * factor))
        return 1 - (1 - self.value) * factor if 0.9 < self.value < 1 else self.value * factor

    def write(self, root: Path, value: float) -> None:
        """Write the module into another folder with another number."""
        lines = self.path.read_bytes().splitlines(keepends=True)
        line, (start, end) = lines[self.node.lineno - 1], (self.node.col_offset, self.node.end_col_offset)
        lines[self.node.lineno - 1] = line[:start] + repr(value).encode() + line[end:]
        (root / self.path.relative_to(ROOT)).write_bytes(b"".join(lines))


def module_constants(path: Path) -> Iterator[Constant]:
    """Yield a module's constants."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    for statement in ast.parse(source).body:
        if not isinstance(statement, ast.Assign):
            continue
        above = statement.lineno - 1
        while above and lines[above - 1].startswith("#"):
            above -= 1
        comment = " ".join(line.lstrip("#: ") for line in lines[above : statement.lineno - 1])
        meaning = re.split(r"[.;:] |, which|\.$", comment)[0]
        target, value = statement.targets[0], statement.value
        pairs = [(target, value)]
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=True))
        for name, part in pairs:
            found = [node for _, node in numbers(ast.Expression(part), "constant")]
            for place, node in enumerate(found):
                yield Constant(path, ast.unparse(name) + (f"[{place}]" if len(found) > 1 else ""), node, meaning)


def ablate() -> None:
    """Decode with every number halved and doubled, keep each result as it comes, and write the table."""
    importlib.import_module("_tests_path")
    from scorecard_frames import frames

    folder, names = frames_folder(None), [name for name in _FRAMES if name in frames()]
    kept = folder / f"constants-{product_digest()}.json"
    results: dict[str, str] = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    base = measured(folder, names, 1, rounds=0)
    modules = [path for room in ROOMS for path in sorted((ROOT / room).rglob("*.py"))]
    left_out = set(" ".join(_LEFT_OUT.values()).split())
    constants = [one for path in modules for one in module_constants(path)]
    constants = [one for one in constants if not {one.path.stem, one.name.partition("[")[0]} & left_out]
    copies: SimpleQueue[Path] = SimpleQueue()
    saving = Lock()

    def changed(constant: Constant, factor: float) -> None:
        key = f"{constant.key} {factor}"
        if key in results:
            return
        root = copies.get()
        constant.write(root, constant.times(factor))
        try:
            found = change(base, measured(folder, names, 1, code=root, rounds=0, processes=1))
        except SystemExit:  # of one number, and the others go on
            found = "fails"
        constant.write(root, constant.value)
        copies.put(root)
        with saving:
            results[key] = found
            part = kept.with_suffix(".part")
            part.write_text(json.dumps(results), encoding="utf-8")
            part.replace(kept)
            print(f"{key}: {found}", flush=True)

    with tempfile.TemporaryDirectory() as parent, ThreadPoolExecutor(usable_cores()) as pool:
        for number in range(usable_cores()):
            for package in ("tikernels", "pipeline", "hardware"):
                shutil.copytree(ROOT / package, Path(parent) / str(number) / package)
            copies.put(Path(parent) / str(number))
        list(pool.map(lambda task: changed(*task), [(one, factor) for one in constants for factor in (0.5, 2.0)]))
    from page_parts import write_part

    write_part("numbers", table(constants, results))


def table(constants: list[Constant], results: dict[str, str]) -> str:
    """Return the table of all numbers, with its heading."""
    left_out = "; ".join(f"{reason}: {names}" for reason, names in _LEFT_OUT.items())
    head = _PART.format(
        date=date.today(), left_out=left_out, rms=_RMS, sigma=_SIGMA, coverage=_COVERAGE, orders=_ORDERS
    )
    rows, before = [], ""
    for one in constants:
        cells = " | ".join(results[f"{one.key} {factor}"] for factor in (0.5, 2.0))
        meaning, before = "" if one.meaning == before else one.meaning, one.meaning
        rows.append(f"| `{one.key}` | {one.value:g} | {shorten(meaning, 100, placeholder=' ...')} | {cells} |\n")
    return head + "".join(rows)


def change(base: Run, run: Run) -> str:
    """Return by how much figures change on the frames where they change most."""
    parts = []
    for key, heading, least, factor in (("rms", "RMS", _RMS, 0), ("pull", "error/sigma", _SIGMA, 0),
            ("coverage", "coverage", _COVERAGE, 1), ("right", "right", _COVERAGE, 1),
            ("wrong", "wrong", _ORDERS, 1e5), ("unflagged", "unflagged", _ORDERS, 1e5)):  # fmt: skip
        changes = {}
        for name in base.by_frame:
            usual, now = base.mean(name, key), run.mean(name, key)
            if not math.isnan(usual):
                changes[name] = (now / usual - 1) if factor == 0 else factor * (now - usual)
        name = max(changes, key=lambda one: abs(changes[one]))
        if not abs(changes[name]) < least:
            amount = f"{changes[name]:+.0f}" if factor == 1e5 else f"{changes[name]:+.1%}"
            parts.append(f"{heading} {amount} ({name})")
    return "; ".join(parts) or "nothing"


def main() -> None:
    """Print the counts by room."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--list", action="store_true", help="print every number")
    parser.add_argument("--ablate", action="store_true", help="halve and double every module constant; takes an hour")
    options = parser.parse_args()
    if options.ablate:
        ablate()
        return
    total: Counter[str] = Counter()
    print("| room | module constants | defaults | literals | all |\n|---|---|---|---|---|")
    for room in ROOMS:
        found: Counter[str] = Counter()
        for path in sorted((ROOT / room).rglob("*.py")):
            for kind, node in numbers(ast.parse(path.read_text(encoding="utf-8")), "constant"):
                found[kind] += 1
                if options.list:
                    print(f"{path.relative_to(ROOT)}:{node.lineno}: {node.value} ({kind})")
        total += found
        print(f"| {room} | {found['constant']} | {found['default']} | {found['literal']} | {found.total()} |")
    print(f"| both | {total['constant']} | {total['default']} | {total['literal']} | {total.total()} |")


if __name__ == "__main__":
    main()
