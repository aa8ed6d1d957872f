"""Check that a plug-in, either an installed package or a file, is available to every command and worker."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from importlib import import_module
from operator import methodcaller
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest

from examples.own_reader import write_toy
from litho_data.foundation import plugins
from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_facts
from litho_data.readers import registry
from litho_data.sharing.workers import Workers, run_jobs
from litho_design.tasks import task
from litho_models.effects import CATALOGUE
from litho_models.fitting import small_models
from litho_models.loop import closing
from litho_models.models import MODELS
from litho_models.scan_terms import SCAN_TERMS
from litho_models.scoring import metric_registry
from tests.litho_models.loop_scans import search_little
from tests.litho_models.prints import make_scans, write_store

ENTRY = "[litholoop.plugins]\nown-lab = own_lab\n"
MODULE = """
from examples.own_effect import register
from examples.own_metric import share_off_by_half_a_level
from examples.own_reader import TOY
from examples.own_simulator import TwoSpots
from litho_data.readers import register_reader
from litho_models import register_metric, register_simulator
import examples.own_task

register()
register_reader(TOY)
register_simulator(TwoSpots)
register_metric("off_by_half_a_level", "percent", share_off_by_half_a_level, "off_by_half_a_level: a share.")
"""
COMMANDS = """\
litho-data inspect scan.afm
litho-models train prints.zarr --model two-spots --out run
litho-models freeze run --out printer
litho-models benchmark prints.zarr --models two-spots --folds 2 --out bench
litho-models close-loop prints.zarr --base two-spots --folds 2 --out loop
litho-design compare --models printer --seeds 1 --set search.polish_rounds=0 --set window.yield_draws=2 \
--size-px 32 --distance-um 20 --iterations 2 --out gap
"""
# A number that says which plug-ins are loaded in its process.
OWN = """
from litho_data.foundation.plugins import plugin_versions
class Number(int):
    def twice(self):
        return 2 * self, sorted(plugin_versions())
"""


@pytest.fixture
def unknown(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Unload the plug-ins that a test has loaded, and what they have registered."""
    monkeypatch.setattr(plugins, "_LOADED", {})
    monkeypatch.setattr(registry, "_READERS", [*registry._READERS])
    monkeypatch.setattr(metric_registry, "_MEASUREMENTS", [*metric_registry._MEASUREMENTS])
    modules = set(sys.modules)
    with ExitStack() as held:
        for registered in (registry._REGISTERED, task._TASKS, MODELS, CATALOGUE, SCAN_TERMS):
            held.enter_context(patch.dict(registered))
        yield
    for name in set(sys.modules) - modules:
        if name.startswith(("own_", "examples.own_")):
            del sys.modules[name]


def installed(site: Path, code: str) -> None:
    """Write the files that pip leaves of an installed package with a plug-in."""
    facts = site / "own_lab-1.2.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: own-lab\nVersion: 1.2\n")
    (facts / "entry_points.txt").write_text(ENTRY)
    (site / "own_lab.py").write_text(code)


@pytest.mark.slow
def test_what_an_installed_plugin_registers_is_used_by_every_command(
    tmp_path: Path,
    unknown: None,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    installed(tmp_path / "site", MODULE)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.chdir(tmp_path)
    write_store(tmp_path / "prints.zarr", make_scans(4, 48))
    write_toy(tmp_path / "scan.afm", 100 * np.random.default_rng(0).random((32, 32)), (3.2, 3.2))
    # One step of each fit, and of all the effects that a loop tries only the own one.
    monkeypatch.setattr(small_models, "RULES", replace(small_models.RULES, steps=1))
    every = closing.screened_effects
    search_little(monkeypatch)
    monkeypatch.setattr(
        closing, "screened_effects", lambda tip: [one for one in every(tip) if one.name == "sinking-layers"]
    )
    for line in COMMANDS.splitlines():
        monkeypatch.setattr(sys, "argv", line.split())
        with pytest.raises(SystemExit) as stop:
            import_module(f"{sys.argv[0].replace('-', '_')}.cli.app").main()
        assert not stop.value.code, line
    assert "toy" in capsys.readouterr().out
    assert task.registered_task("colours-in-planes").__name__ == "ColoursInPlanes"
    assert "two-spots" in set(pd.read_csv(tmp_path / "bench" / "scans.csv")["model"])
    bench = json.loads((tmp_path / "bench" / "benchmark.json").read_text())
    assert all("off_by_half_a_level_percent" in row["metrics"] for row in bench["scores"])
    assert bench["run"]["versions"]["plug-in own-lab"] == "1.2"
    loop = json.loads((tmp_path / "loop" / "close_loop.json").read_text())
    assert "sinking-layers" in {one["name"] for one in (*loop["candidates"], *loop["effects"])}
    (design,) = (tmp_path / "gap").rglob("design.json")
    assert "two-spots" in design.read_text()


def test_a_file_is_loaded_once_and_every_worker_loads_it_and_what_is_installed(
    tmp_path: Path, unknown: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path / "site", "")
    monkeypatch.syspath_prepend(tmp_path / "site")
    file = tmp_path / "own_numbers.py"
    file.write_text(OWN)
    for _ in range(2):
        plugins.load_plugins([file])
    numbers = [sys.modules["own_numbers"].Number(one) for one in (1, 2, 3)]
    done = run_jobs(methodcaller("twice"), numbers, Workers(2))
    loaded = ["plug-in own-lab", "plug-in own_numbers.py"]
    assert sorted(result for _, result in done) == [(2, loaded), (4, loaded), (6, loaded)]
    version = run_facts()["versions"]["plug-in own_numbers.py"]
    file.write_text(f"{OWN}# Changed.\n")
    plugins._LOADED.clear()
    del sys.modules["own_numbers"]
    plugins.load_plugins([file])
    assert run_facts()["versions"]["plug-in own_numbers.py"] != version


def test_a_plugin_that_cannot_be_loaded_is_one_line(tmp_path: Path, unknown: None) -> None:
    failing, taken = tmp_path / "own_fault.py", tmp_path / "json.py"
    failing.write_text("1 / 0")
    taken.write_text("")
    wrong = {tmp_path / "none.py": "none.py", tmp_path: "a Python file"}
    for file, said in {**wrong, failing: "ZeroDivisionError", taken: "an unused name"}.items():
        with pytest.raises(InputError, match=said):
            plugins.load_plugins([file])
    assert not plugins.plugin_files()


def test_the_option_stands_anywhere_on_the_line() -> None:
    words = ["--plugin", "one.py", "train", "store", "--plugin=two.py", "--model", "m"]
    assert plugins.without_plugins(words) == (["train", "store", "--model", "m"], ["one.py", "two.py"])
    with pytest.raises(InputError, match="a Python file"):
        plugins.without_plugins(["train", "--plugin"])
