"""Make tables in Markdown, and the text of errors with their confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence


def markdown_table(heads: Sequence[str], rows: Sequence[Sequence[str]], *notes: str) -> str:
    """Return a table in Markdown, followed by its notes, one paragraph each."""

    def line(cells: Sequence[str]) -> str:
        return "|" + "|".join(f" {cell} " if cell else " " for cell in cells) + "|"

    lines = [line(heads), "|---" * len(heads) + "|", *map(line, rows), *(f"\n{note}" for note in notes)]
    return "\n".join(lines)


def with_interval(value: float, interval: Sequence[float] | None) -> str:
    """Return the text of an error in nm, with its confidence interval if there is one."""
    return f"{value:.2f} nm" + (f" ({interval[0]:.2f} … {interval[1]:.2f})" if interval else "")
