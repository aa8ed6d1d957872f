"""Check copies of figures and tables for a paper: their widths, fonts and escaped characters."""

from __future__ import annotations

import re

import pytest

from litho_data.reports.page import Page
from litho_data.reports.paper import paper_copies
from litho_data.reports.pictures import new_figure

POINTS_PER_INCH = 72


def page() -> Page:
    report = Page("Title", words={"share_of": ["share_of a | b", ""]})
    for width in (6.0, 12.0):
        figure = new_figure(width, 3.0)
        axes = figure.subplots()
        axes.plot([0, 1])
        axes.set(xlabel="x, µm", ylabel="height, µm")
        report.figure(figure, "")
    report.table({"model": ["a_b"], "share_of": [12.345678]}, "50 %", "shares.csv", digits=1)
    return report


def test_figures_are_as_wide_as_columns_with_their_fonts_in_them(tmp_path):
    with paper_copies(figures="pdf"):
        page().write(tmp_path)
    for number, inches in ((1, 3.5), (2, 7.2)):
        pdf = (tmp_path / f"figure-{number}.pdf").read_bytes()
        width = float(re.search(rb"/MediaBox \[ 0 0 ([\d.]+)", pdf)[1])
        assert width == pytest.approx(inches * POINTS_PER_INCH, abs=0.01)
        # A TrueType font is embedded as a file. Publishers refuse Type 3 fonts, which have no such file.
        assert b"/FontFile2" in pdf
        assert b"/Type3" not in pdf


def test_text_of_an_svg_needs_no_font(tmp_path):
    with paper_copies(figures="svg"):
        page().write(tmp_path)
    assert "<text" not in (tmp_path / "figure-1.svg").read_text("utf-8")


def test_tables_escape_the_special_characters_of_their_language(tmp_path):
    with paper_copies(tables="latex"):
        page().write(tmp_path)
    with paper_copies(tables="markdown"):
        page().write(tmp_path)
    latex = (tmp_path / "shares.tex").read_text("utf-8")
    assert r"model & share\_of a | b \\" in latex
    assert r"a\_b & 12.3 \\" in latex
    table = (tmp_path / "shares.md").read_text("utf-8").splitlines()
    assert table == [r"| model | share_of a \| b |", "| --- | --- |", "| a_b | 12.3 |"]
    assert "12.345678" in (tmp_path / "shares.csv").read_text("utf-8")


def test_no_copies_are_written_unless_requested(tmp_path):
    with paper_copies(figures="png", tables="latex"):
        pass
    page().write(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "shares.csv"}
