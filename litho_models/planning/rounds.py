"""Run a loop, write its open questions, and decide them with later prints of the same printer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from litho_data.foundation.errors import InputError
from litho_data.foundation.results import Result
from litho_data.store import PrintedScan, Store, open_store
from litho_models.loop import run
from litho_models.loop.closing import Closed
from litho_models.loop.record import CloseLoop
from litho_models.planning.deciding import decide, with_decisions
from litho_models.planning.open_questions import open_questions


def close_loop(
    store: str | Path,
    out: str | Path,
    *,
    new_prints: Sequence[str | Path] = (),
    report: Callable[[str], None] = lambda message: None,
    **settings: Any,
) -> CloseLoop:
    """Close the loop on a store by ``loop.run.close_loop``, and write its open questions with the result.

    Args:
        new_prints: further stores of the same printer. They decide the open questions (see ``deciding``) and
            change nothing that was found on the first store.
        settings: those of ``loop.run.close_loop``.

    Raises:
        InputError: as in ``loop.run.close_loop``; also if a further store is of another printer, or if a scan
            is turned but its card does not say so.
    """
    first, further = open_store(store), [open_store(path) for path in new_prints]
    new = [scan for one in further for scan in new_scans(first, one)]

    def asked(closed: Closed, result: CloseLoop) -> tuple[CloseLoop, list[Result]]:
        open_ = open_questions(closed, result, report)
        if new:
            result = with_decisions(result, open_, decide(closed, open_, new, report))
        return result, [open_]

    used = [one.sha256 for one in further]
    return run.close_loop(store, out, further=asked, decided_by=used, report=report, **settings)


def new_scans(first: Store, store: Store) -> list[PrintedScan]:
    """Return the scans of a further store, after checking that printer and orientation are as stated.

    Raises:
        InputError: the store is of another printer, or a scan has another orientation than its card states.
    """
    for name in ("pitch_um", "level_height_um", "levels"):
        if getattr(store, name) != getattr(first, name):
            raise InputError(
                f"{name} of {store.path}",
                got=getattr(store, name),
                wanted=f"{getattr(first, name)}, as before",
            )
    planned = store.manifest.get("card", {}).get("plan", {}).get("dataset_sha256")
    if planned is not None and planned != first.sha256:
        raise InputError(
            f"prints of {store.path}",
            got=f"a plan for dataset {planned[:12]}…",
            wanted=f"a plan for {first.path}, {first.sha256[:12]}…",
            hint="these prints were planned for the questions on another printer",
        )
    scans = store.scans()
    for scan in scans:
        stated = round((scan.turned_deg or 0.0) / 90)
        # The sign of a turn is a convention, but registration shows whether a print was turned.
        if (stated - scan.quarter_turns) % 2:
            raise InputError(
                f"scan {scan.id} of {store.path}",
                got=f"turned by {90 * scan.quarter_turns}° on its layout, {90 * stated}° in its card",
                wanted="the turn that the scan shows",
                hint="add the column turned_deg to the table of the card, and build again",
            )
    return scans
