"""docs/troubleshooting.md quotes what the program says, all that decoding warns of, and nothing else."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from support.symptom_frames import SEQUENCES, SYMPTOMS
from support.symptom_words import what_is_said

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "troubleshooting.md"
PICTURES = ROOT / "docs" / "troubleshooting"
#: A frame's name, and what the commands say of it.
BOX = re.compile(r"<!-- says: (\w+) -->\n```text\n(.*?)```", re.DOTALL)
QUOTED = re.compile(r"^(?:decode|inspect|check|error|ImportError): ")
#: Texts of these rooms that are no warnings: how fields are rounded, and what labels and figures say of them.
NO_WARNINGS = {ROOT / "pipeline" / "decoding" / name for name in ("fields.py", "labels.py", "field_plot.py")}
#: The share of a quote's letters that must stand in the code; the rest are names of files, and words filled in.
LEAST_SHARE = 0.75
#: Boxes whose commands take half a minute; CI has no time for them: run them where what they quote is changed.
SLOW = {
    *SEQUENCES,
    *("color_fields", "lateral_color", "motion_blur", "other_pattern", "code_not_told", "subsampled", "depth_range"),
    *("rolling_shutter", "wrong_scale", "paint"),
}
#: Letters of a fixed part that counts; shorter ones are found in any text.
SHORTEST = 6


def page() -> str:
    return PAGE.read_text(encoding="utf-8")


def joined(block: str) -> list[str]:
    """Return the lines of a box; one that is indented goes on from the one before."""
    return re.sub(r"\n +", " ", block.strip("\n")).splitlines()


def boxes() -> dict[str, list[str]]:
    """Return what the page says that the commands say, by the frame's name."""
    return {name: joined(block) for name, block in BOX.findall(page())}


def quotes() -> list[str]:
    """Return every line on the page that a command is said to print, and what stands between quotation marks."""
    lines = [line for block in boxes().values() for line in block]
    for block in re.findall(r"(?:^ {4,}\S.*\n)+", page(), flags=re.MULTILINE):
        indent = len(block) - len(block.lstrip())
        lines += joined("\n".join(line[indent:] for line in block.splitlines()))
    prose = " ".join(re.sub("```.*?```|`.*?`", "", page(), flags=re.DOTALL).split())
    lines = [line for line in lines if QUOTED.match(line)]
    return lines + [quote for quote in prose.split('"')[1::2] if len(quote.split()) >= 4]


def parts_of(node: ast.AST) -> list[str] | None:
    """Return the fixed parts of a text in the code; None: this is no text."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.split(r"\{[^}]*\}", node.value)
    if isinstance(node, ast.JoinedStr):
        return [value.value for value in node.values if isinstance(value, ast.Constant)]
    return None


def texts(tree: ast.AST, *, raised: bool) -> Iterator[list[str]]:
    """Yield the fixed parts of every text of a module but its docstrings; with or without those that are raised."""
    for node in ast.iter_child_nodes(tree):
        documents = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        shows = isinstance(node, ast.FunctionDef) and node.name == "__repr__"
        if documents or shows or (isinstance(node, ast.Raise) and not raised):
            continue
        parts = parts_of(node)
        if parts is not None:
            yield parts
        if not isinstance(node, ast.Constant):
            yield from texts(node, raised=raised)


@cache
def fixed_parts() -> frozenset[str]:
    """Return the fixed parts of every text in the code, but for short words."""
    sources = [path for package in ("tikernels", "pipeline", "hardware") for path in (ROOT / package).rglob("*.py")]
    found = [text for path in sources for text in texts(ast.parse(path.read_text(encoding="utf-8")), raised=True)]
    return frozenset(part.strip(" ;:,") for parts in found for part in parts if len(part.strip(" ;:,")) >= SHORTEST)


def warnings_of(path: Path) -> Iterator[str]:
    """Yield the longest fixed part of every text of a module that is no error and a sentence by its length."""
    for parts in texts(ast.parse(path.read_text(encoding="utf-8")), raised=False):
        if sum(len(part.split()) for part in parts) >= 5:
            yield max(parts, key=len).strip()


def notes_of(path: Path) -> Iterator[str]:
    """Yield the same of what footage's readers note of it."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        added = isinstance(node, ast.AugAssign) and ast.unparse(node.target) == "self.notes"
        appended = isinstance(node, ast.Call) and ast.unparse(node.func) == "notes.append"
        if added or appended:
            for parts in texts(node, raised=False):
                if sum(len(part.split()) for part in parts) >= 3:
                    yield max(parts, key=len).strip()


def share_in_code(line: str) -> float:
    """Return which share of a line's letters stands in fixed parts of the code's texts."""
    found = [False] * len(line)
    for part in fixed_parts():
        for match in re.finditer(re.escape(part), line):
            found[match.start() : match.end()] = [True] * len(part)
    letters = [inside for character, inside in zip(line, found, strict=True) if character.isalpha()]
    return sum(letters) / max(len(letters), 1)


@pytest.mark.parametrize("line", sorted(set(quotes())))
def test_what_the_page_quotes_stands_in_the_code(line):
    said = re.sub(r"^(?:warning|error|note|ripple): ", "", QUOTED.sub("", line))
    if re.fullmatch(r"(?:[\w ]+ [\d.]+ mm [\d.]+ mm |\d+ frames: )?(?:fine|re-calibrate)", said):
        return  # a row of the check's table, and its verdict
    assert share_in_code(said) > LEAST_SHARE


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
        for parts in texts(tree, raised=False)
        if parts and parts[0].startswith("warning: ")
    ]
    assert len(found) > 20
    shown = " ".join(page().split())
    assert [text for text in found if text not in shown] == []


def test_every_frame_has_a_box_and_every_picture_a_place():
    assert boxes().keys() == {*SYMPTOMS, *SEQUENCES}
    shown = re.findall(r"\]\(troubleshooting/([\w.]+)\)", page())
    assert sorted(shown) == sorted(path.name for path in PICTURES.iterdir())
    assert sum(path.stat().st_size for path in PICTURES.iterdir()) < 600_000


def without_figures(lines: list[str]) -> list[str]:
    return [re.sub(r"[-+]?\d[\d.]*(?:e[-+]\d+)?", "#", line) for line in lines]


def box(name):
    """Return a box's name with the mark of how long its three commands take."""
    return pytest.param(name, marks=pytest.mark.slow_boxes if name in SLOW else pytest.mark.long)


@pytest.mark.parametrize("name", [box(name) for name in (*SYMPTOMS, *SEQUENCES)])
def test_the_commands_say_what_the_page_quotes(name, cpu, tmp_path):
    assert without_figures(what_is_said(name, tmp_path)) == without_figures(boxes()[name])
