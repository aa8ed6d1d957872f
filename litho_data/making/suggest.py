"""Compare levelling recipes on three scans of a dataset card. The suggested recipe is the one whose levelled
heights agree best with the layout.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import ndimage

from litho_data.cards.listing import list_fields
from litho_data.foundation import Array, InputError, atomic_file
from litho_data.level.layout_aware import level_hats
from litho_data.level.recipe import Recipe
from litho_data.making.jobs import FieldJob, field_jobs
from litho_data.making.operations import load_recipe

if TYPE_CHECKING:
    from litho_data.reports.page import Page

RECIPES: dict[str, str] = {
    "plane": """[[step]]
op = "layout-aware"
""",
    "plane and bow": """[[step]]
op = "layout-aware"
total_degree = 2
""",
    "plane and bow to degree 3": """[[step]]
op = "layout-aware"
total_degree = 3
""",
    "lines, then plane and bow": """[[step]]
op = "align-rows"
method = "median-of-differences"

[[step]]
op = "layout-aware"
total_degree = 2
""",
    "plane and bow, then lines": """[[step]]
op = "layout-aware"
total_degree = 2

[[step]]
op = "align-rows"
method = "median-of-differences"
""",
}
"""The recipes that are compared, from the simplest to the most complex."""
_SCANS = 3
# A recipe is preferred to a simpler recipe only if its residual is less than this share of the simpler
# recipe's residual.
_BETTER = 0.95
_BLOCK_PX, _BORDER_PX, _BLUR_PX = 16, 6, 1.5
_LEVEL_LINE = re.compile(r"^[ \t]*(process[ \t]*\.[ \t]*)?level[ \t]*=.*$\n?", re.MULTILINE)
_PROCESS = re.compile(r"^[ \t]*\[[ \t]*process[ \t]*\][ \t]*(#.*)?$", re.MULTILINE)


@dataclass(frozen=True)
class Suggestion:
    """The suggested recipe, and the residuals of all recipes in nm.

    ``left_nm[recipe][scan]`` is the root mean square of the residual, which is the part of the levelled
    heights that the layout does not explain. The residual is computed in blocks that were held out of the
    fit. ``warned`` maps recipes to the warnings about them. ``card`` is the path of the card that was
    written.
    """

    recipe: str
    left_nm: Mapping[str, Mapping[str, float]]
    warned: Mapping[str, str]
    card: Path


def suggest_recipe(
    card_path: str | Path, out: str | Path, *, data_dir: str | Path | None = None
) -> Suggestion:
    """Compare recipes on three scans of a card. Write the best recipe, a card that uses it, and a page with
    pictures.

    The field is divided into blocks of 16 px. In half of the blocks, a piecewise linear function of the
    blurred level is fitted to the levelled heights. The recipes are compared by the residual of this fit in
    the other half of the blocks. This residual contains both the tilt that a recipe fails to remove and the
    part of the print that the recipe wrongly removes. A recipe is not suggested if it cannot be applied to
    one of the scans, or if one of its steps gives a warning. For example, the alignment of rows warns if it
    shifts lines that probably had no offset.

    Args:
        card_path: path of the card. ``<card>.suggested.toml`` and ``<card>.recipe.toml`` are written beside
            it.
        out: folder of the page.
        data_dir: folder of the raw files, as for ``build_dataset``.

    Raises:
        InputError: the card is bad or describes micrographs, no scan can be read and registered, every recipe
            gives a warning or cannot be applied, or the card is written in a form to which the line with the
            name of the best recipe cannot be added.
    """
    listing = list_fields(card_path, data_dir)
    if listing.card.scan.instrument == "sem":
        raise InputError("scans for comparing recipes", got="micrographs", wanted="scans of heights")
    jobs = [job for job in field_jobs(listing, load_recipe(None)) if job.field.use == "dataset"]
    # Three scans far apart in the list are tried first. If one of them cannot be used, another scan is tried.
    places = np.unique(np.linspace(0, len(jobs) - 1, min(_SCANS, len(jobs))).astype(int)).tolist()
    places += [place for place in range(len(jobs)) if place not in places]
    left: dict[str, dict[str, float]] = {name: {} for name in RECIPES}
    warned: dict[str, str] = {}
    pictures: dict[str, list[Array]] = {}
    refusal = ""
    for job in (jobs[place] for place in places):
        if len(pictures) == _SCANS:
            break
        try:
            raw_um, layout, mask = _located(job)
        except InputError as error:
            refusal = f"{job.id}: {error}"
            continue
        pictures[job.id] = [raw_um]
        for name, text in RECIPES.items():
            height_um, note = _levelled(text, raw_um, layout, mask)
            seen_um = height_um if mask is None else np.where(mask, np.nan, height_um)
            left[name][job.id] = 1e3 * left_by_layout(seen_um, layout)
            pictures[job.id].append(height_um)
            warned |= {name: note} if note else {}
    if not pictures:
        raise InputError("scans for comparing recipes", got=refusal, wanted="a scan that registers")
    usual = {name: float(np.median(list(of.values()))) for name, of in left.items() if name not in warned}
    if not usual:
        raise InputError(
            "recipes to compare", got="; ".join(warned.values()), wanted="a recipe that can be applied"
        )
    best = _best(usual)
    card = _write_card(Path(card_path), best)
    suggestion = Suggestion(best, left, warned, card)
    _write_page(suggestion, pictures, Path(out))
    return suggestion


def _best(left_nm: Mapping[str, float]) -> str:
    """Return the name of the recipe with the smallest residual. If simpler recipes have nearly the same
    residual, return the simplest of them. ``left_nm`` lists the recipes from the simplest to the most
    complex.
    """
    least = min(left_nm.values())
    return next(name for name, left in left_nm.items() if left * _BETTER <= least)


def _located(job: FieldJob) -> tuple[Array, Array, Array | None]:
    """Return three arrays with the shape (ny, nx) of the scan: the raw heights in µm; the levels of the
    layout in the frame of the scan, NaN outside the layout; and the file's mask of pixels that levelling
    ignores, or None if the file has no mask.
    """
    chain = job.begin()
    chain.run("locate", job.register_params(chain))
    arrays = chain.arrays
    return arrays["raw_height_um"].astype(float), arrays["layout_in_scan"], arrays.get("vendor_mask")


def _levelled(recipe: str, raw_um: Array, layout: Array, mask: Array | None) -> tuple[Array, str]:
    """Return the levelled heights, and a text with the warnings of the recipe's steps. If the recipe cannot
    be applied, return the raw heights and the reason.
    """
    try:
        steps = Recipe.from_dict(tomllib.loads(recipe))
        levelled, notes = steps.apply_noting(raw_um, mask=mask, layout_level=layout)
    except InputError as error:
        return raw_um, str(error)
    return levelled.height, "; ".join(notes)


def left_by_layout(height_um: Array, layout: Array) -> float:
    """Return the root mean square, in µm, of the part of the heights that the layout does not explain.

    A piecewise linear function of the blurred level is fitted to the heights in half of the blocks of the
    field. The result is computed from the residuals of this fit in the other half of the blocks.

    Args:
        height_um: levelled heights in µm, shape (ny, nx), NaN where not measured.
        layout: levels of the layout in the frame of the scan, shape (ny, nx), NaN outside the layout.
    """
    known = np.isfinite(layout)
    inner = known & np.isfinite(height_um) & (ndimage.distance_transform_edt(known) > _BORDER_PX)
    level = ndimage.gaussian_filter(np.where(known, layout, 0.0), _BLUR_PX)
    y, x = np.indices(layout.shape) // _BLOCK_PX
    fitted = inner & ((y + x) % 2 == 0)
    design = level_hats(level[inner], int(level[inner].max()) + 1).T
    response, *_ = np.linalg.lstsq(design[fitted[inner]], height_um[fitted], rcond=None)
    off = (height_um[inner] - design @ response)[~fitted[inner]]
    return float(np.sqrt(np.mean(off**2)))


def _write_card(card: Path, best: str) -> Path:
    """Write the recipe, and a copy of the card in which ``process.level`` names this recipe. The other text
    of the card stays unchanged. Return the path of the copy.

    Raises:
        InputError: the line with the recipe's name cannot be added to the card, for example because the
            card's table ``process`` is written on one line.
    """
    recipe, target = card.with_suffix(".recipe.toml"), card.with_suffix(".suggested.toml")
    before = card.read_text(encoding="utf-8")
    wanted = tomllib.loads(before)
    text, line = _LEVEL_LINE.sub("", before), f'level = "{recipe.name}"'
    if heading := _PROCESS.search(text):
        text = f"{text[: heading.end()]}\n{line}{text[heading.end() :]}"
    elif "process" in wanted:
        # The table consists of lines such as ``process.tip = 0.01``, which stand before all headings.
        text = f"process.{line}\n{text}"
    else:
        text = f"{text.rstrip()}\n\n[process]\n{line}\n"
    wanted["process"] = {**wanted.get("process", {}), "level": recipe.name}
    if not _says(text, wanted):
        raise InputError(
            f"card {card}: table process",
            got="no line where the recipe can be named",
            wanted="a heading [process], and one line for each key",
            hint=f"the best recipe is {best!r}",
        )
    for path, content in ((recipe, f'name = "{best}"\n\n{RECIPES[best]}'), (target, text)):
        with atomic_file(path) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return target


def _says(text: str, content: Mapping[str, Any]) -> bool:
    """Return whether a text is valid TOML and has the given content."""
    try:
        return tomllib.loads(text) == content
    except tomllib.TOMLDecodeError:
        return False


def _write_page(found: Suggestion, pictures: Mapping[str, Sequence[Array]], folder: Path) -> None:
    from litho_data.reports.page import Page

    page = Page(
        "Which levelling recipe",
        "Recipes are compared on scans of the card: how much of the heights does the layout not explain?",
    )
    page.verdict(
        f"Level with the recipe \u201c{found.recipe}\u201d: build the dataset from {found.card.name}."
    )
    rows = [
        {"recipe": name, **of} | ({"warning": found.warned.get(name, "")} if found.warned else {})
        for name, of in found.left_nm.items()
    ]
    caption = "Part of the levelled heights that the layout does not explain (rms), in nm, by scan"
    page.table(rows, caption, "recipes.csv", digits=1)
    _show(page, pictures)
    page.write(folder)


def _show(page: Page, pictures: Mapping[str, Sequence[Array]]) -> None:
    from litho_data.reports.pictures import colour_bar_png, coloured_png, limits, thumbnail

    rows, bar = [], colour_bar_png("cividis")
    for name, images in pictures.items():
        shown = []
        for image in images:
            shown.append(coloured_png(thumbnail(image), "cividis", *limits(image)))
        rows.append((name, shown))
    columns = [(title, bar) for title in ("raw", *RECIPES)]
    page.gallery(
        columns,
        rows,
        "Heights before levelling and after each recipe. Each picture has its own colour scale.",
    )
