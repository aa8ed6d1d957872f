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
        settings: settings of ``loop.run.close_loop``.

    Raises:
        InputError: as in ``loop.run.close_loop``; also if a further store is of another printer, or if a scan
            is rotated but its card does not say so.
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
    """Return the scans of a further store, after checking that it is of the same printer and that the scans
    have the orientation stated in the card.

    Raises:
        InputError: the store is of another printer, or a scan has another orientation than its card states.
    """
    for name in ("pitch_um", "level_height_um", "levels"):
        if getattr(store, name) != getattr(first, name):
            raise InputError(
                f"{name} of {store.path}",
                got=getattr(store, name),
                wanted=f"{getattr(first, name)}, as in {first.path}",
            )
    planned = store.manifest.get("card", {}).get("plan", {}).get("dataset_sha256")
    if planned is not None and planned != first.sha256:
        raise InputError(
            f"store {store.path}",
            got=f"prints planned for dataset {planned[:12]}…",
            wanted=f"prints planned for {first.path}, {first.sha256[:12]}…",
            hint="the first store must be the dataset for which these prints were planned",
        )
    scans = store.scans()
    for scan in scans:
        stated = round((scan.turned_deg or 0.0) / 90)
        # The sign of a rotation is a convention, but registration shows whether a print was rotated.
        if (stated - scan.quarter_turns) % 2:
            raise InputError(
                f"scan {scan.id} of {store.path}",
                got=f"rotated by {90 * scan.quarter_turns}° on its layout, but {90 * stated}° in its card",
                wanted="the rotation of the scan in the card",
                hint="enter it in the column turned_deg of the card's table, and build the store again",
            )
    return scans
