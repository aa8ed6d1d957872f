"""The record of a front: designs of one hologram that trade efficiency against likeness."""

from __future__ import annotations

from typing import ClassVar

from litho_data.foundation.results import Record, Result
from litho_data.foundation.run_facts import RunFacts


class FrontPoint(Record):
    """One design of the front, and whether none of the others is better in both figures."""

    efficiency_weight: float
    folder: str
    si_psnr_db: float
    eff_signal: float
    on_front: bool


class FrontResult(RunFacts, Result):
    """front.json."""

    SCHEMA: ClassVar[str] = "litho-design/front/1"
    FILE_NAME: ClassVar[str] = "front.json"

    figure: str
    points: list[FrontPoint]
    baselines: dict[str, dict[str, float]] | None
