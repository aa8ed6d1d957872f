"""Tables in Markdown, and errors with their intervals in a cell."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]], *notes: str) -> str:
    """A table in Markdown, and below it what it rests on, a paragraph each."""

    def line(cells: Sequence[str]) -> str:
        return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"

    lines = [line(heads), "|---" * len(heads) + "|", *map(line, rows), *(f"\n{note}" for note in notes)]
    return "\n".join(lines)


def with_interval(value: float, interval: Sequence[float] | None) -> str:
    """An error and, where it has one, its interval, nm."""
    return f"{value:.2f} nm" + (f" ({interval[0]:.2f} … {interval[1]:.2f})" if interval else "")
