"""A plan of prints and scans, carried out in a fab that has printed before."""

from pathlib import Path

from litho_data.cards.card import load_card
from litho_data.foundation.errors import InputError
from litho_data.layouts.card_text import CARD_NAME
from litho_data.virtual_fab.jobs import jobs_of_card
from litho_data.virtual_fab.printer import Cause
from litho_data.virtual_fab.simulate import simulate
from litho_data.virtual_fab.truth import Truth


def simulate_plan(
    plan: str | Path, fab: str | Path, out: str | Path, *, seed: int = 1, cause: Cause | None = None
) -> Path:
    """Print and scan a plan in the fab of an earlier run; returns the path of the new card.

    The machine is the same: printer, microscope, noise and knobs with their seeds. The run is a new one: what
    is drawn for single prints and scans is drawn afresh.

    Args:
        plan: folder with ``card.toml``, layouts and ``scans.csv``, as `litho-models next-print` writes it.
        fab: folder of the earlier run, with its ``truth``.
        out: where ``raw`` and ``truth`` of the new run go.
        seed: of the new draws; another than the earlier run's.
        cause: what that run had beside its knobs.

    Raises:
        InputError: no plan, no truth, the seed of the earlier run, or layouts that its printer cannot write.
    """
    card = Path(plan) / CARD_NAME
    truth = Truth.read(Path(fab) / "truth")
    if seed == truth.seed:
        raise InputError("seed", got=seed, wanted="another than the earlier run's: the prints are new")
    about = load_card(card)
    return simulate(
        out,
        jobs=jobs_of_card(card, first=len(truth.scans), printer=truth.printer),
        seed=seed,
        knobs=[knob.setting for knob in truth.knobs],
        cause=cause,
        noise=truth.noise,
        microscope=truth.microscope,
        printer=truth.printer,
        name=about.name,
        print_pattern=about.ids.print or "",
        plan_of=about.plan.dataset_sha256 if about.plan else "",
    )
