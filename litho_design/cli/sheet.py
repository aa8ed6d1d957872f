"""The commands `litho-design sheet new`, which makes one sheet of prints for a lab, and `sheet read`, which
evaluates its scans.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from litho_data.commands.app import App
from litho_design.cli.design import Target
from litho_design.cli.options import Device, Out
from litho_design.exports.job import Format

sheet = App(help="Make one sheet of prints for a lab, and evaluate its scans.", no_args_is_help=True)


@sheet.command("new")
def new(
    out: Out,
    model: Annotated[
        str, typer.Option(help="frozen model, a folder or zoo:NAME, through which one hologram is designed")
    ] = "zoo:pbl",
    format: Annotated[
        Format, typer.Option(help="format of the files for the printer, see docs/export.md")
    ] = "stl",
    target: Target = "text",
    layouts: Annotated[
        int, typer.Option(min=6, help="number of random layouts whose prints the printer model is fitted to")
    ] = 12,
    seed: Annotated[int, typer.Option(min=0, help="seed of the random layouts")] = 0,
    device: Device = "cpu",
) -> None:
    """Write the files that a lab needs to print and scan one sheet; an interrupted run in OUT resumes.

    Example: litho-design sheet new --format gwl --out sheet
    """
    from litho_design.sheets.new import PAGE, new_sheet

    made = new_sheet(
        out, model=model, format=format, target=target, layouts=layouts, seed=seed, device=device
    )
    typer.echo(f"{len(made.fields)} fields of {made.side_um:g} µm; instructions: {out / PAGE}")


@sheet.command("read")
def read(
    folder: Annotated[
        Path, typer.Argument(help="folder written by `sheet new`, with the scans in it", metavar="SHEET")
    ],
    out: Out,
    device: Device = "cpu",
) -> None:
    """Fit a printer model to the scans of a sheet, find what the model lacks, and compare the sheet's two
    holograms.

    Example: litho-design sheet read sheet --out answer
    """
    from litho_design.sheets.read import read_sheet, sheet_text

    typer.echo(sheet_text(read_sheet(folder, out, device=device)))
    typer.echo(f"model and card: {out / 'printer'}; report: {out / 'report.html'}")
