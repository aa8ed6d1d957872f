"""Draw the rooms of the three packages for docs/architecture.md: `python docs/figures/draw_rooms.py`.

The order is that of the law in `tests/test_architecture.py`. The picture is narrow: a phone shows it whole.
"""

from __future__ import annotations

import sys
from html import escape
from pathlib import Path

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER.parents[1]))

from tests.test_architecture import ROOMS  # noqa: E402

OUT = FOLDER / "rooms.svg"
WIDTH, MARGIN, GAP, LINE, HEAD, LETTER = 400, 12, 7, 27, 30, 7.3
FLOW = (
    ("raw files, layouts, a card", "litho_data", "#e3f0e6"),
    ("dataset store  (prints.zarr)", "litho_models", "#e4ecf8"),
    ("frozen model  (weights, card.json)", "litho_design", "#fbeee0"),
    ("design, its score, files for the printer", None, ""),
)


def main() -> None:
    """Write the picture."""
    parts: list[str] = []
    top = MARGIN
    for number, (what, package, colour) in enumerate(FLOW):
        top = _arrow(parts, what, top, first=number == 0, last=package is None)
        if package is not None:
            top = _package(parts, package, colour, top)
    OUT.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {top + MARGIN}" width="{WIDTH}" '
        f'font-family="sans-serif" font-size="13" fill="#222">\n'
        f'<rect width="{WIDTH}" height="{top + MARGIN}" fill="#fff"/>\n' + "\n".join(parts) + "\n</svg>\n",
        encoding="utf-8",
    )


def _arrow(parts: list[str], what: str, top: int, *, first: bool, last: bool) -> int:
    """What passes from one package to the next, with the arrows into and out of it; the place below."""
    middle = WIDTH // 2
    if not first:
        parts.append(_down(middle, top, top + 14))
        top += 18
    parts.append(_text(middle, top + 12, what, "middle", 'font-style="italic"'))
    top += 20
    if not last:
        parts.append(_down(middle, top, top + 14))
        top += 18
    return top


def _package(parts: list[str], package: str, colour: str, top: int) -> int:
    """The frame of a package with its rooms in the order of imports; the place below."""
    rooms: list[str] = []
    left, row = MARGIN + 10, top + HEAD
    for number, room in enumerate(ROOMS[package], start=1):
        label = f"{number} {room}"
        wide = round(len(label) * LETTER + 14)
        if left + wide > WIDTH - MARGIN - 10:
            left, row = MARGIN + 10, row + LINE + GAP
        rooms.append(
            f'<rect x="{left}" y="{row}" width="{wide}" height="{LINE}" rx="5" fill="#fff" stroke="#888"/>'
        )
        rooms.append(_text(left + wide // 2, row + 18, label, "middle"))
        left += wide + GAP
    bottom = row + LINE + 10
    parts.append(
        f'<rect x="{MARGIN}" y="{top}" width="{WIDTH - 2 * MARGIN}" height="{bottom - top}" rx="8" '
        f'fill="{colour}" stroke="#999"/>'
    )
    parts.append(_text(MARGIN + 10, top + 20, package, "start", 'font-weight="bold"'))
    parts += rooms
    return bottom + 4


def _down(x: int, top: int, bottom: int) -> str:
    return (
        f'<path d="M{x} {top}V{bottom - 4}" stroke="#555" stroke-width="1.5"/>'
        f'<path d="M{x - 4} {bottom - 5}h8l-4 6z" fill="#555"/>'
    )


def _text(x: int, y: int, text: str, anchor: str, more: str = "") -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}" {more}>{escape(text)}</text>'


if __name__ == "__main__":
    main()
