"""Write self-contained HTML reports that contain a verdict, pictures, tables and a record of the run. The
tables are also written as CSV files.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from litho_data.foundation import Facts, atomic_file, table_beside
from litho_data.foundation.run_facts import RunFacts, run_facts
from litho_data.reports.paper import wanted, write_figures, write_table
from litho_data.reports.pictures import DARK, LIGHT, model_colour, svg_address

if TYPE_CHECKING:
    import jinja2
    import pandas as pd
    from markupsafe import Markup
    from matplotlib.figure import Figure

    Table = pd.DataFrame | Facts | Iterable[Facts | BaseModel]

# Maps the key of a table's column to the title and the meaning that the page shows. The CSV file keeps the
# key.
Words = Mapping[str, Sequence[str]]

_SPELT = table_beside(__file__, "words.toml")
# Columns whose cells are names of models; each cell is shown in the colour of its model.
_OF_MODELS = {"model", "designed with", "arm", "judge"}
# Columns whose cells are keys. The page spells out these keys in the same way as the keys of columns.
_OF_KEYS = {"name", "figure", "covariate", "number", "parameter", "share of the squared error"}


class Page:
    """A report under construction; parts appear in the order in which they are added.

    Args:
        title: heading of the page: what was done, and with which data or model.
        lead: one line below the title.
        run: facts about the run that made the result; by default the facts about the run that writes the
            page.
        facts: further facts that identify the result, such as hashes and seeds, keyed by name.
        words: titles and meanings of table columns, keyed by the column's key, or a TOML file that contains
            them. The title of a column that is not listed is made from its key.
    """

    def __init__(
        self,
        title: str,
        lead: str = "",
        run: RunFacts | None = None,
        facts: Mapping[str, object] | None = None,
        words: Words | Path | None = None,
    ):
        self.title = title
        self.lead = lead
        self._run = run
        self._facts = dict(facts or {})
        known = tomllib.loads(words.read_text(encoding="utf-8")) if isinstance(words, Path) else words
        self._words: Words = known or {}
        self._sections: list[dict[str, Any]] = [{"title": "", "folded": False, "parts": []}]
        self._tables: list[tuple[str, pd.DataFrame, list[str], int]] = []
        self._figures: list[Figure] = []

    def heading(self, text: str, folded: bool = False) -> None:
        """Start a section with this heading. If ``folded``, only the heading is visible until the reader
        opens the section.
        """
        self._sections.append({"title": text, "folded": folded, "parts": []})

    def verdict(self, text: str) -> None:
        """Add the answer in plain words: what is best, by how much, and whether chance could explain it."""
        self._add("verdict", text=text)

    def paragraph(self, text: str) -> None:
        """Add a paragraph of plain text."""
        self._add("paragraph", text=text)

    def note(self, *texts: str) -> None:
        """Add a box with texts that the reader must not overlook, or nothing if there are no texts."""
        if texts:
            self._add("note", texts=texts)

    def points(self, texts: Sequence[str]) -> None:
        """Add a bulleted list with one text per item."""
        self._add("points", texts=list(texts))

    def code(self, text: str) -> None:
        """Add a text in a fixed-width font."""
        self._add("code", text=text)

    def tiles(self, tiles: Sequence[tuple[str, str]]) -> None:
        """Add a row of tiles that show the few most important numbers. Each tile is a pair (value with unit,
        label).
        """
        self._add("tiles", tiles=list(tiles))

    def links(self, links: Sequence[tuple[str, str]]) -> None:
        """Add links to files near the page. Each link is a pair (relative target, text)."""
        self._add("links", links=list(links))

    def table(
        self,
        table: Table,
        caption: str,
        csv_name: str,
        digits: int = 2,
        columns: Sequence[str] | None = None,
    ) -> None:
        """Add a sortable table; ``write`` also saves it at full precision as ``csv_name`` beside the page.

        Args:
            table: a data frame, a mapping from column names to columns, or a sequence of rows (mappings or
                records). A record inside a row becomes one column per field, named ``<key>_<field>``.
                Intervals and lists become text.
            digits: number of decimal places. Numbers that would be rounded to zero are shown with two
                significant digits.
            columns: the columns to show, in this order; all by default.
        """
        frame = _frame(table, digits)
        frame = frame if columns is None else frame.reindex(columns=list(columns))
        shown = []
        for key in map(str, frame.columns):
            name, meaning = self._words.get(key, (spelt_out(key), ""))
            shown.append({"name": name, "meaning": meaning, "numeric": frame[key].dtype.kind in "iufb"})
        rows = [
            [self._cell(value, digits, str(key)) for key, value in zip(frame.columns, row, strict=True)]
            for row in frame.itertuples(index=False)
        ]
        meanings = [(column["name"], column["meaning"]) for column in shown if column["meaning"]]
        self._add("table", caption=caption, csv=csv_name, columns=shown, rows=rows, meanings=meanings)
        self._tables.append((csv_name, frame, [str(column["name"]) for column in shown], digits))

    def figure(self, figure: Figure, caption: str) -> None:
        """Add a matplotlib figure made by :func:`new_figure`."""
        self._add("figure", caption=caption, address=svg_address(figure))
        if wanted().figures:
            self._figures.append(figure)

    def gallery(
        self, columns: Sequence[tuple[str, str]], rows: Sequence[tuple[str, Sequence[str]]], caption: str
    ) -> None:
        """Add a grid of small pictures.

        Args:
            columns: for each column, its title and its colour bar, as :func:`colour_bar_png` returns it.
            rows: for each row, its label and its pictures, one per column, as :func:`coloured_png` returns
                them.
            caption: text below the pictures.
        """
        self._add("gallery", columns=list(columns), rows=list(rows), caption=caption)

    def write(self, folder: str | Path, name: str = "report.html") -> Path:
        """Write the page, its tables and, if requested, the copies for a paper into ``folder``; return the
        page's path.
        """
        target = Path(folder)
        for csv_name, frame, names, digits in self._tables:
            with atomic_file(target / csv_name) as temporary:
                frame.to_csv(temporary, index=False)
            write_table(frame, names, target / csv_name, digits)
        write_figures(self._figures, target)
        run = self._run or RunFacts(**run_facts())
        commit = run.commit + (" with changes" if run.dirty else "")
        facts = self._facts | ({"commit": commit} if commit else {}) | run.versions
        text = _template().render(
            title=self.title,
            lead=self.lead,
            sections=self._sections,
            command=run.command,
            facts=facts.items(),
            light=LIGHT,
            dark=DARK,
        )
        with atomic_file(target / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
        return target / name

    def _cell(self, value: Any, digits: int, column: str) -> dict[str, Any]:
        if isinstance(value, str):
            colour = model_colour(value) if column in _OF_MODELS and " " not in value else None
            name = self._words.get(value, (spelt_out(value), ""))[0] if column in _OF_KEYS else value
            return {"text": name, "value": None, "colour": colour}
        number = isinstance(value, (int, float)) and value == value and not isinstance(value, bool)
        return {"text": _text(value, digits), "value": value if number else None, "colour": None}

    def _add(self, kind: str, **part: Any) -> None:
        self._sections[-1]["parts"].append({"kind": kind, **part})


def _frame(table: Table, digits: int) -> pd.DataFrame:
    import pandas as pd

    if isinstance(table, (pd.DataFrame, Mapping)):
        return pd.DataFrame(table)
    return pd.DataFrame([dict(_cells(row, digits)) for row in table])


def _cells(row: Facts | BaseModel, digits: int, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield pairs (column name, value) for a row of a table. A record inside the row yields one pair per
    field.
    """
    for key, value in (row.model_dump() if isinstance(row, BaseModel) else row).items():
        if isinstance(value, Mapping | BaseModel):
            yield from _cells(value, digits, f"{prefix}{key}_")
        elif isinstance(value, tuple) and len(value) == 2 and all(isinstance(end, float) for end in value):
            yield prefix + key, " … ".join(f"{end:.{digits}f}" for end in value)
        else:
            yield prefix + key, ", ".join(map(str, value)) if isinstance(value, list | tuple) else value


