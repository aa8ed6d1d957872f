"""The commands ``litho-data level`` and ``inspect``: work on one scan in any supported format."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from litho_data.commands.app import argument, keyword, option, takes_more
from litho_data.foundation import YX, Facts, InputError
from litho_data.readers.registry import formats
from litho_data.readers.text_blocks import NUMBER, number

if TYPE_CHECKING:
    from litho_data.readers.reader import Channel
    from litho_data.scan import Scan


ScanPath = Annotated[Path, argument("a scan in any supported format")]
_READING: dict[str, Any] = {
    "format": Annotated[
        str, option(f"format: auto (recognised by the file's content), {', '.join(formats())}")
    ],
    "unit": Annotated[str | None, option("unit of the heights if the file states none, e.g. m or nm")],
    "size_um": Annotated[
        YX | None,
        typer.Option(
            "--size-um", metavar="Y X", help="size of the field along y and x in µm if the file states none"
        ),
    ],
    "channel": Annotated[str | None, option("name of the height channel, if there are several")],
    "full_scale_um": Annotated[
        float | None,
        option(
            "height in µm that the largest possible value of an integer image stands for", "--full-scale-um"
        ),
    ],
    "missing": Annotated[
        list[str] | None,
        option("number or word that marks pixels without a measurement, e.g. -9999; repeatable"),
    ],
}


def reads_scans(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options for reading a scan to a command. The command receives these options as its argument
    ``how``, and passes them to ``read_scan``.
    """

    @functools.wraps(command)
    def run(**values: Any) -> None:
        how = {name: values.pop(name) for name in _READING}
        if marks := how["missing"]:
            how["missing"] = [number(one) if NUMBER.fullmatch(one) else one for one in marks]
        command(how=how, **values)

    more = [keyword(name, kind, "auto" if name == "format" else None) for name, kind in _READING.items()]
    return takes_more(run, command, more, without="how")


@reads_scans
def level(
    scan: ScanPath,
    recipe: Annotated[Path, option("levelling recipe (TOML)")],
    out: Annotated[Path, option("file to write: .gsf (opens in Gwyddion) or .npy (µm)")],
    how: Facts,
) -> None:
    """Level one scan. Write the levelled heights, and beside them the surface that levelling removed and a
    record of the levelling.

    Example: litho-data level P11.gwy --recipe recipe.toml --out P11.gsf
    """
    from litho_data.level import Recipe
    from litho_data.level.scan import write_levelled
    from litho_data.readers import read_scan

    steps = Recipe.from_toml(recipe)
    heights = read_scan(scan, **how)
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: typer.echo(f"warning: {message}", err=True)
        record = write_levelled(heights, steps, out)
    typer.echo(f"{out}: {len(steps.step)} steps")
    typer.echo(f"levelled sha256 {record.levelled_sha256}")
    typer.echo(f"removed surface {out.with_name(record.removed)}")


@reads_scans
def inspect(
    file: ScanPath,
    how: Facts,
    picture: Annotated[Path | None, option("PNG file to write, with a picture of the heights")] = None,
    header: Annotated[bool, option("print the full header of the file", "--header")] = False,
) -> None:
    """List the channels of a file with their sizes, units and pitches, and print the range of the heights.

    A picture shows one height channel. If there are several, choose one with --channel. If the file states no
    unit, give --unit or --full-scale-um.

    Example: litho-data inspect P11.gwy --picture P11.png
    """
    from litho_data.readers import list_channels, read_scan

    channels = list_channels(file, format=how["format"])
    _print_channels(file, channels)
    if header:
        for listed in channels:
            for key, value in listed.header.items():
                typer.echo(f"{listed.name}: {key} = {value}")
    try:
        scan = read_scan(file, **how)
    except InputError as error:
        # Without a picture or reading options, the user wants only the list of channels.
        if picture is not None or any(value for name, value in how.items() if name != "format"):
            raise
        typer.echo(f"heights not shown: {error}")
        return
    _print_scan(scan, picture)


def _print_channels(file: Path, channels: list[Channel]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=str(file))
    for column in ("channel", "pixels (y × x)", "unit", "size (µm)", "pitch (µm)", "along x", "heights"):
        table.add_column(column)
    for channel in channels:
        ny, nx = channel.shape
        size = channel.size_um if not channel.problem else None
        table.add_row(
            channel.name,
            f"{ny} × {nx}",
            channel.unit or "not stated",
            f"{size[0]:.6g} × {size[1]:.6g}" if size else "not stated",
            f"{size[0] / ny:.6g} × {size[1] / nx:.6g}" if size else "not stated",
            channel.x_is,
            f"not read: {channel.problem}" if channel.problem else "yes" if channel.is_height else "no",
        )
    Console().print(table)


def _print_scan(scan: Scan, picture: Path | None) -> None:
    import numpy as np

    from litho_data.cli.scan_picture import write_picture

    pitch = f"{scan.pitch_um[0]:.6g} × {scan.pitch_um[1]:.6g} µm" if scan.pitch_um else "unknown"
    low, high = np.nanmin(scan.height_um), np.nanmax(scan.height_um)
    missing = int(np.isnan(scan.height_um).sum())
    typer.echo(f"read as {scan.format}, channel {scan.channel!r}, unit {scan.unit}, pitch {pitch}")
    typer.echo(f"heights {low:.6g} to {high:.6g} µm, {missing} pixels missing")
    for note in scan.notes:
        typer.echo(f"note: {note}")
    if scan.mask is not None:
        typer.echo(f"mask covers {scan.mask.mean():.1%} of the pixels")
    if picture is not None:
        typer.echo(f"picture {write_picture(scan, picture)}")
