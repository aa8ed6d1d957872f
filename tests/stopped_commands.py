"""Stop commands after some of their writes: ``python -m tests.stopped_commands NAMES FOLDER [every]``.

Every command is a function of its working folder, which already contains its input. The module runs each
command from what a stopped run would have left, checks that the result equals that of an uninterrupted run,
and prints the number of stops. NAMES are separated by commas. By default, a command is stopped up to four
times. With ``every``, and always if it takes little time, it is stopped after each write.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import pytest

from litho_data.exchange.pairs import export_pairs, import_pairs
from litho_data.exchange.release import export_ro_crate
from litho_data.layouts import write_layout_set
from litho_data.making.build import build_dataset
from litho_data.provenance.verify import verify
from litho_data.store import open_store
from litho_data.virtual_fab import simulate
from litho_data.virtual_fab.films import simulate_films
from litho_design import (
    compare,
    correct,
    design_hologram,
    design_lens,
    export,
    first,
    hologram_settings,
    lens_settings,
)
from litho_design.reliefs.settings import relief_settings
from litho_design.sheets.new import new_sheet
from litho_design.workflows.score import score
from litho_models.boards.board import judge_board, new_board
from litho_models.boards.records import Answer
from litho_models.effects import get_effect
from litho_models.evaluation.benchmark import benchmark
from litho_models.evaluation.evaluate import evaluate
from litho_models.fitting import base_models
from litho_models.fitting.runs import train
from litho_models.frozen.exporting import export_model
from litho_models.frozen.files import load_frozen
from litho_models.frozen.freezing import freeze as freeze_model
from litho_models.loop import closing
from litho_models.loop import run as loop_run
from litho_models.monitoring import check
from litho_models.noise.analyse import analyse_noise
from litho_models.planning.rounds import close_loop
from litho_models.planning.run import next_print
from litho_models.scan_terms.grouped import ALL
from tests.figures import undrawn
from tests.litho_data.campaigns import write_campaign
from tests.litho_models.loop_scans import base_model, planted, search_little
from tests.litho_models.prints import make_scans, write_store
from tests.stops import states_after, writes_of

# Fields of records that differ between two runs of the same command.
_VOLATILE = {
    "seconds",
    "seconds_per_iteration",
    "started",
    "ended",
    "command",
    "commit",
    "dirty",
    "reused",
    "peak_memory_gib",
    "cost",
    "dataset_cpu_s",
    "weights_sha256",
}
# What a command replaces for its runs.
_PATCH = pytest.MonkeyPatch()
QUICK = {"variant": "paper", "steps": 2, "rounds": 2, "batch": 1, "crop_px": 32, "nuisance": "offset"}


def _campaign(folder: Path) -> Path:
    return write_campaign(folder / "fab", count=2)


def _store(folder: Path) -> Path:
    build_dataset(_campaign(folder), folder / "prints.zarr")
    return folder / "prints.zarr"


def _scans(folder: Path) -> None:
    write_store(folder / "prints.zarr", make_scans(4, 48))


def simulate_prints(folder: Path) -> None:
    simulate(folder / "out", count=1, size_px=40)


def films(folder: Path) -> None:
    simulate_films(folder / "out", "e-beam", count=2, size_px=64)


def layouts(folder: Path) -> None:
    write_layout_set(folder / "out", count=2, size_px=64)


def build(folder: Path) -> None:
    build_dataset(folder / "fab" / "card.toml", folder / "out")


def build_pairs(folder: Path) -> None:
    import_pairs(folder / "pairs", folder / "out")


def _pairs(folder: Path) -> None:
    export_pairs(_store(folder), folder / "pairs")


def crate(folder: Path) -> None:
    export_ro_crate(folder / "prints.zarr", folder / "out")


def pairs(folder: Path) -> None:
    export_pairs(folder / "prints.zarr", folder / "out")


def train_network(folder: Path) -> None:
    train(folder / "prints.zarr", "pbl", folder / "out", settings=QUICK)


def train_small(folder: Path) -> None:
    train(folder / "prints.zarr", "affine", folder / "out")


def freeze(folder: Path) -> None:
    freeze_model("zoo:physics", folder / "out")


def program(folder: Path) -> None:
    export_model(load_frozen("zoo:physics"), folder / "out" / "physics.pt2", 64)


def score_models(folder: Path) -> None:
    benchmark(folder / "prints.zarr", folder / "out", models=["affine", "pbl"], folds=2, settings=QUICK)


def score_model(folder: Path) -> None:
    evaluate("zoo:physics", folder / "prints.zarr", folder / "out")


def noise(folder: Path) -> None:
    analyse_noise(folder / "prints.zarr", folder / "out")


def _ten_scans(folder: Path) -> None:
    write_store(folder / "prints.zarr", make_scans(10, 48))


def check_prints(folder: Path) -> None:
    check("zoo:physics", folder / "prints.zarr", folder / "out", new=["4"])


def board(folder: Path) -> None:
    new_board(folder / "out", trials=1, n_scans=6, size_px=128)


def _board(folder: Path) -> None:
    new_board(folder / "board", trials=2, n_scans=6, size_px=128)


def judge(folder: Path) -> None:
    judge_board(folder / "board", folder / "out", lambda store, place: Answer())


def _planted(folder: Path) -> None:
    """Write prints with write-order memory, and make the loop use a small base and try only a few causes."""
    strength = {"": get_effect("write-order-memory").with_values({"strength": 0.3})}
    write_store(folder / "prints.zarr", planted([("write-order-memory", ALL, strength)], count=5))
    search_little(_PATCH, ["write-order-memory", "slope-thinning"])
    _PATCH.setattr(base_models, "build_model", lambda *name, **facts: base_model())
    _PATCH.setattr(loop_run, "close", _once(closing.close))


def _once(close: Callable[..., Any]) -> Callable[..., Any]:
    """Cache the result of a search, so that the runs repeat only the other work and all writes."""
    kept: dict[tuple[str, ...], Any] = {}

    def found(study: Any, models: Any) -> Any:
        scans = tuple(scan.id for scan in study.scans)
        if scans not in kept:
            kept[scans] = close(study, models)
        return kept[scans]

    return found


def loop(folder: Path) -> None:
    close_loop(folder / "prints.zarr", folder / "out", base="affine-mtf", folds=2)


def loop_nested(folder: Path) -> None:
    close_loop(folder / "prints.zarr", folder / "out", base="affine-mtf", folds=2, nested="folds")


def _closed(folder: Path) -> None:
    _planted(folder)
    close_loop(folder / "prints.zarr", folder / "loop", base="affine-mtf", folds=2)


def plan(folder: Path) -> None:
    next_print(folder / "loop", folder / "out", prints=2, field_um=6.4, steps=2)


_SMALL = {
    "layout.size_px": 32,
    "search.iterations": 4,
    "search.checkpoint_every": 2,
    "search.polish_rounds": 1,
}
_SMALL_OPTICS = _SMALL | {"window.yield_draws": 2, "optics.distance_um": 12}
_QUIET = {"judges": (), "announce": False}


def hologram(folder: Path) -> None:
    made = hologram_settings(changes=_SMALL_OPTICS)
    design_hologram("ring", "none", folder / "out", settings=made, **_QUIET)


def lens(folder: Path) -> None:
    made = lens_settings("direct", changes=_SMALL_OPTICS)
    design_lens("none", folder / "out", settings=made, **_QUIET)


def relief(folder: Path) -> None:
    correct("staircase", "none", folder / "out", settings=relief_settings(_SMALL), **_QUIET)


def first_hologram(folder: Path) -> None:
    first(folder / "out", target="ring", settings=hologram_settings(changes=_SMALL_OPTICS), announce=False)


def comparison(folder: Path) -> None:
    made = hologram_settings(changes=_SMALL_OPTICS)
    compare(made, ["none"], folder / "out", target="ring", seeds=(0, 1), announce=False)


def _designed(folder: Path) -> None:
    made = hologram_settings(changes=_SMALL_OPTICS)
    design_hologram("ring", "none", folder / "design", settings=made, **_QUIET)


def export_design(folder: Path) -> None:
    export(folder / "design", "png16", folder / "out")


def score_design(folder: Path) -> None:
    # The record keeps the path of the design's folder as given, so use a relative path.
    _PATCH.chdir(folder)
    score("design", "out", judges=["zoo:physics"])


def sheet(folder: Path) -> None:
    # Random layouts of a smaller field would be coarser.
    made = hologram_settings(changes=_SMALL_OPTICS | {"layout.size_px": 64})
    new_sheet(folder / "out", model="zoo:physics", settings=made, format="png16", layouts=6, announce=False)


def nothing(folder: Path) -> None:
    pass


# For each command, the function that makes its input and the function that runs it.
COMMANDS: dict[str, tuple[Callable[[Path], Any], Callable[[Path], None]]] = {
    "simulate": (nothing, simulate_prints),
    "simulate-films": (nothing, films),
    "masks": (nothing, layouts),
    "build": (_campaign, build),
    "import-pairs": (_pairs, build_pairs),
    "export-ro-crate": (_store, crate),
    "export-pairs": (_store, pairs),
    "train-network": (_scans, train_network),
    "train-small": (_scans, train_small),
    "freeze": (nothing, freeze),
    "export-model": (nothing, program),
    "benchmark": (_scans, score_models),
    "evaluate": (_scans, score_model),
    "noise": (_scans, noise),
    "check": (_ten_scans, check_prints),
    "board-new": (nothing, board),
    "board-judge": (_board, judge),
    "close-loop": (_planted, loop),
    "close-loop-nested": (_planted, loop_nested),
    "next-print": (_closed, plan),
    "hoe": (nothing, hologram),
    "lens": (nothing, lens),
    "correct": (nothing, relief),
    "first": (nothing, first_hologram),
    "compare": (nothing, comparison),
    "export-design": (_designed, export_design),
    "score": (_designed, score_design),
    "sheet-new": (nothing, sheet),
}
# These commands take so little time that they are always stopped after each of their writes.
SHORT = {"freeze", "export-design"}


def content(folder: Path) -> dict[str, Any]:
    """Return the content of all files that a command left, including hidden files. Fields that differ between
    two runs are left out.
    """
    if (folder / "out" / "zarr.json").exists():
        assert not verify(folder / "out").findings
        found: dict[str, Any] = {"dataset": open_store(folder / "out").sha256}
    else:
        found = {}
    # A design that the command itself makes contains such fields, so its hash differs too.
    volatile = _VOLATILE if (folder / "design").is_dir() else _VOLATILE | {"design_sha256"}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_dir() or name.startswith(("fab/", "prints.zarr/", "prints.zarr-report", "pairs/")):
            continue
        found[name] = None
        if path.suffix == ".json" and "zarr.json" not in name:
            found[name] = _steady(json.loads(path.read_text(encoding="utf-8")), volatile)
        elif path.suffix in (".npy", ".safetensors", ".tif", ".txt", ".zip"):
            found[name] = path.read_bytes()
    return found


def _steady(value: Any, volatile: Collection[str]) -> Any:
    if isinstance(value, dict):
        return {name: _steady(inner, volatile) for name, inner in value.items() if name not in volatile}
    return [_steady(inner, volatile) for inner in value] if isinstance(value, list) else value


def chosen(count: int, most: int) -> list[int]:
    """Return the numbers of writes at which to stop. They are spread over all writes. The last three writes,
    which put the results in place, are always among them, and the first is not: before it, nothing is left.
    """
    step = max(1, -(-count // (most + 1)))
    spread = range(step, count, step)
    return sorted({*spread, *range(max(0, count - 3), count)})


def stop_everywhere(name: str, place: Path, *, every: bool = False) -> int:
    """Stop a command after some of its writes, run it again each time, and return the number of stops."""
    need, command = COMMANDS[name]
    prepared = place / "prepared"
    prepared.mkdir(parents=True)
    try:
        need(prepared)
        whole, run = (Path(shutil.copytree(prepared, place / name)) for name in ("whole", "run"))
        count = writes_of(lambda: command(whole), whole)
        wanted = content(whole)
        assert wanted, "the command left nothing"
        stops = chosen(count, count if every or name in SHORT else 1)
        for stop, folder in zip(
            stops, states_after(stops, lambda: command(run), run, place / "stopped"), strict=True
        ):
            command(folder)
            found = content(folder)
            differing = [
                one for one in wanted.keys() | found.keys() if wanted.get(one, 0) != found.get(one, 0)
            ]
            assert not differing, f"{name} stopped after write {stop} of {count}: {sorted(differing)[:5]}"
            shutil.rmtree(folder)
    finally:
        _PATCH.undo()
    print(f"{name}: {len(stops)} of {count} stops, all equal")
    return len(stops)


if __name__ == "__main__":
    # Pictures are part of the page. They take most of the time and write no files, so they are left undrawn.
    with undrawn():
        for name in sys.argv[1].split(","):
            stop_everywhere(name, Path(sys.argv[2]) / name, every="every" in sys.argv)
