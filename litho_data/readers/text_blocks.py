"""Divide text files into blocks of numbers. The lines of words above a block become its header."""

import codecs
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from litho_data.foundation import YX, InputError, Shape, is_length, table_beside, um_per
from litho_data.readers.reader import DAMAGED

# In these expressions, two successive repetitions never match the same characters. Otherwise, matching a long
# line of blanks or digits would take hours.
NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eEdD][-+]?\d+)?|[-+]?nan|[-+]?inf(inity)?", re.IGNORECASE)
_LEADING_NUMBER = re.compile(r"[-+\d.,eE]+")
_ASSIGNMENT = re.compile(r"[:=]")
_KEY = re.compile(r"[\w ()>./-]+")
# A semicolon does not start a comment here, because it may also precede the first cell of a row. An error in
# a spreadsheet's cell, such as #N/A, is not a comment although it begins like one.
_COMMENT = re.compile(r"[#%](?!(N/A|NV|NULL|NUM|ZAHL|NOMBRE|DIV|VALUE|WERT|VALEUR|REF|BEZUG|NAME)\b)")
_SEPARATORS = re.compile(r"[\s;]+|,\s*")
_STRANGE = re.compile(r"[\x00-\x08\x0b\x0e-\x1f]")
_LOOKED_AT = 400
_FEWEST_NULS = 0.8
# A line of at least this many cells is a row if all words in it are equal, because such a word marks missing
# pixels.
_FEWEST_EQUAL = 4
_CELLS = re.compile(r"\t|;|,")
# Cells that contain a comma are matched too. Otherwise, their closing quotation mark would count as the
# opening mark of the next cell.
_QUOTED = re.compile(r'"([^",\n]*)"|("[^"\n]*")')
# Keys are compared only by their letters and digits.
_NO_LETTER = re.compile(r"[\W_]+")
WORDS = table_beside(__file__, "words.toml")
_KEYS: dict[str, list[str]] = WORDS["keys"]
# Matches the unit in the title of a column or of the whole table, as in "Height [nm]". If a number follows,
# as in "Height [nm]: 50", the line states a length and not the unit of the values.
_TITLED = re.compile(
    r"\b(?:z|h\d*|heights?|topography|höhe|hauteur|altura|altezza)"
    r"(?>(?:\b(?: (?:image|map|data|values?))?\s*(?:in\s+|[\[(]\s*)|_)([^\])\s:=,;]{1,12})[\])]?)"
    r"(?!\s*[:=\t;,]\s*[-\d])",
    re.IGNORECASE,
)
_TO_METRES = "height conversion factor (-> m)"
_SCALES = re.compile(
    r"bit2nm|(scale|conversion|calibration)[ _-]?factor|^(multiplier|scale|factor|lsb)\b|"
    r"(z|height|value|data)[ _-]?(scale|factor|multiplier|gain|offset)$"
)
# Matches a scale in prose, such as "multiply by 10" or "heights in 0.1 nm".
_SCALE_IN_WORDS = re.compile(
    r"\b(multipl(y|ied)|divided?) by\b|\b(counts?|digits?|bits?|lsb)\s*=\s*\d[\d.e-]* ?([nuµμ]?m|Å)\b|"
    r"\b(z|heights?|values?|data)\b.{0,8}(\bin|\bx|[×*]) ?(?!1 )\d[\d.e^-]* ?([nuµμ]?m|Å)\b",
    re.IGNORECASE,
)


