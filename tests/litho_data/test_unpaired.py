"""Check that the report of a build counts scans without a layout and layouts without a scan."""

from __future__ import annotations

import re
import shutil

import pytest
from typer.testing import CliRunner

import litho_data
from litho_data.cli.app import app
from litho_data.foundation.errors import InputError
from tests.litho_data.campaigns import write_campaign


def test_a_scan_without_layout_is_counted_and_refused_under_strict(tmp_path):
    card = litho_data.simulate(tmp_path / "fab", count=2, size_px=128)
    sorted((card.parent / "layouts").iterdir())[0].unlink()
    words = ["build", str(card), "--out", str(tmp_path / "few.zarr")]
    said = CliRunner().invoke(app, words, catch_exceptions=False)
    assert "1 scans, 0 skipped, 1 without layout or scan, " in said.stdout
    assert "no file " in said.stderr
    with pytest.raises(InputError, match="1 ids cannot be used"):
        litho_data.build_dataset(card, tmp_path / "strict.zarr", strict=True)


def test_the_report_names_an_unpaired_id_until_it_is_gone(tmp_path):
    card = write_campaign(tmp_path, count=1)
    extra, report = tmp_path / "layouts" / "P19.tif", tmp_path / "prints-report"
    shutil.copy(tmp_path / "layouts" / "P11.tif", extra)
    for names, tables in ((["P19"], True), ([], False)):
        result = litho_data.build_dataset(card, tmp_path / "prints.zarr")
        assert [one.scan for one in result.findings] == names
        assert ("Good: all 1 scans" in (report / "report.html").read_text()) != tables
        assert (report / "left_out.csv").exists() == (report / "findings.csv").exists() == tables
        extra.unlink(missing_ok=True)


def test_a_missing_card_and_a_single_size_are_reported_in_words(tmp_path):
    with pytest.raises(InputError) as missing:
        litho_data.build_dataset(tmp_path / "no.toml", tmp_path / "s.zarr")
    assert "no such file or directory, wanted a TOML file" in str(missing.value)
    assert "Errno" not in str(missing.value)
    card = litho_data.simulate(tmp_path / "fab", count=1, size_px=128)
    card.write_text(re.sub(r"^size_um = .*$", "size_um = 54", card.read_text(), flags=re.MULTILINE))
    with pytest.raises(
        InputError, match=r"54, got one value, wanted two values, y and x, such as \[54, 54\]"
    ):
        litho_data.build_dataset(card, tmp_path / "s.zarr")
