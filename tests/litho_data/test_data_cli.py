"""Check the command line: exit code 2 and one line for bad input, code 1 for a changed store, else 0."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from typer.testing import CliRunner

from litho_data.cli.app import app
from litho_data.making.result import report_folder
from litho_data.store import open_store
from tests.litho_data.campaigns import card_text

run = CliRunner()


def test_a_recipe_is_suggested_for_the_card_in_a_folder_beside_the_store(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[Path, ...]] = []

    def suggest(card: Path, folder: Path, *, data_dir: Path) -> SimpleNamespace:
        asked.append((card, folder, data_dir))
        left, warned = {"plane": {"P11": 1.25}, "lines": {"P11": 4}}, {"lines": "moves lines"}
        return SimpleNamespace(left_nm=left, warned=warned, recipe="plane", card="new.toml")

    monkeypatch.setattr("litho_data.making.suggest.suggest_recipe", suggest)
    words = [
        "build",
        "card.toml",
        "--suggest",
        "--out",
        str(tmp_path / "a.zarr"),
        "--data-dir",
        str(tmp_path),
    ]
    said = run.invoke(app, words).stdout.splitlines()
    folder = tmp_path / "a-levelling"
    assert asked == [(Path("card.toml"), folder, tmp_path)]
    assert said == [
        "plane: rms residual of the fit to the layout: P11 1.2 nm",
        "lines: rms residual of the fit to the layout: P11 4.0 nm (moves lines)",
        "suggested recipe: plane; to use it, build new.toml",
        f"pictures {folder / 'report.html'}",
    ]


def test_bad_input_is_one_line_and_code_2(tmp_path: Path) -> None:
    card = tmp_path / "card.toml"
    card.write_text(card_text(unit='"furlong"'), encoding="utf-8")
    code = "from litho_data.cli.app import main; main()"
    command = [sys.executable, "-c", code, "build", str(card), "--out", str(tmp_path / "out.zarr")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1
    assert "scan.unit = 'furlong'" in done.stderr
    assert list(tmp_path.iterdir()) == [card]


def test_folders_whose_names_differ_after_a_dot_become_different_stores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Path] = []

    def build(folder: Path, target: Path, **_: object) -> SimpleNamespace:
        made.append(target)
        return SimpleNamespace(n_scans=1, skipped={}, seconds=0.0)

    monkeypatch.setattr("litho_data.exchange.pairs.import_pairs", build)
    said = "".join(run.invoke(app, ["import-pairs", str(tmp_path / f"p.{year}")]).output for year in (24, 25))
    assert made == [tmp_path / "p.24.zarr", tmp_path / "p.25.zarr"]
    assert [str(tmp_path / f"p.{year}-report") in said for year in (24, 25)] == [True, True]
    # A store may have a name without .zarr.
    assert [report_folder(f"p.{year}").name for year in (24, 25)] == ["p.24-report", "p.25-report"]


def test_the_commands_on_a_store(own_campaign: Path) -> None:
    store = str(own_campaign / "prints.zarr")
    verified = run.invoke(app, ["verify", store])
    assert verified.exit_code == 0, verified.output
    assert "unchanged: 24 arrays, 18 steps, 6 raw files" in verified.output
    assert "from scans/P11.txt" in run.invoke(app, ["history", store, "P11"]).output
    replayed = run.invoke(app, ["replay", store, "P11", "--array", "height_um"])
    assert "largest difference 0, over 1 arrays" in replayed.output
    exported = run.invoke(app, ["export", store, "--format", "zip"])
    assert exported.exit_code == 0, exported.output
    assert (own_campaign / "prints.zarr.zip").is_file()
    pairs, back = str(own_campaign / "pairs"), str(own_campaign / "back.zarr")
    for words in (
        ["export", store, "--format", "pairs", "--out", pairs],
        ["import-pairs", pairs, "--out", back],
    ):
        done = run.invoke(app, words)
        assert done.exit_code == 0, done.output
    assert [one.id for one in open_store(back).scans()] == ["P11", "P12", "P21"]
    (own_campaign / "scans" / "P11.txt").write_text("1 2\n3 4\n")
    changed = run.invoke(app, ["verify", store])
    assert changed.exit_code == 1
    assert "CHANGED raw file scans/P11.txt" in changed.output


def test_help_names_every_command() -> None:
    text = run.invoke(app, ["--help"]).output
    scans, stores = ["masks", "simulate", "level", "inspect"], ["verify", "history", "replay", "export"]
    commands = ["fetch", *scans, "build", *stores, "import-pairs"]
    assert [name for name in commands if f" {name} " not in text] == []
