"""`litho-models next-print`: the prints and scans that decide what a closed loop left open."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def next_print(
    loop: Annotated[Path, typer.Argument(help="folder of litho-models close-loop")],
    out: Annotated[
        Path, typer.Option("--out", help="folder of the plan: card, layouts, table of scans, sheets, report")
    ],
    prints: Annotated[int, typer.Option("--prints", min=1, help="prints to plan, references apart")] = 4,
    field_um: Annotated[float, typer.Option("--field-um", min=1.0, help="side of a print, µm")] = 51.2,
    layouts: Annotated[
        Literal["optimised", "random"],
        typer.Option("--layouts", help="random: a control, the same scans of layouts with nothing optimised"),
    ] = "optimised",
    seed: Annotated[int, typer.Option("--seed", min=0, help="of the random layouts to start from")] = 0,
    steps: Annotated[int, typer.Option("--steps", min=0, help="of the ascent of each tile")] = 40,
) -> None:
    """Plan the prints and scans that decide what a closed loop left open; resumes after a kill.

    Example: litho-models next-print loop --out plan
    """
    from litho_models.planning.run import next_print as plan_next_print

    plan = plan_next_print(
        loop,
        out,
        prints=prints,
        field_um=field_um,
        seed=seed,
        steps=steps,
        layouts=layouts,
        report=lambda message: typer.echo(message, err=True),
    )
    if plan is None:
        typer.echo(f"nothing is open in {loop}: no print is needed")
        return
    typer.echo(f"{plan.prints} print{'s' * (plan.prints > 1)}, {len(plan.scans)} scans with the references")
    for question in plan.questions:
        needed = f", {question.prints_needed} prints for 0.95" if question.prints_needed else ""
        power = f"power {question.power[plan.prints - 1]:.2f}{needed}"
        told = question.text if question.kind == "fact" else power
        typer.echo(f"  {question.name}: {question.status}; {told}")
    typer.echo(f"report: {out / 'report.html'}")
