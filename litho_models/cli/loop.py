"""`litho-models close-loop`: from residual to cause to a better model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import litho_models
from litho_data.commands.app import DaskOption, WorkersOption


def close_loop(
    stores: Annotated[
        list[Path],
        typer.Argument(
            help="dataset store made by litho-data build; further stores, later prints of the same printer, "
            "decide what the first leaves open"
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="folder for result, report, tables and the corrected model")
    ],
    base: Annotated[
        str,
        typer.Option(
            "--base", help="model to correct: its name, a frozen one (a folder, zoo:NAME), or auto: the best"
        ),
    ] = "auto",
    folds: Annotated[int, typer.Option("--folds", min=2, help="by scan")] = 5,
    nested: Annotated[
        Literal["folds", "prints"] | None,
        typer.Option(
            "--nested", help="also choose all anew without each fold, or print, and judge it there; slow"
        ),
    ] = None,
    inject: Annotated[
        list[str] | None,
        typer.Option("--inject", help="plant NAME=AMOUNT (its own unit) in copies of the data: is it found?"),
    ] = None,
    open_lock_box: Annotated[
        bool, typer.Option("--open-lock-box", help="also score the locked scans; do this once")
    ] = False,
    steps: Annotated[
        int | None, typer.Option("--steps", min=1, help="optimiser steps of a network as base, per fold")
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="folder of a network's trainings per fold; beside --out by default"),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="folds and bootstrap, not the lock box")] = 0,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
) -> None:
    """Find what a model lacks on measured prints, add it, and report the error on held-out scans (nm).

    Example: litho-models close-loop prints.zarr --out loop
    """
    from litho_models.loop.report import decision_text, effect_text, verdict_text

    result = litho_models.close_loop(
        stores[0],
        out,
        new_prints=stores[1:],
        base=base,
        folds=folds,
        nested=nested,
        inject=tuple(inject or ()),
        open_lock_box=open_lock_box,
        steps=steps,
        cache=cache,
        seed=seed,
        workers=workers,
        dask=dask,
        report=lambda message: typer.echo(message, err=True),
    )
    typer.echo(verdict_text(result))
    for one in result.effects:
        typer.echo(f"  {effect_text(one)}")
    for decision in result.decisions:
        typer.echo(f"  {decision_text(decision)}")
    typer.echo(f"report: {out / 'report.html'}")
