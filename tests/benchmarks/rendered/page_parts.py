"""Parts of a page that benchmarks write, each between two comments with its name."""

from pathlib import Path

#: The page with the tables of all studies.
STUDIES = Path(__file__).resolve().parents[3] / "docs" / "studies.md"


def write_part(name: str, text: str, page: Path = STUDIES) -> None:
    """Replace the part of a page between `<!-- name: begin -->` and `<!-- name: end -->`."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, rest = page.read_text(encoding="utf-8").split(begin)
    _, after = rest.split(end)
    page.write_text(f"{before}{begin}\n\n{text.strip()}\n\n{end}{after}", encoding="utf-8")