@dataclass
class Block:
    """A block of consecutive lines of numbers, with the header that stands above it.

    ``header`` maps the keys in the header's lines to their values, and ``words`` contains these lines
    unchanged. ``rows`` contains the lines of numbers as text. ``first_line`` states in which line of the file
    the first row stands.
    """

    header: dict[str, str]
    words: list[str]
    first_line: int
    rows: list[str] = field(default_factory=list)

    def first(self, *keys: str) -> str:
        """Search the header for the keys, in the given order, and return the value of the first key found. If
        the header contains none of the keys, return an empty text. Each key also stands for its translations
        in ``words.toml``.
        """
        lower = {_NO_LETTER.sub("", key.lower()): value for key, value in self.header.items()}
        return next((lower[name] for key in keys for name in _KEYS.get(key, [key]) if name in lower), "")

    @property
    def name(self) -> str:
        """Return the name of the channel, or an empty string if the header states none."""
        return self.first("channel")

    @property
    def unit(self) -> str | None:
        """Return the unit of the values; None if the header states none."""
        if self.factor is not None:
            return "m"
        titled = [unit for text in self.words for unit in _TITLED.findall(text[:200])]
        lengths = [unit for unit in titled if is_length(unit)]
        others = [unit for unit in titled if unit in WORDS["units"]["no_lengths"]]
        return self.first("unit").strip("[]() ") or next(iter(lengths + others), None)

    def require_pixels(self, shape: Shape) -> None:
        """Check that ``shape`` agrees with the numbers of rows and columns, if the header states them.

        Raises:
            InputError: the header states other numbers.
        """
        for count, what in zip(shape, ("rows", "columns"), strict=True):
            stated = self.first(what)
            if stated.isdecimal() and int(stated) != count:
                raise InputError(f"number of {what}", got=count, wanted=f"{stated} as in the header")

    @property
    def factor(self) -> float | None:
        """Return the factor that converts the values to metres, or None if the header states no such factor.

        Raises:
            InputError: the header contains a scale factor of unknown meaning.
        """
        if NUMBER.match(self.header.get(_TO_METRES, "")):
            return number(self.header[_TO_METRES])
        refuse_scales(self.header)
        for text in self.words:
            if _SCALE_IN_WORDS.search(text[:200]):
                raise InputError(
                    "a scale in the header", got=repr(text[:60]), wanted="heights in a unit without a scale"
                )
        return None

    @property
    def missing(self) -> list[float]:
        """Return the numbers that mark missing pixels according to the header."""
        stated = self.first("missing")
        return [number(stated)] if NUMBER.match(stated) else []

    def size_um(self, shape: Shape) -> YX | None:
        """Return the size (y, x) in µm if the header states the pixel size or the lengths of both sides.
        Otherwise return None.
        """
        if pitch := _length_um(self.first("pixelsize", "xycalibration")):
            return shape[0] * pitch, shape[1] * pitch
        sides = [_length_um(self.first(side)) for side in ("height", "width")]
        return (sides[0], sides[1]) if sides[0] and sides[1] else None


def refuse_scales(header: Mapping[str, str]) -> None:
    """Reject a header that contains a scale factor of unknown meaning.

    Raises:
        InputError: the header contains such a scale factor.
    """
    for key, value in header.items():
        if _SCALES.search(key.lower()) and NUMBER.match(value) and number(value) not in (0.0, 1.0):
            raise InputError(f"a scale in the header, {key} = {value}", wanted="a known scale")


def read_text(path: Path) -> str:
    """Return the text of a file, with lines separated by ``\\n``.

    The encoding may be UTF-8, UTF-16 or Latin-1.

    Raises:
        InputError: the file begins like UTF-16 but is not valid UTF-16, or it contains bytes that do not
            occur in text. In the second case, the message names the line.
    """
    raw = path.read_bytes()
    halves = {"utf-16-be": raw[:_LOOKED_AT:2], "utf-16-le": raw[1:_LOOKED_AT:2]}
    if raw.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        code = "utf-16"
    else:
        full = (code for code, half in halves.items() if half.count(0) > _FEWEST_NULS * len(half))
        code = next(full, "utf-8-sig")
    try:
        text = raw.decode(code)
    except UnicodeDecodeError as error:
        if code != "utf-8-sig":
            raise InputError("cannot be read as UTF-16", got=error.reason, hint=DAMAGED) from error
        text = raw.decode("latin-1")
    text = without_quotes(text.replace("\r\n", "\n").replace("\r", "\n"))
    if strange := _STRANGE.search(text):
        line = text.count("\n", 0, strange.start()) + 1
        got = f"byte 0x{ord(strange[0]):02x}"
        raise InputError(f"line {line}", got=got, wanted="a text of numbers")
    return text


def without_quotes(text: str) -> str:
    """Remove the quotation marks around the cells of a text, except around cells that contain a comma."""
    return _QUOTED.sub(r"\1\2", text) if '"' in text else text


