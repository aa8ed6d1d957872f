"""The command `litho-models noise`: estimate the noise, which is the part of the error that no model of the
printer can predict.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

import litho_models
from litho_data.commands.app import argument, option
from litho_data.foundation.errors import InputError


def noise(
    out: Annotated[Path, option("folder for noise.json, the report and the tables")],
    store: Annotated[
        Path | None,
        argument(
            "dataset store; scans marked substrate, flat or steps, repeated prints, and scans with a dose "
            "are used"
        ),
    ] = None,
    substrate: Annotated[Path | None, option("scan of the bare substrate, instead of a store")] = None,
    flat: Annotated[Path | None, option("scan of a flat print, instead of a store")] = None,
    steps: Annotated[Path | None, option("scan of a printed step pattern, instead of a store")] = None,
    unit: Annotated[str | None, option("height unit of the scan files, if they do not state it")] = None,
    size_um: Annotated[
        tuple[float, float] | None,
        option("size of the scans in µm, if the files do not state it", metavar="Y X"),
    ] = None,
    level_height_um: Annotated[
        float | None, option("nominal height of one step of this pattern, µm; 0.1 by default")
    ] = None,
    residuals: Annotated[
        str | None,
        option(
            "output folder of `benchmark` (for the noise budget and σ(x)), or a frozen model: a folder or "
            "zoo:NAME (for σ(x) only)"
        ),
    ] = None,
    model: Annotated[
        str | None, option("model of the benchmark whose residuals are used; by default the best")
    ] = None,
    seed: Annotated[int, option("seed for the random choice of pixels", min=0)] = 0,
) -> None:
    """Compute the roughness, the dose matrix, the noise budget, and the calibrated noise level σ(x) at each
    pixel. Lengths are in µm, noise in nm.

    Example: litho-models noise prints.zarr --residuals benchmark --out noise
    """
    from litho_models.noise import analyse_noise_of_files
    from litho_models.noise.report import noise_verdict

    files: dict[str, Any] = {"substrate": substrate, "flat": flat, "steps": steps}
    files |= {"unit": unit, "size_um": size_um, "level_height_um": level_height_um}
    of_files = {name: value for name, value in files.items() if value is not None}
    of_a_store = _options(name for name, value in (("residuals", residuals), ("model", model)) if value)
    given = _options(of_files)
    if store is not None and of_files:
        raise InputError("noise", got=f"a store and {given}", wanted="either a store or single files")
    if store is not None:
        result = litho_models.analyse_noise(store, out, residuals=residuals, model=model, seed=seed)
    elif flat is None:
        wanted = "a store, or --flat with the scan of a flat print"
        raise InputError("noise", got=given or "nothing to analyse", wanted=wanted)
    elif of_a_store:
        raise InputError("noise", got=f"--flat and {of_a_store}", wanted=f"a store with {of_a_store}")
    elif level_height_um is not None and steps is None:
        raise InputError(
            "noise",
            got="--level-height-um without --steps",
            wanted="--steps SCAN, a scan of a printed step pattern",
        )
    else:
        result = analyse_noise_of_files(out, **of_files)
    typer.echo(noise_verdict(result.noise_floor))
    if result.dose is not None:
        typer.echo(f"recommended dose {result.dose.recommended_dose:g}: {result.dose.reason}")
    typer.echo(f"report {out / 'report.html'}")


def _options(names: Iterable[str]) -> str:
    return ", ".join(f"--{name.replace('_', '-')}" for name in names)
