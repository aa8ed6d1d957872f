"""The command line ``litho-models``. Every command parses its arguments and calls one public function."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import litho_models
from litho_data.commands.app import (
    App,
    DaskOption,
    WorkersOption,
    argument,
    new_app,
    option,
    run_app,
    with_further_options,
)
from litho_data.commands.settings import assigned
from litho_data.foundation.errors import InputError
from litho_data.foundation.units import NM_PER_UM
from litho_data.reports.paper import with_paper_copies
from litho_models.cli.board import board
from litho_models.cli.loop import FixOption, FreeOption, check, close_loop, next_print
from litho_models.cli.noise import noise

app = new_app("Train, judge and correct models of the printer. Lengths are in µm and height errors in nm.")
app.command("close-loop")(close_loop)
app.command("next-print")(next_print)
app.command()(noise)
app.command()(check)
zoo = App(help="List or show the models that come with the package.", no_args_is_help=True)
app.add_typer(zoo, name="zoo")
app.add_typer(board, name="board")

ModelName = Annotated[str, argument("folder of a frozen model, or zoo:NAME for a model of the package")]
StorePath = Annotated[Path, argument("dataset store made by `litho-data build`")]
Out = Annotated[Path, option("folder of the result")]
PolicyOption = Annotated[
    Literal["none", "offset", "offset-gain", "full", "full+rows"] | None,
    option("terms fitted to each scan before scoring; by default offset, for films none"),
]
_BACKGROUND_HELP = "training: add the background that the training scans share"
BackgroundOption = Annotated[Literal["training", "none"] | None, option(_BACKGROUND_HELP)]
SharedOption = Annotated[
    Literal["training", "shared", "none"] | None,
    option(f"{_BACKGROUND_HELP}; shared: apply a measurement model"),
]
NoiseOption = Annotated[
    Path | None,
    option("noise.json of this dataset, whose noise floor is shown"),
]
RecipeOption = Annotated[
    Literal["fast", "paper"],
    option("training: fast takes minutes, paper 4,000 epochs"),
]
VariantOption = Annotated[
    Literal["default", "paper", "authors"],
    option("settings of the model: ours (default), those of the paper, or those of its authors' code"),
]
Steps = Annotated[int | None, option("optimiser steps; by default those of the recipe", min=1)]
Seed = Annotated[int, option("seed of the initial weights and of the splits", min=0)]
SetOption = Annotated[
    list[str] | None,
    option(
        "FIELD=VALUE of training or model, such as learning_rate=0.001; repeatable",
        "--set",
    ),
]


@app.command()
def train(
    store: StorePath,
    model: Annotated[
        str,
        option(
            "identity, affine, affine-mtf, blur-table, linear, features, random-features, physics, "
            "e-beam, projection, laser-writer, dmd-grayscale, pbl or fno"
        ),
    ],
    out: Out,
    recipe: RecipeOption = "fast",
    variant: VariantOption = "default",
    steps: Steps = None,
    seed: Seed = 0,
    set_: SetOption = None,
    fix: FixOption = None,
    free: FreeOption = None,
    use_lock_box: Annotated[
        bool,
        option("also train on the locked scans; no scan is then left for a final test", "--use-lock-box"),
    ] = False,
) -> None:
    """Train a model on all scans except the locked ones. An interrupted run resumes.

    Example: litho-models train prints.zarr --model pbl --out run
    """
    from litho_models.frozen.card import bounds_text
    from litho_models.models import fixed_numbers

    settings = _training(set_, recipe=recipe, variant=variant, seed=seed, steps=steps)
    if fix or free:
        settings["fixed"] = fixed_numbers(model, fix or (), free or ())
    run = litho_models.train(
        store, model, out, recipe=settings.pop("recipe"), settings=settings, use_lock_box=use_lock_box
    )
    typer.echo(f"{model} trained on {len(run.training_ids)} scans in {run.seconds:.0f} s: {out}")
    if run.at_bounds:
        typer.echo(bounds_text(run.at_bounds))


@app.command()
@with_further_options
@with_paper_copies
def evaluate(
    model: ModelName,
    store: StorePath,
    out: Out,
    policy: PolicyOption = None,
    background: BackgroundOption = None,
    noise: NoiseOption = None,
    extrapolate: Annotated[
        bool, option("accept layouts beyond the calibrated range", "--extrapolate")
    ] = False,
    open_lock_box: Annotated[
        bool,
        option(
            "also score the locked scans of the training dataset; do this only once per release",
            "--open-lock-box",
        ),
    ] = False,
) -> None:
    """Score one frozen model on a store. If the model was trained on this dataset, locked scans are left out.

    Example: litho-models evaluate zoo:pbl prints.zarr --out evaluation
    """
    from litho_models.evaluation.reports import lock_box_text
    from litho_models.evaluation.wording import evaluation_verdict

    result = litho_models.evaluate(
        model,
        store,
        out,
        policy=policy,
        background=background,
        noise=noise,
        extrapolate=extrapolate,
        open_lock_box=open_lock_box,
    )
    typer.echo(lock_box_text(result.split))
    typer.echo(evaluation_verdict(result))
    typer.echo(f"report {out / 'report.html'}")


@app.command()
@with_further_options
@with_paper_copies
def benchmark(
    store: StorePath,
    out: Out,
    split: Annotated[
        Literal["grouped", "paper", "leave-one-print-out"],
        option("what each fold holds out: scans, random quadrants, or a print"),
    ] = "grouped",
    models: Annotated[str | None, option("names of models, separated by commas; by default all")] = None,
    recipe: RecipeOption = "fast",
    variant: VariantOption = "default",
    steps: Steps = None,
    folds: Annotated[int, option("number of folds of the grouped split", min=2)] = 5,
    first_folds: Annotated[
        int | None,
        option("number of folds to fit; by default all", min=1),
    ] = None,
    policy: PolicyOption = None,
    background: SharedOption = None,
    noise: NoiseOption = None,
    open_lock_box: Annotated[
        bool, option("also score the locked scans; do this only once", "--open-lock-box")
    ] = False,
    seed: Seed = 0,
    set_: SetOption = None,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
) -> None:
    """Cross-validate models: for each fold, train every model on the other folds and score it on this fold.
    An interrupted run resumes.

    Example: litho-models benchmark prints.zarr --models affine,physics,pbl --out benchmark
    """
    from litho_models.evaluation.benchmark import DEFAULT_MODELS
    from litho_models.evaluation.tables import headline_table
    from litho_models.evaluation.wording import benchmark_verdict
    from litho_models.scoring.statistics import FEWEST_FOR_INTERVAL

    settings = _training(set_, recipe=recipe, variant=variant, steps=steps)
    result = litho_models.benchmark(
        store,
        out,
        split=split,
        models=[name.strip() for name in models.split(",") if name.strip()] if models else DEFAULT_MODELS,
        settings=settings,
        folds=folds,
        first_folds=first_folds,
        policy=policy,
        background=background,
        noise=noise,
        open_lock_box=open_lock_box,
        seed=seed,
        workers=workers,
        dask=dask,
    )
    table = headline_table(result.scores, result.nuisance, result.noise_floor)
    typer.echo(table.round(2).to_string(index=False, na_rep="–"))
    scored = len(result.split.scored_ids)
    if scored < FEWEST_FOR_INTERVAL:
        typer.echo(f"no intervals: there are {scored} scans, but at least {FEWEST_FOR_INTERVAL} are needed")
    typer.echo(benchmark_verdict(result))
    typer.echo(f"report {out / 'report.html'}")


@app.command()
def predict(
    model: ModelName,
    layout: Annotated[
        Path,
        argument("layout: a TIFF, PNG, BMP or NPY file of levels, or any file that litho-design exported"),
    ],
    out: Annotated[Path, option("file for the height in µm: .gsf (opens in Gwyddion) or .npy")],
    extrapolate: Annotated[
        bool, option("accept levels beyond the calibrated range", "--extrapolate")
    ] = False,
) -> None:
    """Predict the printed height of a layout. The layout must be sampled at the pitch of the model.

    An element that litho-design exported is surrounded by level 0. Any other layout is continued by repeating
    its outermost pixels.

    Example: litho-models predict zoo:pbl layout.png --out height.gsf
    """
    from litho_models.frozen.on_store import predict_file

    frozen = litho_models.load_frozen(model, extrapolate=extrapolate)
    height, surround = predict_file(frozen, layout, out)
    rows, columns = height.shape
    typer.echo(f"layout of {rows} x {columns} px, {surround}")
    typer.echo(f"print {height.min():.3f} to {height.max():.3f} µm high: {out}")


@app.command()
def export(
    model: ModelName,
    out: Annotated[Path, option("file to write: .pt2 (for torch.export) or .onnx (needs the extra onnx)")],
    size_px: Annotated[
        int, option("side, in pixels, of the layouts that the exported program accepts", min=1)
    ] = 512,
) -> None:
    """Write a frozen model as a program for layouts of one size, which runs without this package.

    Example: litho-models export zoo:pbl --size-px 512 --out pbl.onnx
    """
    from litho_models.frozen.exporting import export_model

    frozen = litho_models.load_frozen(model)
    difference_um = export_model(frozen, out, size_px)
    typer.echo(
        f"{out} accepts float32 layouts of {size_px} x {size_px} px in µm, shape (1, 1, ny, nx). Its heights "
        "differ "
        f"from those of the model by at most {NM_PER_UM * difference_um:.2g} nm"
    )


@zoo.command("list")
def list_zoo() -> None:
    """List the models that come with the package, and their errors on held-out scans.

    Example: litho-models zoo list
    """
    from litho_models.frozen.card import ModelCard

    zoo = litho_models.zoo
    for name in zoo.list():
        card = ModelCard.read(zoo.folder(name))
        error = card.held_out.text if card.held_out else "no held-out error"
        best = f"  = {zoo.PREFIX}{zoo.BEST}" * (zoo.folder(name) == zoo.folder(zoo.BEST))
        typer.echo(f"{zoo.PREFIX + name:20} {error}, {card.parameters:,} parameters{best}")


@zoo.command("show")
def show_zoo(name: Annotated[str, argument("name of a model of the zoo")]) -> None:
    """Show the page of a model that comes with the package.

    Example: litho-models zoo show pbl
    """
    folder = litho_models.zoo.folder(name.removeprefix(litho_models.zoo.PREFIX))
    # The front matter is left out, because only programs read it.
    typer.echo((folder / "README.md").read_text(encoding="utf-8").split("---\n", 2)[-1].strip())


@app.command()
def compare(
    first: Annotated[Path, argument("benchmark.json or evaluation.json of the first result")],
    second: Annotated[Path, argument("another result with the same protocol")],
) -> None:
    """Compare the errors of two results scan by scan. Both results must have the same data, folds and
    per-scan terms.

    Example: litho-models compare one/benchmark.json other/benchmark.json
    """
    typer.echo(litho_models.compare(first, second).round(3).to_string(index=False))


@app.command()
def freeze(
    run: Annotated[
        str, argument("output folder of `train` or `close-loop`, or a frozen model (a folder or zoo:NAME)")
    ],
    out: Out,
    attribute: Annotated[
        list[str] | None,
        option(
            "attribute effects of undetermined role to the printer or to the microscope: all of these "
            "effects, or "
            "only EFFECT; repeatable",
            metavar="[EFFECT=]microscope|printer",
        ),
    ] = None,
) -> None:
    """Freeze the process model of a run, without the measurement model. Write the weights, the card
    (card.json) and a page for readers (README.md) of the frozen model.

    Example: litho-models freeze run --out printer
    """
    card = litho_models.freeze(run, out, _attribution(attribute or []))
    typer.echo(f"{card.name}: {card.parameters} parameters, frozen in {out}")


def _attribution(given: Sequence[str]) -> Any:
    """Parse the values of the option ``--attribute``. The values state one side (printer or microscope) for
    all effects, or one side for each named effect.
    """
    if len(given) == 1 and "=" not in given[0]:
        return given[0]
    if wrong := [text for text in given if "=" not in text]:
        raise InputError(
            "--attribute",
            got=wrong[0],
            wanted="EFFECT=microscope or EFFECT=printer each time, because the option is used more than once",
        )
    return dict(text.split("=", 1) for text in given)


def main() -> None:
    """Entry point of ``litho-models``."""
    run_app(app, "litho-models")


def _training(words: Sequence[str] | None, **options: Any) -> dict[str, Any]:
    """Combine the training settings from ``--set`` with the training settings from other options."""
    found = assigned(words or ())
    if twice := sorted(found.keys() & options.keys()):
        raise InputError(
            "--set", got=f"{twice[0]}, which another option also sets", wanted="each setting only once"
        )
    return {name: value for name, value in options.items() if value is not None} | found
