"""Copies of the figures of a report, in the form that a paper needs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from litho_data.commands.app import keyword, option, takes_more
from litho_data.foundation import atomic_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Format = Literal["pdf", "svg", "png"]

# Width of one and of two columns of a two-column page.
_COLUMN_INCH, _PAGE_INCH = 3.5, 7.2
# A figure wider than this on the screen is not legible in one column.
_WIDE_INCH = 8.0
_FONT_PT, _DPI = 7.0, 300
_WANTED: ContextVar[Format | None] = ContextVar("figures for a paper", default=None)


@contextmanager
def paper_copies(figures: Format | None) -> Iterator[None]:
    """Reports that are written inside also write their figures for a paper."""
    token = _WANTED.set(figures)
    try:
        yield
    finally:
        _WANTED.reset(token)


def wanted_format() -> Format | None:
    """The format that the surrounding ``paper_copies`` asks for."""
    return _WANTED.get()


def with_paper_copies(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command that writes a report the option ``--figures``."""

    @functools.wraps(command)
    def run(**values: Any) -> None:
        with paper_copies(values.pop("figures")):
            command(**values)

    figures = Annotated[Format | None, option("also write the figures, in the widths of a paper's columns")]
    return takes_more(run, command, [keyword("figures", figures)])


def write_figures(figures: Sequence[Figure], folder: Path) -> None:
    """Write ``figure-1.pdf`` … with embedded fonts, as wide as a column or a page; changes the figures."""
    if not figures:
        return
    import matplotlib
    from matplotlib.text import Text

    format = wanted_format()
    with matplotlib.rc_context({"pdf.fonttype": 42, "svg.fonttype": "path"}):
        for number, figure in enumerate(figures, 1):
            width, height = figure.get_size_inches()
            column = _PAGE_INCH if width > _WIDE_INCH else _COLUMN_INCH
            figure.set_size_inches(column, height * column / width)
            for text in figure.findobj(Text):
                text.set_fontsize(_FONT_PT)
            with atomic_file(folder / f"figure-{number}.{format}") as temporary:
                figure.savefig(temporary, format=format, dpi=_DPI)
