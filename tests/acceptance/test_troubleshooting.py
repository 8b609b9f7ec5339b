"""docs/troubleshooting.md quotes what the commands print."""

import re
from pathlib import Path

import pytest
from support.symptom_frames import SEQUENCES, SYMPTOMS
from support.symptom_words import what_is_said

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "troubleshooting.md"
PICTURES = ROOT / "docs" / "troubleshooting"
#: A frame's name, and those lines of what the commands say of it that show the fault.
BOX = re.compile(r"<!-- says: (\w+) -->\n```text\n(.*?)```", re.DOTALL)


def page() -> str:
    return PAGE.read_text(encoding="utf-8")


def joined(block: str) -> list[str]:
    """Return the lines of a box; one that is indented goes on from the one before."""
    return re.sub(r"\n +", " ", block.strip("\n")).splitlines()


def boxes() -> dict[str, list[str]]:
    """Return the lines that the page quotes, by the frame's name."""
    return {name: joined(block) for name, block in BOX.findall(page())}


def test_every_frame_has_a_box_and_every_picture_a_place():
    assert boxes().keys() == {*SYMPTOMS, *SEQUENCES}
    shown = re.findall(r"\]\(troubleshooting/([\w.]+)\)", page())
    assert sorted(shown) == sorted(path.name for path in PICTURES.iterdir())
    assert sum(path.stat().st_size for path in PICTURES.iterdir()) < 2_500_000


def without_figures(lines: list[str]) -> list[str]:
    return [re.sub(r"[-+]?\d[\d.]*(?:e[-+]\d+)?", "#", line) for line in lines]


@pytest.mark.parametrize("name", [*SYMPTOMS, *SEQUENCES])
def test_the_commands_say_what_the_page_quotes(name, cpu, tmp_path):
    said, quoted = without_figures(what_is_said(name, tmp_path)), without_figures(boxes()[name])
    assert [line for line in said if line in quoted] == quoted
    (shown,) = without_figures([" ".join(page().split())])
    warned = [line for line in said if line.startswith(("decode: warning: ", "decode: error: "))]
    assert [line for line in warned if line.removeprefix("decode: ") not in shown] == []
