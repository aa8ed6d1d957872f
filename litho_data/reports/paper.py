"""Write copies of a report's figures and tables in formats for papers."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from litho_data.commands.app import keyword, option, takes_more
from litho_data.foundation import atomic_file

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Figures = Literal["pdf", "svg", "png"]
Tables = Literal["csv", "latex", "markdown"]

# Widths in inches of one column and of both columns of a two-column page.
_COLUMN_INCH, _PAGE_INCH = 3.5, 7.2
# A figure that is wider than this on the screen would not be legible in one column.
_WIDE_INCH = 8.0
_FONT_PT, _DPI = 7.0, 300


@dataclass(frozen=True)
class PaperCopies:
    """File formats in which reports also save their figures and tables for a paper. Tables are always written
    as CSV as well.
    """

    figures: Figures | None = None
    tables: Tables = "csv"


_WANTED: ContextVar[PaperCopies | None] = ContextVar("paper copies", default=None)


@contextmanager
def paper_copies(figures: Figures | None = None, tables: Tables = "csv") -> Iterator[None]:
    """Make every report that is written inside the ``with`` block also write copies of its figures and tables
    for a paper.
    """
    token = _WANTED.set(PaperCopies(figures, tables))
    try:
        yield
    finally:
        _WANTED.reset(token)


def wanted() -> PaperCopies:
    """Return the formats requested by the ``with paper_copies(...)`` block in which this code runs."""
    return _WANTED.get() or PaperCopies()


def with_paper_copies(command: Callable[..., None]) -> Callable[..., None]:
    """Add the hidden options ``--figures`` and ``--tables`` to a command that writes a report."""

    @functools.wraps(command)
    def run(**values: Any) -> None:
        with paper_copies(values.pop("figures"), values.pop("tables")):
            command(**values)

    written = "also write the figures in this format, as wide as a paper's column"
    figures = Annotated[Figures | None, option(written, hidden=True)]
    tables = Annotated[
        Tables, option("also write the tables in this format, in addition to CSV", hidden=True)
    ]
    return takes_more(run, command, [keyword("figures", figures), keyword("tables", tables, "csv")])


def write_figures(figures: Sequence[Figure], folder: Path) -> None:
    """Write figures as ``figure-1.pdf`` … with embedded fonts, as wide as a paper's column or page.

    The size and fonts of the given figures are changed in place.
    """
    if not figures:
        return
    import matplotlib
    from matplotlib.text import Text

    ending = wanted().figures
    with matplotlib.rc_context({"pdf.fonttype": 42, "svg.fonttype": "path"}):
        for number, figure in enumerate(figures, 1):
            width, height = figure.get_size_inches()
            column = _PAGE_INCH if width > _WIDE_INCH else _COLUMN_INCH
            figure.set_size_inches(column, height * column / width)
            for text in figure.findobj(Text):
                text.set_fontsize(_FONT_PT)
            with atomic_file(folder / f"figure-{number}.{ending}") as temporary:
                figure.savefig(temporary, format=ending, dpi=_DPI)


def write_table(frame: pd.DataFrame, names: Sequence[str], csv_path: Path, digits: int) -> None:
    """Write a copy of a table beside its CSV file, in the requested format and with ``digits`` decimal
    places. Write nothing if only CSV is requested.

    Args:
        frame: the table.
        names: titles of the table's columns.
        csv_path: path of the CSV file, which has full precision.
    """
    if wanted().tables == "csv":
        return
    ending, text_of = _TEXTS[wanted().tables]
    with atomic_file(csv_path.with_suffix(ending)) as temporary:
        temporary.write_text(text_of(frame.set_axis(list(names), axis=1), digits), encoding="utf-8")


def _latex(frame: pd.DataFrame, digits: int) -> str:
    return frame.to_latex(index=False, escape=True, float_format=f"%.{digits}f", na_rep="–")


def _markdown(frame: pd.DataFrame, digits: int) -> str:
    def cell(value: object) -> str:
        if value is None or value != value:
            return "–"
        return f"{value:.{digits}f}" if isinstance(value, float) else str(value).replace("|", r"\|")

    rows = [map(cell, frame.columns), ["---"] * len(frame.columns)]
    rows += [map(cell, row) for row in frame.itertuples(index=False)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


_TEXTS: dict[str, tuple[str, Callable[[pd.DataFrame, int], str]]] = {
    "latex": (".tex", _latex),
    "markdown": (".md", _markdown),
}
