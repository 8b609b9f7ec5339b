"""The tables of a frame's fields in the docs, made from the table in the code.

python tests/support/field_tables.py
"""

from pathlib import Path

from pipeline.decoding.frame import FIELDS

ROOT = Path(__file__).resolve().parents[2]


def fields_table() -> str:
    """Return what each field is."""
    units = {None: "", "1": "", "range": "mm or rad"}
    rows = [
        f"| `{name}` | {units.get(field.unit, field.unit)} | {' '.join(field.meaning.split())} |"
        for name, field in FIELDS.items()
    ]
    return "\n".join(["| field | unit | meaning |", "|---|---|---|", *rows])


def store_table() -> str:
    """Return how each field is stored."""
    rows = [
        f"| `{name}` | {field.dtype} | {', '.join(('frame', *field.axes))} | "
        f"{'not' if field.rounding is None else field.rounding.how} |"
        for name, field in FIELDS.items()
    ]
    return "\n".join(["| field | type | axes | rounded |", "|---|---|---|---|", *rows])


#: Where each table stands.
TABLES = {ROOT / "docs" / "python.md": fields_table, ROOT / "docs" / "video.md": store_table}


def main() -> None:
    """Write the tables where the old ones stand."""
    for path, table in TABLES.items():
        head, rest = table().splitlines()[0], path.read_text(encoding="utf-8")
        before, _, after = rest.partition(head)
        path.write_text(before + table() + "\n\n" + after.partition("\n\n")[2], encoding="utf-8")


if __name__ == "__main__":
    main()
