"""Small pieces of Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def cell(value: object) -> str:
    """Text of a table cell: one line, bars escaped, a dash for nothing."""
    text = " ".join(str(value).split()).replace("|", "\\|")
    return text or "–"


def code(value: object) -> str:
    """Inline code; nothing stays nothing."""
    return f"`{value}`" if str(value) else ""


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Pipe table."""
    top = ["| " + " | ".join(head) + " |", "|" + " --- |" * len(head)]
    return "\n".join([*top, *("| " + " | ".join(cell(item) for item in row) + " |" for row in rows)]) + "\n"


def sections(parts: Iterable[str]) -> str:
    """Parts with an empty line between them."""
    return "\n\n".join(part.strip("\n") for part in parts if part.strip()) + "\n"


def number(value: float) -> str:
    """Short decimal form."""
    return f"{value:g}"
