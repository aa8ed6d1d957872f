"""The command line ``litho-data``: every command parses arguments and calls one public function."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from litho_data.cli.layouts import masks, simulate
from litho_data.cli.scan import inspect, level
from litho_data.cli.tip import tip
from litho_data.commands.app import DaskOption, WorkersOption, argument, new_app, option, run_app

app = new_app(
    "Turn raw AFM scans and layouts into a dataset with provenance. Lengths are in µm unless stated "
    "otherwise."
)
app.command()(masks)
app.command()(simulate)
app.command()(inspect)
app.command()(level)
app.command()(tip)

StorePath = Annotated[Path, argument("dataset store, a .zarr folder or .zarr.zip file")]
DataDir = Annotated[
    Path | None,
    option(
        "folder of the raw files; by default searched for beside the card, in $LITHO_DATA_DIR/<name> and "
        "in the user cache"
    ),
]
Strict = Annotated[
    bool,
    option("do not build if a scan is skipped, a scan has no layout, or a layout has no scan", "--strict"),
]


class Format(StrEnum):
    """The formats in which a store can be exported."""

    zip = "zip"
    pairs = "pairs"
    ro_crate = "ro-crate"


@app.command()
def fetch(
    name: Annotated[
        str, argument("name of a dataset of this project, e.g. neural-lithography, or path of a dataset card")
    ],
    into: Annotated[Path | None, option("folder for the downloaded files; by default the user cache")] = None,
) -> None:
    """Download a known dataset, or find it in $LITHO_DATA_DIR or the user cache. The SHA-256 of every file is
    checked.

    Example: litho-data fetch neural-lithography
    """
    from litho_data.cards.fetch import fetch as fetch_dataset

    typer.echo(fetch_dataset(name, into))


@app.command()
def build(
    card: Annotated[Path, argument("dataset card (TOML)")],
    out: Annotated[Path, option("store to write, e.g. prints.zarr; an older store there is replaced")],
    data_dir: DataDir = None,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    strict: Strict = False,
    seed: Annotated[int, option("seed of the random draws of the robust registration", min=0)] = 0,
    suggest: Annotated[
        bool, option("compare levelling recipes on three scans; build nothing", "--suggest")
    ] = False,
    tip: Annotated[
        str | None,
        typer.Option(
            metavar="UM|blind",
            help="radius of the tip in µm, or blind to estimate it from the scans; pixels that the tip "
            "may not have touched become invalid",
        ),
    ] = None,
) -> None:
    """Read, level and register all scans of a dataset card. Write them to a store, and a report beside the
    store.

    With --suggest, nothing is built: levelling recipes are compared on three scans. The best recipe is
    written beside the card, together with a card that uses it.

    Example: litho-data build prints/card.toml --out prints.zarr --workers 2
    """
    if suggest:
        from litho_data.making.result import folder_beside
        from litho_data.making.suggest import suggest_recipe

        folder = folder_beside(out, "levelling")
        found = suggest_recipe(card, folder, data_dir=data_dir)
        for name, of in found.left_nm.items():
            left = ", ".join(f"{scan} {one:.1f} nm" for scan, one in of.items())
            warned = f" ({found.warned[name]})" if name in found.warned else ""
            typer.echo(f"{name}: rms residual of the fit to the layout: {left}{warned}")
        typer.echo(f"suggested recipe: {found.recipe}; to use it, build {found.card}")
        typer.echo(f"pictures {folder / 'report.html'}")
        return
    from litho_data.making.build import build_dataset
    from litho_data.making.result import report_folder

    result = build_dataset(
        card, out, data_dir=data_dir, workers=workers, dask=dask, strict=strict, seed=seed, tip=tip
    )
    unpaired = f"{len(result.unpaired)} without layout or scan, " if result.unpaired else ""
    typer.echo(
        f"{out}: {result.n_scans} scans, {len(result.skipped)} skipped, {unpaired}{result.seconds:.1f} s"
    )
    for key, reason in [*result.unpaired.items()][:1]:
        typer.echo(f"{key}: {reason}", err=True)
    if result.skipped:
        typer.echo(
            f"skipped: {', '.join(result.skipped)}; --strict builds nothing if a scan is skipped", err=True
        )
    typer.echo(f"dataset sha256 {result.dataset.sha256}")
    typer.echo(f"report {report_folder(out) / 'report.html'}")


@app.command()
def calibrate(
    card: Annotated[Path, argument("dataset card (TOML) with a `calibration` table")],
    data_dir: DataDir = None,
) -> None:
    """Measure the gratings and the step that a card names as standards. Show the scale factors that a build
    would apply to the lengths and heights.

    Example: litho-data calibrate prints/card.toml
    """
    from litho_data.making.calibration import calibrate as scales_of

    for axis, scale in scales_of(card, data_dir).items():
        percent = 100 * (scale.factor - 1)
        typer.echo(
            f"{axis}: multiply stated lengths by {scale.factor:.6g} ± {scale.uncertainty:.2g} "
            f"({percent:+.3g} %)"
        )


@app.command()
def verify(store: StorePath, data_dir: DataDir = None) -> None:
    """Recompute the hashes of a store and of its raw files, and list everything that has changed since the
    build.

    Example: litho-data verify prints.zarr
    """
    from litho_data.provenance.verify import verify as verify_store

    result = verify_store(store, data_dir)
    for note in result.notes:
        typer.echo(f"note: {note}")
    for finding in result.findings:
        typer.echo(f"CHANGED {finding}")
    if result.findings:
        raise typer.Exit(1)
    typer.echo(f"unchanged: {result.n_arrays} arrays, {result.n_steps} steps, {result.n_raw_files} raw files")


@app.command()
def history(
    store: StorePath,
    scan: Annotated[str | None, argument("id of a scan; without an id, one line per scan is printed")] = None,
) -> None:
    """Print how the arrays of a scan were made: the files, operations, parameters and hashes.

    Example: litho-data history prints.zarr P11
    """
    from litho_data.provenance.history import history as history_of

    typer.echo(history_of(store, scan))


@app.command()
def replay(
    store: StorePath,
    scan: Annotated[list[str] | None, argument("ids of scans; by default all")] = None,
    array: Annotated[
        list[str] | None, option("name of an array to compare, e.g. height_um; repeatable; by default all")
    ] = None,
    data_dir: DataDir = None,
) -> None:
    """Recompute arrays from the raw files and report the largest difference from those in the store.

    Example: litho-data replay prints.zarr P11 --array height_um
    """
    from litho_data.provenance.history import replay as replay_store

    table = replay_store(store, scan, arrays=array, data_dir=data_dir)
    typer.echo(table.to_string(index=False))
    typer.echo(f"largest difference {table['max_abs_difference'].max():.3g}, over {len(table)} arrays")


@app.command()
def export(
    store: StorePath,
    format: Annotated[
        Format,
        option(
            "zip: one file; pairs: 8-bit files as published with the paper; ro-crate: a folder with metadata"
        ),
    ],
    out: Annotated[Path | None, option("file (zip) or folder to write; by default beside the store")] = None,
) -> None:
    """Write a store as one .zarr.zip file, as pairs of 8-bit layout and height files, or as an RO-Crate
    folder.

    Example: litho-data export prints.zarr --format zip
    """
    endings = {Format.zip: ".zarr.zip", Format.pairs: "-pairs", Format.ro_crate: "-crate"}
    target = out or store.parent / (store.name.split(".zarr")[0] + endings[format])
    if format is Format.zip:
        from litho_data.exchange.release import export_zip

        export_zip(store, target)
    elif format is Format.ro_crate:
        from litho_data.exchange.release import export_ro_crate

        export_ro_crate(store, target)
    else:
        from litho_data.exchange.pairs import export_pairs

        for note in export_pairs(store, target):
            print(note, file=sys.stderr)
    typer.echo(target)


@app.command("import-pairs")
def import_pairs(
    folder: Annotated[Path, argument("folder with mask/, afm/, src_max_dict.txt and possibly valid/")],
    out: Annotated[Path | None, option("store to write; by default FOLDER.zarr")] = None,
    pitch_um: Annotated[float, option("pixel pitch, µm")] = 0.1,
    level_height_um: Annotated[float, option("nominal height of one level, µm")] = 0.1,
    levels: Annotated[int, option("number of levels of the layouts")] = 13,
    name: Annotated[str | None, option("name of the dataset; by default the name of the folder")] = None,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    strict: Strict = False,
) -> None:
    """Build a store from pairs of 8-bit layout and height files, as the paper's authors published them. Four
    quadrants with the same name become one field.

    Example: litho-data import-pairs pairs --out pairs.zarr
    """
    from litho_data.exchange.pairs import import_pairs as build_from_pairs
    from litho_data.making.result import report_folder

    place = folder.resolve()
    target = out or place.parent / f"{place.name}.zarr"
    result = build_from_pairs(
        folder,
        target,
        pitch_um=pitch_um,
        level_height_um=level_height_um,
        levels=levels,
        name=name,
        workers=workers,
        dask=dask,
        strict=strict,
    )
    typer.echo(f"{target}: {result.n_scans} fields, {len(result.skipped)} skipped, {result.seconds:.1f} s")
    typer.echo(f"report {report_folder(target) / 'report.html'}")


def main() -> None:
    """Entry point of ``litho-data``."""
    run_app(app, "litho-data")
