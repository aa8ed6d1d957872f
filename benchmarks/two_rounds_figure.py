"""Predicted against reached power of a published board of two rounds, as a picture for the page.

    python -m benchmarks.two_rounds_figure [--seed 20273]

Questions about what was planted, in bins of the power that the plan promised; how many of each were decided
rightly, with the 95 % interval of that share. A promise is kept where a point lies on the diagonal or above.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binomtest

from benchmarks.two_rounds import POWERS, RESULTS
from litho_data.foundation.commands import run_script
from litho_data.foundation.report_pictures import new_figure

_ARMS = (("optimised", "computed layouts", "#0b6aa2", -0.006), ("random", "random layouts", "#d9822b", 0.006))


class Bin(NamedTuple):
    """Questions of one range of promised power: its mean, how many are asked, and decided rightly."""

    promised: float
    asked: int
    right: int


def bins(trials: Sequence[dict[str, Any]], arm: str) -> list[Bin]:
    """The bins that hold any question about what was planted."""
    asked = [one for trial in trials for one in trial["answers"].get(arm, []) if one["counts"]]
    found = []
    for low, high in POWERS:
        some = [one for one in asked if low <= one["power"] < high]
        if some:
            promised = float(np.mean([one["power"] for one in some]))
            found.append(Bin(promised, len(some), sum(one["right"] for one in some)))
    return found


def draw(trials: Sequence[dict[str, Any]], path: Path) -> None:
    """Write the picture."""
    figure = new_figure(4.6, 4.2)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], color="#9aa5b1", lw=1, ls="--")
    for arm, label, colour, aside in _ARMS:
        for one in bins(trials, arm):
            reached = one.right / one.asked
            interval = binomtest(one.right, one.asked).proportion_ci(method="wilson")
            spread = [[reached - interval.low], [interval.high - reached]]
            at = one.promised + aside
            axes.errorbar(at, reached, yerr=spread, fmt="o", color=colour, capsize=3, label=label)
            # Beside its bar; the second of two at one place below it.
            place = (-8, 8) if aside < 0 else (8, 0) if reached else (0, -14)
            axes.annotate(
                f"{one.right} of {one.asked}",
                (at, reached),
                place,
                textcoords="offset points",
                ha={-1: "right", 0: "center", 1: "left"}[int(np.sign(place[0]))],
                color=colour,
                fontsize=9,
            )
    handles, labels = axes.get_legend_handles_labels()
    once = dict(zip(labels, handles, strict=True))
    axes.legend(once.values(), once.keys(), loc=(0.05, 0.8), frameon=False)
    axes.set(xlabel="promised power, four prints", ylabel="decided rightly")
    axes.set(xlim=(-0.22, 1.25), ylim=(-0.1, 1.12))
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Draw beside the board's record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=20273, help="of a published board")
    seed = parser.parse_args().seed
    record = json.loads((RESULTS / f"{seed}.json").read_text(encoding="utf-8"))
    draw(record["trials"], RESULTS / f"{seed}.png")


if __name__ == "__main__":
    run_script(main)
