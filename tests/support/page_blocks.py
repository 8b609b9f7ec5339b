"""Commands, Python and TOML of a page of the documentation, as they are printed there."""

import re
from dataclasses import dataclass
from pathlib import Path

# How a line begins that a shell is to run; other indented lines are formulas, pictures and answers.
_COMMANDS = re.compile(r"(?:[A-Z_]+=\S+ )?(?:colorphase|\.venv/bin/\S+|python3?|pip|dask|openssl|sudo|cd|make)\b")
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
_INDENTED = re.compile(r"(?<=\n\n)(?: {4}.*\n+)+")
_REMARK = re.compile(r"\s{2,}#.*$")


@dataclass(frozen=True)
class PageBlocks:
    """What a page shows to run or to write into a file, each in the order of the page."""

    commands: tuple[str, ...]
    python: tuple[str, ...]
    toml: tuple[str, ...]

    @classmethod
    def of(cls, page: Path) -> "PageBlocks":
        """Return those of a Markdown file."""
        return cls.of_text(page.read_text(encoding="utf-8"))

    @classmethod
    def of_text(cls, text: str) -> "PageBlocks":
        """Return those of Markdown."""
        fenced = [(language, block) for language, block in _FENCE.findall(text)]
        commands = []
        for block in _INDENTED.findall(_FENCE.sub("", text)):
            lines = re.sub(r"\\\n\s*", "", re.sub(r"^ {4}", "", block, flags=re.MULTILINE)).splitlines()
            if _COMMANDS.match(lines[0]):
                commands += [_REMARK.sub("", line).strip() for line in lines if line.strip()]
        return cls(
            tuple(commands),
            tuple(block for language, block in fenced if language == "python"),
            tuple(block for language, block in fenced if language == "toml"),
        )
