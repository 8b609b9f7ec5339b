"""docs/troubleshooting.md quotes all that decoding warns of."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "troubleshooting.md"
#: Texts of these rooms that are no warnings: how fields are rounded, and what labels and figures say of them.
NO_WARNINGS = {ROOT / "pipeline" / "decoding" / name for name in ("fields.py", "labels.py", "footage_light.py")}


def parts_of(node: ast.AST) -> list[str] | None:
    """Return the fixed parts of a text in the code; None: this is no text."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.split(r"\{[^}]*\}", node.value)
    if isinstance(node, ast.JoinedStr):
        return [value.value for value in node.values if isinstance(value, ast.Constant)]
    return None


def texts(tree: ast.AST) -> Iterator[list[str]]:
    """Yield the fixed parts of every text of a module but its docstrings and errors."""
    for node in ast.iter_child_nodes(tree):
        documents = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        shows = isinstance(node, ast.FunctionDef) and node.name == "__repr__"
        if documents or shows or isinstance(node, ast.Raise):
            continue
        parts = parts_of(node)
        if parts is not None:
            yield parts
        if not isinstance(node, ast.Constant):
            yield from texts(node)


def warnings_of(path: Path) -> Iterator[str]:
    """Yield the longest fixed part of every text of a module that is no error and a sentence by its length."""
    for parts in texts(ast.parse(path.read_text(encoding="utf-8"))):
        if sum(len(part.split()) for part in parts) >= 5:
            yield max(parts, key=len).strip()


def notes_of(path: Path) -> Iterator[str]:
    """Yield the same of what footage's readers note of it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        added = isinstance(node, ast.AugAssign) and ast.unparse(node.target) == "self.notes"
        appended = isinstance(node, ast.Call) and ast.unparse(node.func) == "notes.append"
        if added or appended:
            for parts in texts(node):
                if sum(len(part.split()) for part in parts) >= 3:
                    yield max(parts, key=len).strip()


def test_all_that_decoding_warns_of_is_on_the_page():
    rooms = [ROOT / "pipeline" / room for room in ("decoding", "orders")]
    modules = [ROOT / "pipeline" / "decoder.py", *(path for room in rooms for path in sorted(room.glob("*.py")))]
    found = [text for path in modules if path not in NO_WARNINGS for text in warnings_of(path)]
    found += [text for path in sorted((ROOT / "pipeline" / "footage").glob("*.py")) for text in notes_of(path)]
    commands = sorted((ROOT / "pipeline" / "cli").glob("*.py"))
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in commands]
    found += [
        max(parts, key=len).strip()
        for tree in trees
        for parts in texts(tree)
        if parts and parts[0].startswith("warning: ")
    ]
    assert len(found) > 20
    shown = " ".join(PAGE.read_text(encoding="utf-8").split())
    assert [text for text in found if text not in shown] == []
