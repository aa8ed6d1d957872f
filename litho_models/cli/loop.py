"""The commands `close-loop` (correct a model), `next-print` (plan prints) and `check` (monitor a printer)."""

from pathlib import Path
from typing import Annotated, Literal

import typer

import litho_models
from litho_data.commands.app import DaskOption, WorkersOption, argument, option, with_further_options
from litho_data.commands.progress import say
from litho_data.commands.settings import assigned
from litho_data.reports.paper import with_paper_copies

FixOption = Annotated[
    list[str] | None, option("parameter of the model that is not fitted, such as eta; repeatable", "--fix")
]
FreeOption = Annotated[
    list[str] | None,
    option("parameter of the model that is fitted although it is fixed by default; repeatable", "--free"),
]


@with_further_options
@with_paper_copies
def close_loop(
    stores: Annotated[
        list[Path],
        argument(
            "dataset store made by litho-data build; more stores may be given, with later prints of the same "
            "printer that decide the questions left open by the first store"
        ),
    ],
    out: Annotated[Path, option("folder for the result, the report, the tables and the corrected model")],
    base: Annotated[
        str,
        option("model to correct: a name, a frozen model (a folder or zoo:NAME), or auto for the best one"),
    ] = "auto",
    set_: Annotated[
        list[str] | None,
        option("setting FIELD=VALUE of a small base model, such as spot.sigma_um=0.3; repeatable", "--set"),
    ] = None,
    fix: FixOption = None,
    free: FreeOption = None,
    folds: Annotated[int, option("number of folds into which the scans are divided", min=2)] = 5,
    nested: Annotated[
        Literal["folds", "prints"] | None,
        option(
            "also leave out each fold (or print) in turn, repeat the whole search without it, and score the "
            "result "
            "on it; slow"
        ),
    ] = None,
    inject: Annotated[
        list[str] | None,
        option(
            "add the effect NAME with strength AMOUNT (in its unit) to copies of the data, to see whether it "
            "is found"
        ),
    ] = None,
    open_lock_box: Annotated[
        bool, option("also score the locked scans; do this only once", "--open-lock-box")
    ] = False,
    steps: Annotated[
        int | None, option("number of optimiser steps per fold, if the base model is a network", min=1)
    ] = None,
    cache: Annotated[
        Path | None,
        option("folder that keeps the networks trained for each fold; by default a folder next to --out"),
    ] = None,
    seed: Annotated[
        int, option("seed of the folds and the bootstrap; it does not change which scans are locked", min=0)
    ] = 0,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
) -> None:
    """Find effects that occur in measured prints but not in a model, and add them to the model. Report the
    error of this corrected model on held-out scans, in nm.

    Example: litho-models close-loop prints.zarr --out loop
    """
    from litho_models.loop.report import said
    from litho_models.models import fixed_numbers

    settings = assigned(set_ or ())
    if fix or free:
        settings["fixed"] = fixed_numbers(base, fix or (), free or ())
    result = litho_models.close_loop(
        stores[0],
        out,
        new_prints=stores[1:],
        base=base,
        base_settings=settings,
        folds=folds,
        nested=nested,
        inject=tuple(inject or ()),
        open_lock_box=open_lock_box,
        steps=steps,
        cache=cache,
        seed=seed,
        workers=workers,
        dask=dask,
        report=say,
    )
    typer.echo(said("verdict", result))
    for one in result.effects:
        typer.echo("  " + said("effect", one))
    for decision in result.decisions:
        typer.echo("  " + said("decision", decision))
    typer.echo(f"report: {out / 'report.html'}")


# Exit code of an alarm. It differs from the exit codes for bad input (2) and for a defect of this package
# (1).
EXIT_ALARM = 3


def check(
    model: Annotated[str, argument("folder of a frozen model, or zoo:NAME")],
    store: Annotated[Path, argument("dataset store of the new prints")],
    out: Annotated[Path, option("folder for check.json, the report and the tables")],
    reference: Annotated[
        Path | None,
        option(
            "store of prints made before any change of the printer; by default the values in the model's card"
        ),
    ] = None,
    new: Annotated[
        list[str] | None,
        option("id of a new print in STORE; the other prints are the reference; repeatable"),
    ] = None,
    false_alarms: Annotated[
        float, option("accepted share of datasets that raise an alarm although the printer has not changed")
    ] = 0.005,
    tolerance: Annotated[
        float | None,
        option(
            "largest accepted drift of a monitored value, as a fraction (0.05: 5 %); by default three times "
            "its spread"
        ),
    ] = None,
    strict: Annotated[bool, option(f"exit with code {EXIT_ALARM} on an alarm", "--strict")] = False,
) -> None:
    """Tell whether new prints differ from the reference prints of a model, and when to measure again.

    Example: litho-models check printer new-prints.zarr --out check
    """
    from litho_models.monitoring import check as check_prints

    result = check_prints(
        model,
        store,
        out,
        reference=reference,
        new=new or (),
        false_alarms=false_alarms,
        tolerance=tolerance,
    )
    for sentence in [*result.verdict, *result.notes]:
        typer.echo(sentence)
    typer.echo(f"report {out / 'report.html'}")
    if strict and result.alarm:
        raise typer.Exit(EXIT_ALARM)


def next_print(
    loop: Annotated[Path, argument("folder written by litho-models close-loop")],
    out: Annotated[
        Path,
        option("folder for the plan: dataset card, layouts, table of scans, instruction sheets and report"),
    ],
    prints: Annotated[
        int, option("number of prints to plan, not counting reference prints", min=1, max=12)
    ] = 4,
    field_um: Annotated[float, option("side of a print, µm", min=1.0)] = 51.2,
    layouts: Annotated[
        Literal["optimised", "random"],
        option(
            "optimised: search for layouts that decide the questions; random: plan the same scans of random "
            "layouts, as a control"
        ),
    ] = "optimised",
    seed: Annotated[int, option("seed of the random layouts from which the search starts", min=0)] = 0,
    steps: Annotated[int, option("number of gradient steps for each tile of a layout", min=0)] = 40,
) -> None:
    """Plan the prints and scans that decide the questions left open by close-loop. An interrupted run
    resumes.

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
        report=say,
    )
    if plan is None:
        typer.echo(f"{loop} has no open questions: no print is needed")
        return
    typer.echo(f"{plan.prints} print{'s' * (plan.prints > 1)}, {len(plan.scans)} scans including references")
    for question in plan.questions:
        needed = f" (0.95 needs {question.prints_needed} prints)" if question.prints_needed else ""
        power = f"power {question.power[plan.prints - 1]:.2f}{needed}"
        told = question.text if question.kind == "fact" else power
        typer.echo(f"  {question.name}: {question.status}; {told}")
    typer.echo(f"report: {out / 'report.html'}")
