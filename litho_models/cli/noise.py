"""`litho-models noise`: what no model of the printer can predict."""

from pathlib import Path
from typing import Annotated

import typer

import litho_models
from litho_data.commands.app import argument, option
from litho_data.foundation.errors import InputError

# What only single files need, and what only a store has.
OF_FILES = ("substrate", "flat", "steps", "unit", "size_um", "level_height_um")
OF_A_STORE = ("residuals", "model", "seed")


def noise(
    context: typer.Context,
    out: Annotated[Path, option("folder for noise.json, report and tables")],
    store: Annotated[
        Path | None, argument("dataset store; its scans marked substrate, flat or steps are used")
    ] = None,
    substrate: Annotated[Path | None, option("scan of the bare substrate, without a store")] = None,
    flat: Annotated[Path | None, option("scan of a flat print, without a store")] = None,
    steps: Annotated[Path | None, option("scan of a step print, without a store")] = None,
    unit: Annotated[str | None, option("unit of these scans where the files state none")] = None,
    size_um: Annotated[
        tuple[float, float] | None,
        option("their size in µm where the files state none", metavar="Y X"),
    ] = None,
    level_height_um: Annotated[float, option("nominal step of the step print, µm")] = 0.1,
    residuals: Annotated[
        list[str] | None,
        option(
            "folder of `benchmark`, for the noise budget and σ(x), or a frozen model (a folder, "
            "zoo:NAME), for σ(x) alone; several are an ensemble; repeatable"
        ),
    ] = None,
    model: Annotated[str | None, option("which model of the benchmark; its best one by default")] = None,
    seed: Annotated[int, option("seed of the pixels drawn", min=0)] = 0,
) -> None:
    """Roughness, dose matrix, noise budget, σ(x) and its calibration; lengths in µm, noise in nm.

    Example: litho-models noise prints.zarr --residuals benchmark --out noise
    """
    from litho_models.noise import analyse_noise_of_files
    from litho_models.noise.report import noise_verdict

    _check_given(context)
    if store is not None:
        result = litho_models.analyse_noise(store, out, residuals=residuals or (), model=model, seed=seed)
    else:
        result = analyse_noise_of_files(
            out,
            flat=Path(flat or ""),
            substrate=substrate,
            steps=steps,
            unit=unit,
            size_um=size_um,
            level_height_um=level_height_um,
        )
    typer.echo(noise_verdict(result.noise_floor))
    if result.dose is not None:
        typer.echo(f"recommended dose {result.dose.recommended_dose:g}: {result.dose.reason}")
    typer.echo(f"report {out / 'report.html'}")


def _check_given(context: typer.Context) -> None:
    """Require a store, or files with a flat print among them, and only the options of the one given."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    given = {name for name, source in sources.items() if source is not None and source.name == "COMMANDLINE"}

    def options(names: tuple[str, ...]) -> str:
        return ", ".join(f"--{name.replace('_', '-')}" for name in names if name in given)

    if "store" in given and (of_files := options(OF_FILES)):
        raise InputError("noise", got=f"a store and {of_files}", wanted="a store, or files without one")
    if "store" not in given and "flat" not in given:
        raise InputError(
            "noise", got=options(OF_FILES) or "nothing to analyse", wanted="a store, or --flat and its scan"
        )
    if "flat" in given and (of_a_store := options(OF_A_STORE)):
        raise InputError("noise", got=f"--flat and {of_a_store}", wanted=f"a store for {of_a_store}")
    if "level_height_um" in given and "store" not in given and "steps" not in given:
        raise InputError("noise", got="--level-height-um", wanted="--steps too, the scan of the steps")
