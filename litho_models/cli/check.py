"""`litho-models check`: does the printer still behave as its model says?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

# Neither bad input (2) nor a defect of ours (1).
EXIT_ALARM = 3


def check(
    model: Annotated[str, typer.Argument(help="folder of a frozen model, or zoo:NAME")],
    store: Annotated[Path, typer.Argument(help="dataset store of the new prints")],
    out: Annotated[Path, typer.Option("--out", help="folder for check.json, report and tables")],
    reference: Annotated[
        Path | None,
        typer.Option(help="store of unchanged prints; the prints in the model's card by default"),
    ] = None,
    new: Annotated[
        list[str] | None,
        typer.Option(help="a print of STORE that is new, the others are the reference; repeatable"),
    ] = None,
    residuals: Annotated[
        list[Path] | None,
        typer.Option(
            help="folder of `benchmark` on the reference prints: errors of prints that no fit had seen"
        ),
    ] = None,
    false_alarms: Annotated[
        float, typer.Option(help="share of unchanged data sets that raise an alarm")
    ] = 0.005,
    tolerance: Annotated[
        float | None,
        typer.Option(help="largest drift of a figure, 0.05 is 5 %; by default three times its spread"),
    ] = None,
    strict: Annotated[
        bool, typer.Option("--strict", help=f"end with exit code {EXIT_ALARM} on an alarm")
    ] = False,
) -> None:
    """Tell whether new prints differ from those a model was made of, and when to measure again.

    Example: litho-models check printer new-prints.zarr --out check
    """
    from litho_models.monitoring import check as check_prints

    result = check_prints(
        model,
        store,
        out,
        reference=reference,
        new=new or (),
        residuals=residuals or (),
        false_alarms=false_alarms,
        tolerance=tolerance,
    )
    for sentence in [*result.verdict, *result.notes]:
        typer.echo(sentence)
    typer.echo(f"report {out / 'report.html'}")
    if strict and result.alarm:
        raise typer.Exit(EXIT_ALARM)
