"""Run blind trials on films. The virtual fab plants at most one cause, and the closed loop must name this
cause and no other.

    python -m benchmarks.film_trials [--process e-beam] [--seed 1] [--only 0,3] [--publish]

Each process has ten trials, seven with one cause and three without a cause. The dose and the charging vary
from trial to trial. The loop receives only the store. Its base model contains only the beam or lens of the
process and a threshold. An interrupted run continues when it is run again.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, kept, options, origin
from benchmarks.second_machine import PAGE
from benchmarks.second_machine import RESULT as MACHINE
from litho_data.commands.progress import run_script
from litho_data.making.build import build_dataset
from litho_data.virtual_fab.films import FILM_PRINTERS, FilmKnobs, simulate_films
from litho_models.loop.run import close_loop

RESULT = MACHINE.with_name("film_trials.json")
# Number of films and side of a film in pixels. Two films are locked, and films with coarse features may fail
# to register. At least eight must remain, because the loop cannot confirm a cause with fewer.
COUNT, SIZE_PX = 18, 208
EFFECTS = {
    "backscatter": "electron-backscatter",
    "diffusion_um": "resist-diffusion",
    "etch_bias_um": "etch-bias",
}
PLANTED = (*EFFECTS, *EFFECTS, "etch_bias_um")
EMPTY = 3
BASES: dict[str, dict[str, Any]] = {
    "e-beam": {"parts": ["spot", "etch"], "spot.sigma_um": 0.02, "fixed": ["etch.bias_px"]},
    "projection": {"parts": ["lens", "etch"], "fixed": ["etch.bias_px"]},
}


class Trial(NamedTuple):
    """One trial, with its number, the name of the knob that is the planted cause (empty for none), and all
    knobs.
    """

    number: int
    cause: str
    knobs: FilmKnobs


def draw(process: str, seed: int) -> list[Trial]:
    """Draw the trials of a process. Their order is random, and lengths are drawn in layout pixels."""
    rng = np.random.default_rng([seed, *process.encode()])
    pitch_um = FILM_PRINTERS[process].pitch_um
    causes = rng.permutation([*PLANTED, *[""] * EMPTY]).tolist()
    trials = []
    for number, cause in enumerate(causes):
        knobs = FilmKnobs(dose_error=rng.uniform(-0.1, 0.1), charging=rng.uniform(-0.2, 0.2))
        sizes = {
            "backscatter": {
                "backscatter": rng.uniform(0.2, 0.6),
                "backscatter_um": pitch_um * rng.uniform(15, 60),
            },
            "diffusion_um": {"diffusion_um": pitch_um * rng.uniform(3, 6)},
            "etch_bias_um": {"etch_bias_um": pitch_um * rng.choice([-1, 1]) * rng.uniform(1.5, 4)},
        }
        trials.append(Trial(number, cause, replace(knobs, **sizes.get(cause, {}))))
    return trials


def run(trial: Trial, process: str, seed: int, folder: Path) -> dict[str, Any]:
    """Run and judge one trial, and return its record.

    The entry ``right`` is true if the loop names the planted cause and no other. If nothing was planted, it
    is true if the loop names no cause.
    """
    own = folder / f"{trial.number}"
    card = simulate_films(
        own / "fab", process, count=COUNT, size_px=SIZE_PX, seed=seed * 100 + trial.number, knobs=trial.knobs
    )
    build_dataset(card, own / "films.zarr")
    result = close_loop(own / "films.zarr", own / "loop", base=process, base_settings=BASES[process])
    shutil.rmtree(own / "fab")
    named = [{one.name, *one.confusable_with} for one in result.effects if one.knowledge == "cause"]
    wanted = [EFFECTS[trial.cause]] if trial.cause else []
    before, after = result.error("base"), result.error("all")
    assert before is not None
    assert after is not None
    return {
        "number": trial.number,
        "planted": trial.cause or "nothing",
        "knobs": vars(trial.knobs),
        "named": [sorted(names) for names in named],
        "laws": [one.name for one in result.effects if one.knowledge == "law"],
        "right": len(named) == len(wanted) and all(one in named[0] for one in wanted),
        "edges_nm": [before.leading_nm, after.leading_nm],
    }


def line_of(row: Mapping[str, Any]) -> str:
    """Return one trial as one line of text."""
    named = "; ".join(" or ".join(one) for one in row["named"]) or "nothing"
    named += "".join(f", law {one}" for one in row["laws"])
    edges = "{:.2f} → {:.2f} nm".format(*row["edges_nm"])
    return f"{row['number']}: {row['planted']}, named {named}, {edges}"


def text_of(record: Mapping[str, Any]) -> str:
    """Return a table with a row for each process and planted cause."""
    table = []
    for process, rows in record["processes"].items():
        for planted in dict.fromkeys(sorted(row["planted"] for row in rows)):
            own = [row for row in rows if row["planted"] == planted]
            edges = np.mean([row["edges_nm"] for row in own], axis=0)
            counts = (f"{sum(bool(row[key]) for row in own)} of {len(own)}" for key in ("right", "laws"))
            table.append((process, planted, *counts, "{:.2f} → {:.2f} nm".format(*edges)))
    heads = (
        "process",
        "hidden cause",
        "trials answered correctly",
        "trials in which a law was added",
        "edge error on held-out films, before → after the loop",
    )
    return markdown_table(heads, table)


def main() -> None:
    """Run the trials that have no result yet, write the record of all trials, and print the table."""
    parser = options(__doc__, "write the table into docs/second_machine.md", RESULT)
    parser.add_argument(
        "--cache", type=Path, default=Path("runs/film-trials"), help="folder with a folder for each trial"
    )
    parser.add_argument(
        "--process", default=",".join(BASES), help="names of the processes, separated by commas"
    )
    parser.add_argument("--seed", type=int, default=1, help="seed of all random draws")
    parser.add_argument(
        "--only", default="", help="numbers of the trials to run, separated by commas; by default, all"
    )
    given = parser.parse_args()
    wanted = [int(one) for one in given.only.split(",") if one] or range(len(PLANTED) + EMPTY)
    processes: dict[str, list[dict[str, Any]]] = {}
    for process in given.process.split(","):
        folder = given.cache / f"{process}-{given.seed}"
        for trial in draw(process, given.seed):
            file = folder / f"{trial.number}.json"
            if trial.number in wanted or file.exists():
                row = kept(file, partial(run, trial, process, given.seed, folder))
                processes.setdefault(process, []).append(row)
                print(process, line_of(row), flush=True)
    record = {"run": origin(), "seed": given.seed, "films": COUNT, "size_px": SIZE_PX, "processes": processes}
    conclude(record, text_of(record), given.out, PAGE, "film trials", published=given.publish)


if __name__ == "__main__":
    run_script(main)
