"""`litho-models close-loop`: from residual to cause to a better model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import litho_models
from litho_data.foundation.app import DaskOption, WorkersOption
from litho_data.foundation.errors import InputError


def close_loop(
    stores: Annotated[
        list[Path],
        typer.Argument(
            help="dataset store made by litho-data build; further stores of the same printer, later prints, "
            "decide what the first leaves open"
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="folder for result, report, tables and the corrected model")
    ],
    base: Annotated[
        str,
        typer.Option(
            "--base",
            help="model to correct: its name, a frozen model (a folder, zoo:NAME), or auto: small models "
            "compete, causes are sought together, strengths by group, and laws where no name holds",
        ),
    ] = "physics",
    prior: Annotated[
        str | None,
        typer.Option(
            "--prior",
            help="effects known from earlier looks at these data: a file with one name per line, or a,b,c",
        ),
    ] = None,
    inject: Annotated[
        list[str] | None,
        typer.Option(
            "--inject",
            help="plant NAME=AMOUNT (its own unit) in copies of the data, report the power to find it",
        ),
    ] = None,
    open_lock_box: Annotated[
        bool, typer.Option("--open-lock-box", help="also score the locked scans; do this once")
    ] = False,
    folds: Annotated[int, typer.Option("--folds", min=2, help="outer folds, by scan")] = 6,
    steps: Annotated[
        int | None, typer.Option("--steps", min=1, help="optimiser steps of a network as base, per fold")
    ] = None,
    cache: Annotated[
        Path | None,
        typer.Option("--cache", help="folder of trained folds and nested choices; beside --out by default"),
    ] = None,
    loss: Annotated[
        Literal["squares", "absolute"],
        typer.Option("--loss", help="what fits minimise: squares, or absolute errors as in a benchmark"),
    ] = "squares",
    weights: Annotated[
        Literal["uniform", "sigma"],
        typer.Option(
            "--weights", help="what pixels count for in fits: alike, or by 1 / σ; all else counts them alike"
        ),
    ] = "uniform",
    background: Annotated[
        Literal["none", "training"],
        typer.Option("--background", help="training: report errors with the background of a benchmark"),
    ] = "none",
    nested: Annotated[
        Literal["folds", "prints"] | None,
        typer.Option(
            "--nested",
            help="also choose everything anew without each fold, or each print, and judge it there; takes as "
            "many runs of the loop, resumes where it was interrupted; small bases only",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="folds and bootstrap, not the lock box")] = 0,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
) -> None:
    """Find what a model lacks on measured prints, add it, and report the error on held-out scans (nm).

    Example: litho-models close-loop prints.zarr --base physics --out loop
    """
    if base == "auto":
        others = {
            "--prior": prior, "--inject": inject, "--steps": steps,
            "--cache": cache, "--loss": loss != "squares", "--weights": weights != "uniform",
            "--background": background != "none",
        }  # fmt: skip
        if given := [name for name, value in others.items() if value]:
            raise InputError(f"--base auto with {given[0]}", wanted="a named base, or none of it")
        _close_together(stores, out, folds, nested, open_lock_box, seed, workers, dask)
        return
    from litho_models.loop import LoopConfig, parse_priors
    from litho_models.loop.report.wording import error_lines, verdict_text

    config = LoopConfig(
        folds=folds,
        seed=seed,
        loss=loss,
        weights=weights,
        background=background,
        nested=nested,
        open_lock_box=open_lock_box,
        prior_hypotheses=parse_priors(prior),
        inject=tuple(inject or ()),
    )
    result = litho_models.close_loop(
        stores[0],
        out,
        new_prints=stores[1:],
        base=base,
        config=config,
        steps=steps,
        cache=cache,
        workers=workers,
        dask=dask,
        report=lambda message: typer.echo(message, err=True),
    )
    for line in (verdict_text(result), *error_lines(result)):
        typer.echo(line)
    for effect in result.effects:
        alike = f" (or {', '.join(effect.confusable_with)})" if effect.confusable_with else ""
        typer.echo(
            f"  {effect.name}{alike}: {effect.verdict}, {effect.before_nm:.2f} -> {effect.after_nm:.2f} nm"
        )
    for one in result.decisions or []:
        left = ", ".join(one.left) or "none"
        typer.echo(f"  new prints on {one.question}: {one.verdict}: {left}; {one.evidence}")
    typer.echo(f"report: {out / 'report.html'}")


def _close_together(
    stores: list[Path],
    out: Path,
    folds: int,
    nested: Literal["folds", "prints"] | None,
    open_lock_box: bool,
    seed: int,
    workers: int,
    dask: str | None,
) -> None:
    """Causes and laws sought together, with strengths by group."""
    from litho_models.planning.rounds import close_loop as close_with_questions
    from litho_models.twin.report import decision_text, effect_text, verdict_text

    result = close_with_questions(
        stores[0],
        out,
        new_prints=stores[1:],
        folds=folds,
        nested=nested,
        open_lock_box=open_lock_box,
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
