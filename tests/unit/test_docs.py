"""The documentation points at what there is."""

import pkgutil
import re
from collections import Counter
from pathlib import Path

import pytest
from support.import_graph import imported_modules, module_paths, ranks_of, rooms_of
from support.room_figure import draw_rooms

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
PACKAGES = "tikernels|pipeline|hardware"
#: A path from the project's root, in a command or in prose.
PATH = re.compile(rf"(?<![\w/.-])(?:{PACKAGES}|tests|docs)/[\w./-]*\w")
#: A module or what is in it, in backticks; a name that ends in .py is a file's.
NAME = re.compile(rf"`((?:{PACKAGES})(?:\.(?!py`)\w+)+)(?:\(.*?\))?`")
#: Pages that speak of what there is; the changelog also tells what things were called.
PRESENT = [page for page in PAGES if page.name != "CHANGELOG.md"]
LINK = re.compile(r"\]\(([^)\s]+)\)")

ids = [page.relative_to(ROOT).as_posix() for page in PAGES]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_links_lead_somewhere(page):
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        assert target.is_relative_to(ROOT), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_paths_exist(page):
    for path in PATH.findall(page.read_text(encoding="utf-8")):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("page", PRESENT, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_names_exist(page):
    for name in NAME.findall(page.read_text(encoding="utf-8")):
        pkgutil.resolve_name(name)


def test_every_page_is_in_the_index():
    index = ROOT / "docs" / "README.md"
    linked = {(index.parent / link).resolve() for link in LINK.findall(index.read_text(encoding="utf-8"))}
    pages = {page for page in PAGES if page.parent == index.parent} - {index}
    assert pages <= linked


def names_in(figure: Path) -> Counter[str]:
    """Return what is written in a figure of the rooms, but for the ranks."""
    written = re.findall(r"<text[^>]*>([^<]+)</text>", figure.read_text(encoding="utf-8"))
    return Counter(text for text in written if not text.isdigit())


def test_the_figure_of_the_rooms_shows_the_modules_that_there_are(tmp_path):
    modules = module_paths(ROOT)
    graph = {name: imported_modules(name, path, modules) for name, path in modules.items()}
    draw_rooms(tmp_path / "ranks.svg", rooms_of(graph, modules), ranks_of(graph))
    there, shown = names_in(tmp_path / "ranks.svg"), names_in(ROOT / "docs" / "ranks.svg")
    assert there["decoder"] == 1
    again = "run python tests/benchmarks/ranks.py"
    assert shown == there, f"not in the figure: {sorted(there - shown)}; no longer: {sorted(shown - there)}: {again}"
