"""Save the corrected model of the printer, and save the laws as a module."""

from __future__ import annotations

from pathlib import Path

from litho_data.reports.page import filled
from litho_data.store import Store
from litho_models.effects import get_effect
from litho_models.fitting.runs import level_share, step_share
from litho_models.frozen.files import save_frozen
from litho_models.loop.closing import Closed
from litho_models.loop.folded_base import FoldedBase
from litho_models.loop.record import CloseLoop
from litho_models.simulator import Simulator

MODEL_FOLDER, LAWS_FILE = "model", "laws.py"


def save_laws(result: CloseLoop, folder: Path) -> None:
    """Write a module that registers the laws as effects, if there are any."""
    laws = [one for one in result.effects if one.knowledge == "law"]
    if not laws:
        return
    text = filled(Path(__file__).with_name(f"{LAWS_FILE}.jinja"), result=result, laws=laws)
    (folder / LAWS_FILE).write_text(text, encoding="utf-8")


def save_model(closed: Closed, result: CloseLoop, store: Store, folder: Path) -> None:
    """Save the corrected model of the printer, with the strengths of the latest scan."""
    twin = closed.final.twin
    base = twin.fitted_base
    if isinstance(base, FoldedBase):
        base = base.common
    assert isinstance(base, Simulator)
    latest = max(closed.study.scans, key=lambda scan: scan.stored.order)
    values = twin.values(twin.labels(latest))
    sides = {"process": "printer", "measurement": "microscope"}

    def on(*roles: str) -> dict[str, dict[str, float]]:
        return {one.name: values[one.name] for one in result.effects if one.role in roles}

    error = result.error("all")
    assert error is not None
    save_frozen(
        base,
        folder,
        name=f"{result.base_model}, loop findings",
        process_effects=on("process"),
        measurement_effects=on("measurement"),
        undetermined_effects=on("nuisance", "undetermined"),
        dataset=result.dataset.model_dump(mode="json"),
        attributed={
            one.name: sides[one.role]
            for one in result.effects
            if one.role in sides and get_effect(one.name).role != one.role
        },
        command=result.run.command,
        split={
            **result.split.model_dump(mode="json"),
            "lock_box_files_sha256": sorted(store.files_sha256(result.split.lock_box).values()),
        },
        training_level_share=level_share([scan.stored for scan in closed.given.scans]),
        training_step_share=step_share([scan.stored for scan in closed.given.scans]),
        confusable_sets=[[e.name, *e.confusable_with] for e in result.effects if e.confusable_with],
        metrics=[
            {"name": "mae_datum_free", "value": error.mae_nm, "split": "grouped", "policy": error.policy},
        ],
    )
