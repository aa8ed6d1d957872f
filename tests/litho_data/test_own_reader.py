"""Check that a user's own reader is tried first and can be named in cards and commands."""

from __future__ import annotations

import importlib.util
import linecache
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from litho_data.cards.listing import list_fields
from litho_data.cli.app import app
from litho_data.foundation.errors import InputError
from litho_data.foundation.plugins import foreign_sha256
from litho_data.making.build import build_dataset
from litho_data.making.jobs import field_jobs
from litho_data.making.operations import no_recipe
from litho_data.readers import Reader, formats, read_scan, register_reader, registry
from litho_data.store import open_store
from tests.litho_data.campaigns import MARGIN_PX, PITCH_UM, height_of, layout_of, write_campaign

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_reader.py"


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Load `examples/own_reader.py`, whose reader is registered for the duration of one test."""
    return register_file(EXAMPLE, monkeypatch)


def register_file(path: Path, patch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location("own_reader", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    patch.setattr(registry, "_READERS", [*registry._READERS])
    patch.setattr(registry, "_REGISTERED", {**registry._REGISTERED})
    register_reader(module.TOY)
    return module


def test_an_own_reader_reads_by_content_and_is_offered_by_the_commands(
    example: ModuleType, tmp_path: Path
) -> None:
    height_nm = np.arange(12.0).reshape(3, 4)
    example.write_toy(tmp_path / "scan.anything", height_nm, (0.3, 0.4))
    scan = read_scan(tmp_path / "scan.anything")
    np.testing.assert_allclose(scan.height_um, height_nm * 1e-3)
    assert (scan.format, scan.pitch_um) == ("toy", pytest.approx((0.1, 0.1)))
    said = CliRunner().invoke(app, ["inspect", str(tmp_path / "scan.anything"), "--format", "toy"])
    assert "read as toy" in said.output


def test_a_card_may_name_an_own_reader_and_a_dataset_is_built_with_it(
    example: ModuleType, tmp_path: Path
) -> None:
    card = write_campaign(tmp_path, count=1)
    layout = layout_of(0)
    side_um = (layout.shape[0] + 2 * MARGIN_PX) * PITCH_UM
    example.write_toy(tmp_path / "scans" / "P11.toy", 1e3 * height_of(layout, 0), (side_um, side_um))
    text = card.read_text().replace("{id}.txt", "{id}.toy").replace("text-matrix", "toy")
    card.write_text("\n".join(line for line in text.splitlines() if not line.startswith(("unit", "size_um"))))
    build_dataset(card, tmp_path / "prints.zarr")
    assert open_store(tmp_path / "prints.zarr").manifest["card"]["scan"]["format"] == "toy"


def test_an_own_reader_is_asked_before_the_built_in_readers(example: ModuleType, tmp_path: Path) -> None:
    np.savetxt(tmp_path / "scan.txt", np.ones((3, 3)))
    greedy = Reader("greedy", lambda path, head: path.suffix == ".txt", example.read_channels)
    register_reader(greedy)
    assert formats()[0] == "greedy"
    with pytest.raises(InputError, match="as greedy"):
        read_scan(tmp_path / "scan.txt")


@pytest.mark.parametrize("name", ["toy", "gsf", "auto", "image"])
def test_an_own_reader_with_a_used_name_is_refused(example: ModuleType, name: str) -> None:
    with pytest.raises(InputError, match="another name"):
        register_reader(Reader(name, lambda path, head: True, example.read_channels))


def test_a_changed_own_reader_changes_the_key_and_the_step_of_its_scans_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check that a resumed build keeps no scan that an older version of the reader has read."""
    card = write_campaign(tmp_path, count=2)
    card.write_text(card.read_text().replace("{id}.txt", "{id}.*").replace("text-matrix", "auto"))
    (tmp_path / "scans" / "P11.txt").unlink()
    reader = tmp_path / "lab" / "own_reader.py"
    reader.parent.mkdir()
    own: list[tuple[str, str, bool]] = []
    text: list[tuple[str, str, bool]] = []
    for version in (EXAMPLE.read_text(), EXAMPLE.read_text(), EXAMPLE.read_text().replace("nm", "um")):
        reader.write_text(version)
        with monkeypatch.context() as patch:
            example = register_file(reader, patch)
            example.write_toy(tmp_path / "scans" / "P11.toy", np.eye(8), (12.8, 12.8))
            for job, found in zip(field_jobs(list_fields(card), no_recipe()), (own, text), strict=True):
                step = job.begin().steps[-1]
                found.append((job.key(), step.id, "reader_sha256" in step.params))
    assert own[0] == own[1]
    assert all(before != after for before, after in zip(own[0][:2], own[2][:2], strict=True))
    assert [one[2] for one in own] == [True] * 3
    assert text == [(*text[0][:2], False)] * 3


def test_the_source_of_a_reader_is_its_whole_package(tmp_path: Path) -> None:
    (tmp_path / "lab" / "afm").mkdir(parents=True)
    for name, text in {
        "__init__": "",
        "scale": "UM = 1",
        "afm/__init__": "",
        "afm/toy": "def f(): 0",
    }.items():
        (tmp_path / "lab" / f"{name}.py").write_text(text)
    path = tmp_path / "lab" / "afm" / "toy.py"
    names: dict[str, Callable[[], int]] = {}
    exec(compile(path.read_text(), path, "exec"), names)
    before = foreign_sha256(partial(names["f"]))
    (tmp_path / "lab" / "scale.py").write_text("UM = 2")
    assert "" != before != foreign_sha256(names["f"]) != ""
    assert foreign_sha256(read_scan) == ""


def test_the_source_of_a_class_in_a_notebook_is_its_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr("__main__.__file__", raising=False)
    found = []
    for text in ("class A:\n    def f(self): return 1", "class A:\n    def f(self): return 2"):
        monkeypatch.setitem(linecache.cache, "<cell>", (len(text), None, [text], "<cell>"))
        names: dict[str, Any] = {"__name__": "__main__"}
        exec(compile(text, "<cell>", "exec"), names)
        found.append(foreign_sha256(names["A"]))
    assert "" != found[0] != found[1] != ""
