"""The documentation points at what there is."""

import pkgutil
import re
from collections import Counter
from pathlib import Path

import pytest
from support.import_graph import imported_modules, module_paths, ranks_of, rooms_of
from support.room_figure import draw_rooms

import colorphase

ROOT = Path(__file__).resolve().parents[2]
#: Not what the site's builder writes.
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "decisions").glob("*.md")])
PACKAGES = "tikernels|pipeline|hardware"
#: A path from the project's root, in a command or in prose.
PATH = re.compile(rf"(?<![\w/.-])(?:{PACKAGES}|tests|docs)/[\w./-]*\w")
#: A module or what is in it, in backticks; a name that ends in .py is a file's.
NAME = re.compile(rf"`((?:{PACKAGES})(?:\.(?!py`)\w+)+)(?:\(.*?\))?`")
#: Pages that speak of what there is; the changelog also tells what things were called.
PRESENT = [page for page in PAGES if page.name != "CHANGELOG.md"]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def found_on(pages: list[Path], pattern: re.Pattern[str]) -> list[tuple[Path, str]]:
    """Return what a pattern finds on pages, each with its page."""
    return [(page, found) for page in pages for found in pattern.findall(page.read_text(encoding="utf-8"))]


def test_links_lead_somewhere():
    for page, link in found_on(PAGES, LINK):
        if "://" in link:
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), (page, link)
        assert target.is_relative_to(ROOT), (page, link)
        assert not anchor or anchor in anchors(target), (page, link)


def test_paths_exist():
    for page, path in found_on(PAGES, PATH):
        assert (ROOT / path).exists(), (page, path)


def test_names_exist():
    missing = []
    for page, name in found_on(PRESENT, NAME):
        try:
            pkgutil.resolve_name(name)
        except (AttributeError, ImportError):
            missing.append((page, name))
    assert not missing


@pytest.mark.parametrize("folder", ["docs", "docs/decisions"])
def test_every_page_is_in_the_index(folder):
    index = ROOT / folder / "README.md"
    linked = {(index.parent / link).resolve() for link in LINK.findall(index.read_text(encoding="utf-8"))}
    pages = {page for page in PAGES if page.parent == index.parent} - {index}
    assert pages <= linked


def test_every_public_name_is_in_the_reference():
    listed = re.findall(r"^   (\w+)$", (ROOT / "docs" / "api.md").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert sorted(listed) == sorted(colorphase.__all__)


def test_the_citation_names_this_version():
    said = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert said is not None and said[1] == colorphase.__version__


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
