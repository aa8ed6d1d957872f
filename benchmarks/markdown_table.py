"""Write tables in Markdown, and errors with their confidence intervals as text."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]], *notes: str) -> str:
    """Return a table in Markdown. It is followed by the notes, each as a paragraph."""

    def line(cells: Sequence[str]) -> str:
        return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"

    lines = [line(heads), "|---" * len(heads) + "|", *map(line, rows), *(f"\n{note}" for note in notes)]
    return "\n".join(lines)


def with_interval(value: float, interval: Sequence[float] | None) -> str:
    """Return an error in nm as text, followed by its confidence interval in brackets if there is one."""
    return f"{value:.2f} nm" + (f" ({interval[0]:.2f} … {interval[1]:.2f})" if interval else "")
