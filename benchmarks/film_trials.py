"""Blind trials on films: the fab plants a cause or none, and the loop has to name it and nothing else.

    python -m benchmarks.film_trials --process e-beam [--seed 1] [--only 0,3]

Ten trials a process: seven with one cause each, three empty. Dose and charging differ in all. The loop sees
the store alone, with the bare printer of the process as its base.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.markdown_table import markdown_table
from benchmarks.record import write_record
from litho_data.commands.progress import run_script
from litho_data.making.build import build_dataset
from litho_data.virtual_fab.films import FILM_PRINTERS, FilmKnobs, simulate_films
from litho_models.loop.run import close_loop

# Two of the films are locked, and eight at least have to remain to confirm anything.
COUNT, SIZE_PX = 16, 208
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
    """What is planted, by its knob; empty for nothing."""

    number: int
    cause: str
    knobs: FilmKnobs


def draw(process: str, seed: int) -> list[Trial]:
    """The trials of a process, in random order; sizes in pixels of the layout."""
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
    """Print, build, close the loop, judge: ``right`` where the cause, or nothing, is all that is named."""
    own = folder / f"{trial.number}"
    card = simulate_films(
        own / "fab", process, count=COUNT, size_px=SIZE_PX, seed=seed * 100 + trial.number, knobs=trial.knobs
    )
    build_dataset(card, own / "films.zarr")
    result = close_loop(own / "films.zarr", own / "loop", base=process, base_settings=BASES[process])
    shutil.rmtree(own / "fab")
    named = [{one.name, *one.confusable_with} for one in result.effects]
    wanted = [EFFECTS[trial.cause]] if trial.cause else []
    before, after = result.error("base"), result.error("all")
    assert before is not None
    assert after is not None
    return {
        "number": trial.number,
        "planted": trial.cause or "nothing",
        "knobs": vars(trial.knobs),
        "named": [sorted(names) for names in named],
        "right": len(named) == len(wanted) and all(one in named[0] for one in wanted),
        "edges_nm": [before.leading_nm, after.leading_nm],
    }


def text_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """A row for each trial."""
    table = [
        (
            str(row["number"]),
            row["planted"],
            "; ".join(" or ".join(one) for one in row["named"]) or "nothing",
            "yes" if row["right"] else "no",
            "{:.2f} → {:.2f} nm".format(*row["edges_nm"]),
        )
        for row in rows
    ]
    return markdown_table(("trial", "planted", "named", "right", "edges, held out"), table)


def main() -> None:
    """Run the trials of a process and write what came out."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("--out", type=Path, default=Path("runs/film-trials"))
    parser.add_argument("--process", choices=sorted(BASES), default="e-beam")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", default="", help="numbers of trials, with commas; all by default")
    given = parser.parse_args()
    folder = given.out / f"{given.process}-{given.seed}"
    folder.mkdir(parents=True, exist_ok=True)
    wanted = [int(one) for one in given.only.split(",") if one] or range(len(PLANTED) + EMPTY)
    rows = []
    for trial in draw(given.process, given.seed):
        if trial.number in wanted:
            rows.append(run(trial, given.process, given.seed, folder))
            write_record(
                folder / "film_trials.json", {"process": given.process, "seed": given.seed, "trials": rows}
            )
            print(text_of(rows[-1:]).splitlines()[-1], flush=True)
    print(text_of(rows))


if __name__ == "__main__":
    run_script(main)
