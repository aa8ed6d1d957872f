"""Check that a result records its command, if any, and whether the code had uncommitted changes."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path

import numpy as np
import pytest

from litho_data.cli.app import main
from litho_data.foundation.run_facts import RunInfo, checkout_state, run_facts, run_info, running_command
from litho_data.level.scan import LevelRecord


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """Make a git repository with one committed file in each package and one outside of them."""
    for name in ("litho_data", "litho_models", "litho_design", "docs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.py").write_text("1\n")
    for command in ("init -q", "add .", "-c user.name=a -c user.email=a@b commit -q -m first"):
        subprocess.run(["git", "-C", tmp_path, *command.split()], check=True)
    return tmp_path


@pytest.mark.parametrize("package", ["litho_data", "litho_models", "litho_design"])
def test_a_change_in_any_package_makes_the_checkout_dirty(checkout: Path, package: str) -> None:
    clean = checkout_state(checkout)
    assert clean["dirty"] is False
    assert len(clean["commit"]) == 40
    (checkout / package / "a.py").write_text("2\n")
    assert checkout_state(checkout) == {**clean, "dirty": True}


def test_a_new_code_file_makes_the_checkout_dirty_and_a_changed_page_does_not(checkout: Path) -> None:
    (checkout / "docs" / "a.py").write_text("2\n")
    assert checkout_state(checkout)["dirty"] is False
    (checkout / "litho_models" / "b.py").write_text("2\n")
    assert checkout_state(checkout)["dirty"] is True


def test_without_a_checkout_nothing_is_claimed(tmp_path: Path) -> None:
    assert checkout_state(tmp_path) == {"commit": None, "dirty": None}


def test_a_command_is_recorded_only_while_it_runs() -> None:
    assert run_facts()["command"] == ""
    with running_command("litho-data build card.toml"):
        assert run_info([3], 5, ["a: torn"]).command == "litho-data build card.toml"
    assert run_facts()["command"] == ""


def test_every_command_line_records_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "scan.npy", np.random.default_rng(0).normal(size=(8, 8)))
    (tmp_path / "recipe.toml").write_text('[[step]]\nop = "plane"\n')
    arguments = ["level", str(tmp_path / "scan.npy"), "--recipe", str(tmp_path / "recipe.toml")]
    arguments += ["--unit", "um", "--out", str(tmp_path / "flat.npy")]
    monkeypatch.setattr("sys.argv", ["/usr/bin/litho-data", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    record = LevelRecord.read(tmp_path / "flat.npy.json")
    assert shlex.split(record.command) == ["litho-data", *arguments]
    assert {"numpy", "blas"} <= set(record.versions)


def test_an_older_result_states_nothing_about_the_checkout() -> None:
    old = {"command": "a", "commit": "b", "versions": {}, "seeds": [0], "n_scans": 1, "dropped": []}
    assert RunInfo.model_validate(old).dirty is None
