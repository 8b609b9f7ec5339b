"""Count the numbers that somebody chose on the path of the light, by reading the source; nothing is imported.

    python tests/benchmarks/constants.py            the counts of `tikernels/phase` and `pipeline/decoding`
    python tests/benchmarks/constants.py --list     and every number that is counted, with its place

Counted are numbers in the source but 0, 1, 2, 1/2, pi and their negatives: those of module constants and of class
attributes, defaults of arguments and fields, and literals in code. Subscripts, shapes of types and arrays, axes, and
members of enumerations are not counted. An expression counts by the numbers written in it.
"""

import argparse
import ast
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("tikernels/phase", "pipeline/decoding")
_FREE = (0, 1, 2, 0.5, math.pi)
# What these take is the length of an axis, such as that of the three channels.
_SHAPES = "range ndrange zeros ones eye empty zero reshape read_array out_array out_buffer".split()


def numbers(tree: ast.AST, kind: str) -> Iterator[tuple[str, int, float]]:
    """Yield kind, line and value of the numbers below a node; `kind` is that of its own."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Constant) and type(node.value) in (int, float) and node.value not in _FREE:
            yield kind, node.lineno, node.value
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


def main() -> None:
    """Print the counts by room."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--list", action="store_true", help="print every number")
    listed = parser.parse_args().list
    total: Counter[str] = Counter()
    print("| room | module constants | defaults | literals | all |\n|---|---|---|---|---|")
    for room in ROOMS:
        found: Counter[str] = Counter()
        for path in sorted((ROOT / room).rglob("*.py")):
            for kind, line, value in numbers(ast.parse(path.read_text(encoding="utf-8")), "constant"):
                found[kind] += 1
                if listed:
                    print(f"{path.relative_to(ROOT)}:{line}: {value} ({kind})")
        total += found
        print(f"| {room} | {found['constant']} | {found['default']} | {found['literal']} | {found.total()} |")
    print(f"| both | {total['constant']} | {total['default']} | {total['literal']} | {total.total()} |")


if __name__ == "__main__":
    main()