@cache
def _template() -> jinja2.Template:
    import jinja2

    text = Path(__file__).with_name("page.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, trim_blocks=True)
    environment.filters["whole_options"] = _whole_options
    return environment.from_string(text)


def filled(template: Path, **values: object) -> str:
    """Fill a Jinja template with the values that it names, and return the text."""
    return _plain(template).render(values)


def sentences(template: Path, about: str, one: object) -> str:
    """Call the macro named ``about`` of a Jinja template with the argument ``one``, and return the resulting
    text as a single line.
    """
    return " ".join(getattr(_plain(template).module, about)(one).split())


@cache
def _plain(template: Path) -> jinja2.Template:
    import jinja2

    environment = jinja2.Environment(
        trim_blocks=True, keep_trailing_newline=True, undefined=jinja2.StrictUndefined
    )
    environment.filters["without_unit"] = lambda key: spelt_out(key).partition(" (")[0]
    return environment.from_string(template.read_text(encoding="utf-8"))


def _whole_options(text: str) -> Markup:
    """Prevent line breaks inside the command options that a text mentions."""
    from markupsafe import Markup, escape

    return Markup(
        re.sub(r"(?<![\w-])--[a-z][a-z-]*", r'<span class="option">\g<0></span>', str(escape(text)))
    )


def capitalised(text: str) -> str:
    """Return the text with a capital first letter and the rest unchanged."""
    return text[:1].upper() + text[1:]


def spelt_out(key: str) -> str:
    """Make a readable title from the key of a column; for example, ``mae_abs_nm`` becomes "MAE abs (nm)"."""
    if "_" not in key:
        return _SPELT["short"].get(key, key)
    head, _, more = key.partition(" ")
    if more and "_" in head:
        return f"{spelt_out(head)}, {more}"
    head, between, more = key.partition("_sd_between_")
    if between:
        return f"{spelt_out(head)}, standard deviation between {more}"
    words, unit = key, ""
    for suffix, text in _SPELT["units"].items():
        if key.endswith(f"_{suffix}"):
            words, unit = key.removesuffix(f"_{suffix}"), f" ({text})"
            break
    return " ".join(_SPELT["short"].get(word, word) for word in re.split("_+", words)) + unit


def _text(value: Any, digits: int) -> str:
    if value is None or (isinstance(value, float) and value != value):
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        small = 0 < abs(value) < 10**-digits
        return f"{value:.2g}" if small else f"{value:.{digits}f}"
    return f"{value:,}" if isinstance(value, int) and abs(value) >= 10_000 else str(value)
