"""Check reports in a browser. There are no errors, nothing is wider than a phone, and all pictures and words
are visible.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from litho_data.reports.page import Page, spelt_out
from litho_data.reports.pictures import (
    DARK,
    LIGHT,
    colour_bar_png,
    coloured_png,
    model_colour,
    new_figure,
)
from litho_design import compare, hologram_settings
from litho_models.evaluation.benchmark import benchmark
from tests.browser import DESK_PX, FAULTS, PHONE_PX, Browser, browser_path
from tests.litho_models.prints import make_scans, write_store

pytestmark = pytest.mark.pictures
# The largest height of a report, in screens, while its foldable part is closed.
MOST_SCREENS = 6
TINY = {
    "layout.size_px": 64,
    "optics.distance_um": 12,
    "search.iterations": 2,
    "search.polish_rounds": 0,
    "window.yield_draws": 5,
}


@pytest.fixture(scope="module")
def browser():
    if browser_path() is None:
        pytest.skip("Chromium is not installed on this machine")
    with Browser() as one:
        yield one


@pytest.fixture(scope="module")
def reports(tmp_path_factory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("reports")
    store = write_store(folder / "made.zarr", make_scans(6, size_px=64))
    benchmark(store, folder / "benchmark", models=("identity", "affine"), folds=2)
    settings = hologram_settings(changes=TINY)
    compare(settings, {"none": "none", "physics": "zoo:physics"}, folder / "gap", target="ring", seeds=(0,))
    every_part().write(folder)
    return {
        "every part": folder / "report.html",
        "benchmark": folder / "benchmark" / "report.html",
        "gap": folder / "gap" / "report.html",
        "design": folder / "gap" / "designs" / "physics" / "seed0" / "report.html",
    }


def every_part() -> Page:
    words = {"mae_abs_nm": ("error (nm)", "how far off it is")}
    page = Page("Every part", "a lead", facts={"dataset": "0123456789abcdef" * 4}, words=words)
    page.verdict("pbl is best.")
    page.tiles([("1 nm", "error"), ("2", "scans")])
    page.note("Do not overlook that less < more with --one-option.")
    page.heading("Folded", folded=True)
    page.code("x" * 200)
    values = [3.0, 20.0, float("nan"), 100.0]
    frame = pd.DataFrame(
        {"model": ["pbl", "fno", "linear", "own"], "mae_abs_nm": values}
        | {f"a_column_of_many_{n}": ["some words"] * 4 for n in range(12)}
    )
    page.table(frame, "numbers", "table.csv")
    image = np.add.outer(np.arange(20.0), np.arange(20.0))
    picture = coloured_png(image, "viridis", 0, 38)
    page.gallery([("height", colour_bar_png("viridis"))] * 5, [("P1", [picture] * 5)], "gallery")
    figure = new_figure(11, 3)
    for axes in figure.subplots(1, 3):
        shown = axes.imshow(image)
        figure.colorbar(shown, ax=axes, label="nm")
    page.figure(figure, "maps")
    page.links([("elsewhere.html", "a link")])
    return page


@pytest.mark.parametrize("name", ["every part", "benchmark", "gap", "design"])
def test_a_report_is_sound_on_every_screen(browser, reports, name):
    for width_px in (DESK_PX, PHONE_PX):
        browser.show(reports[name], width_px, dark=False)
        height = browser.run("document.documentElement.scrollHeight")
        assert height <= MOST_SCREENS * browser.run("innerHeight")
        browser.run("document.querySelectorAll('details').forEach(one => one.open = true)")
        for dark in (False, True):
            browser.screen(width_px, dark)
            assert browser.run("getComputedStyle(document.body).backgroundColor") == shown_as(dark)
            assert browser.run(FAULTS) == []
        assert browser.errors == []


def shown_as(dark: bool) -> str:
    paper = (DARK if dark else LIGHT)["paper"]
    return "rgb({}, {}, {})".format(*(int(paper[at : at + 2], 16) for at in (1, 3, 5)))


def test_what_is_wrong_with_a_page_is_found(browser, tmp_path):
    """Check that each kind of fault is found on a page that has them all."""
    blank = "data:image/svg+xml,<svg xmlns='http://www.w3.org/2000/svg' width='9' height='9'></svg>"
    (tmp_path / "bad.html").write_text(
        f'<p style="color:#999">pale</p><div style="width:2000px">wide</div><img src="none.png">'
        f'<img src="{blank}"><script>console.error("oh"); nothing()</script>',
        encoding="utf-8",
    )
    browser.show(tmp_path / "bad.html", PHONE_PX, dark=False)
    assert sorted(browser.run(FAULTS)) == [
        'contrast of "pale"', "picture not decoded", "picture without content", "wider than the screen",
    ]  # fmt: skip
    assert len(browser.errors) >= 3


def test_a_click_sorts_by_number_with_gaps_last_and_a_second_click_reverses_the_order(browser, reports):
    browser.show(reports["every part"], DESK_PX, dark=False)
    rows = "[...document.querySelectorAll('table.data tbody tr')]"
    orders = []
    for _ in range(2):
        browser.run("document.querySelectorAll('table.data th button')[1].click()")
        orders.append(browser.run(f"{rows}.map(row => row.cells[0].textContent.trim())"))
    assert orders == [["pbl", "fno", "own", "linear"], ["own", "fno", "pbl", "linear"]]


def test_a_tap_enlarges_a_wide_figure_on_a_telephone(browser, reports):
    """Check that a wide figure fits the screen at first, and that a tap enlarges it and lets it scroll."""
    browser.show(reports["every part"], PHONE_PX, dark=False)
    browser.run("document.querySelector('details').open = true")
    browser.ask("Emulation.setFocusEmulationEnabled", enabled=True)
    widths = []
    for _ in range(2):
        widths.append(browser.run("document.querySelector('.wide img').clientWidth"))
        assert browser.run("document.documentElement.scrollWidth") <= PHONE_PX
        browser.run("document.querySelector('.wide').focus()")
    assert widths[0] < PHONE_PX
    assert widths[1] > 1.5 * PHONE_PX


def test_tables_have_names_for_people_and_the_csv_keeps_the_keys(reports):
    for report in reports.values():
        heads = re.findall(r"<th[^>]*>(?:<button>)?([^<]*)", report.read_text("utf-8"))
        assert len(heads) > 5
        assert not [head for head in heads if "_" in head]
    text = reports["every part"].read_text("utf-8")
    assert "how far off it is" in text
    assert "mae_abs_nm" in (reports["every part"].parent / "table.csv").read_text("utf-8")
    assert spelt_out("a_rough_edge_um") == "a rough edge (µm)"


def test_the_comparison_leads_to_every_design(reports):
    gap = reports["gap"]
    links = re.findall(r'href="(designs/[^"]+)"', gap.read_text("utf-8"))
    assert sorted(links) == [f"designs/{arm}/seed0/report.html" for arm in ("none", "physics")]
    assert all((gap.parent / link).is_file() for link in links)


def test_an_option_in_a_sentence_stays_in_one_piece_and_signs_are_escaped(reports):
    text = reports["every part"].read_text("utf-8")
    assert 'less &lt; more with <span class="option">--one-option</span>.' in text


def test_the_foot_says_how_the_page_was_made(reports):
    text = reports["benchmark"].read_text("utf-8")
    foot = text[text.index("<footer>") :]
    assert re.search(r"<dt>dataset</dt><dd>[0-9a-f]{64}</dd>", foot)
    assert all(f"<dt>{name}</dt>" in foot for name in ("seeds", "litholoop", "torch"))


def test_colours_stand_out_from_both_papers():
    """Check the contrasts that WCAG 2 requires, in figures too: 4.5 for words, and 3 for lines and bars."""
    for colours in (LIGHT, DARK):
        for ink in ("ink", "soft", "accent"):
            assert min(contrast(colours[ink], colours[ground]) for ground in ("paper", "band")) >= 4.5
        models = ("identity", "affine", "blur-table", "linear", "physics", "pbl", "fno", "features", "my-own")
        assert min(contrast(model_colour(name), colours["paper"]) for name in models) >= 3
    assert model_colour("pbl") != model_colour("physics") != model_colour("fno")


def contrast(first: str, second: str) -> float:
    def light(colour: str) -> float:
        channels = np.array([int(colour[at : at + 2], 16) for at in (1, 3, 5)]) / 255
        linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
        return float(linear @ (0.2126, 0.7152, 0.0722))

    low, high = sorted((light(first), light(second)))
    return (high + 0.05) / (low + 0.05)