def blocks_of(text: str) -> list[Block]:
    """Find the blocks of numbers in a text. A blank line or a line of words ends a block.

    The function ``is_row`` decides whether a line is a row of numbers or a line of words. A row may contain
    words in place of some numbers. If every second line is blank, all rows belong to one block.
    """
    found = list(_blocks(text))
    if len(found) > 1 and all(len(one.rows) == 1 and not one.words for one in found[1:]):
        for one in found[1:]:
            # Empty rows are inserted so that line numbers in messages stay right.
            found[0].rows += [""] * (one.first_line - found[0].first_line - len(found[0].rows)) + one.rows
        return found[:1]
    return found


def _blocks(text: str) -> Iterator[Block]:
    block = Block({}, [], 0)
    for number_of_line, line in enumerate(text.split("\n"), start=1):
        numbers = is_row(line)
        if block.rows and not numbers:
            yield block
            block = Block({}, [], 0)
        if numbers:
            block.first_line = block.first_line or number_of_line
            block.rows.append(line)
        elif line.strip():
            block.words.append(line.strip())
            _note(line, block.header, number_of_line)
    if block.rows:
        yield block


def header_of(text: str) -> Block:
    """Return a block without rows, whose header is made from the lines of a text."""
    block = Block({}, [], 0)
    for number_of_line, line in enumerate(text.splitlines(), start=1):
        block.words.append(line.strip())
        _note(line, block.header, number_of_line)
    return block


def is_row(line: str) -> bool:
    """Return whether a line is a row of numbers. This is the case if at least half of its cells are numbers,
    and if the line is not a comment and does not consist of a key and its value.

    A word in a row marks a missing pixel. A line in which less than half of the cells are numbers is
    therefore a row too, if it has at least four cells, all its words are equal, and this word is not a unit.
    """
    if _COMMENT.match(line) or not line.strip():
        return False
    cells = cells_of(line[:_LOOKED_AT])
    if len(line) > _LOOKED_AT and len(cells) > 1:
        cells = cells[:-1]
    words = [cell for cell in cells if NUMBER.fullmatch(cell) is None]
    if len(cells) >= _FEWEST_EQUAL and len(set(words)) == 1 and not is_length(words[0].strip("[]()")):
        return True
    # `ncols 32` and `Width: 6,4 µm` are keys of a header with their values, not rows of numbers.
    starts = NUMBER.match(cells[0]) is not None
    return 2 * len(words) <= len(cells) and (
        starts or (len(cells) != 2 and not _ASSIGNMENT.search(" ".join(cells[:2])))
    )


def cells_of(line: str) -> list[str]:
    """Return the cells of a line, separated by blanks, tabs, commas or semicolons."""
    return _SEPARATORS.split(line.strip(" \t,;"))


def _note(line: str, header: dict[str, str], number_of_line: int) -> None:
    text = line.strip("#%; \t\n,")
    sign = _ASSIGNMENT.search(text) or _CELLS.search(text)
    key = text[: sign.start()].strip() if sign else ""
    plain = text.split(None, 1)
    if sign and _KEY.fullmatch(key):
        header[key] = (
            _CELLS.sub(" ", text[sign.end() :]).strip() if sign[0] in "\t;," else text[sign.end() :].strip()
        )
    elif len(plain) == 2 and len(text) < _LOOKED_AT and NUMBER.fullmatch(plain[1]):
        header[plain[0]] = plain[1]
    elif text:
        header[f"comment {number_of_line}"] = text


def number(text: str) -> float:
    """Return the number at the start of a text, or NaN if there is none. The number may be written with a
    decimal comma, and with an exponent as in Fortran.
    """
    found = NUMBER.match(text.strip())
    return float(re.sub("[dD]", "e", found[0]).replace(",", ".")) if found else float("nan")


def _length_um(text: str) -> float | None:
    lead = _LEADING_NUMBER.match(text := text.strip())
    unit = text[lead.end() :].strip(" []()") if lead else ""
    if lead is None or not is_length(unit):
        return None
    try:
        return float(lead[0].replace(",", ".")) * um_per(unit)
    except ValueError:
        return None
