"""Run the closed loop of this package on the stores of a board."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from litho_models.boards.records import Answer, Found
from litho_models.loop.record import CloseLoop
from litho_models.loop.run import close_loop


def own_loop(
    store: Path, folder: Path, *, base: str, report: Callable[[str], None] = lambda message: None
) -> Answer:
    """Run the closed loop of this package on a store and return its answer. The results of the loop are
    written to ``folder/loop``; ``base`` is the model that the loop corrects.
    """
    return answer_of(close_loop(store, folder / "loop", base=base, report=report))


def answer_of(result: CloseLoop) -> Answer:
    """Convert the result of the closed loop of this package to the answer that a board expects."""
    added = [
        Found(
            names=[one.name, *one.confusable_with],
            knowledge=one.knowledge,
            by=one.by,
            exponents=[own.ci95 for own in one.strengths.get("exponent", []) if own.ci95],
        )
        for one in result.effects
    ]
    seen = [
        Found(names=[one.name, *one.confusable_with], knowledge="cause", by="scan")
        for one in result.single_scans
        if one.seen
    ]
    before, after = result.error("base"), result.error("all")
    physics = result.base_model == "physics"
    return Answer(
        found=added + seen,
        left=result.verdict == "unexplained" or any(one.matters for one in result.explained[-1:]),
        absorbed=[one.name for one in result.candidates if one.verdict == "absorbed"],
        displaced_by=[part.by for part in result.measurement.parts if part.what == "shift-x"],
        before_nm=before.mae_nm if before else None,
        after_nm=after.mae_nm if after else None,
        base_values=result.base_values if physics else {},
        corrected_values=result.corrected_values if physics else {},
    )
