"""``litho-data level`` and ``litho-data inspect``: one scan, any supported format."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from litho_data.commands.app import argument, option
from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import YX
from litho_data.readers.registry import formats
from litho_data.readers.text_blocks import NUMBER, number

if TYPE_CHECKING:
    from litho_data.readers.reader import Channel
    from litho_data.scan import Scan


ScanPath = Annotated[Path, argument("a scan in any supported format")]
Format = Annotated[str, option(f"auto (by the content of the file), {', '.join(formats())}")]
Unit = Annotated[str | None, option("unit of the heights if the file states none, e.g. m, nm")]
Size = Annotated[
    YX | None,
    typer.Option("--size-um", metavar="Y X", help="field size in µm (y, x) if the file states none"),
]
ChannelName = Annotated[str | None, option("name of the height channel, if there are several")]
Missing = Annotated[
    list[str] | None,
    option("number or word that marks pixels which were not measured, e.g. -9999; repeatable"),
]
FullScale = Annotated[
    float | None,
    option("height in µm of the largest value of an integer image", "--full-scale-um"),
]


def marks(texts: list[str] | None) -> list[float | str] | None:
    """Numbers and words as ``read_scan`` takes them."""
    return None if texts is None else [number(one) if NUMBER.fullmatch(one) else one for one in texts]


def level(
    scan: ScanPath,
    recipe: Annotated[Path, option("levelling recipe (TOML)")],
    out: Annotated[Path, option("file to write: .gsf (opens in Gwyddion) or .npy (µm)")],
    format: Format = "auto",
    unit: Unit = None,
    size_um: Size = None,
    channel: ChannelName = None,
    full_scale_um: FullScale = None,
    missing: Missing = None,
) -> None:
    """Level one scan; writes the levelled heights, the removed surface and a record beside them.

    Example: litho-data level P11.gwy --recipe recipe.toml --out P11.gsf
    """
    from litho_data.level import Recipe
    from litho_data.level.scan import write_levelled
    from litho_data.readers import read_scan

    steps = Recipe.from_toml(recipe)
    heights = read_scan(
        scan,
        format=format,
        unit=unit,
        size_um=size_um,
        channel=channel,
        full_scale_um=full_scale_um,
        missing=marks(missing),
    )
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: typer.echo(f"warning: {message}", err=True)
        record = write_levelled(heights, steps, out)
    typer.echo(f"{out}: {len(steps.step)} steps")
    typer.echo(f"levelled sha256 {record.levelled_sha256}")
    typer.echo(f"removed surface {out.with_name(record.removed)}")


def inspect(
    file: ScanPath,
    format: Format = "auto",
    unit: Unit = None,
    size_um: Size = None,
    channel: ChannelName = None,
    full_scale_um: FullScale = None,
    missing: Missing = None,
    picture: Annotated[Path | None, option("PNG to write")] = None,
    header: Annotated[bool, option("print the full header of the file", "--header")] = False,
) -> None:
    """List the channels of a file with sizes, units and pitch, and show the heights.

    A picture needs one height channel: choose it with --channel if there are several, and give --unit
    (or --full-scale-um) if the file states none.

    Example: litho-data inspect P11.gwy --picture P11.png
    """
    from litho_data.readers import list_channels, read_scan

    channels = list_channels(file, format=format)
    _print_channels(file, channels)
    if header:
        for listed in channels:
            for key, value in listed.header.items():
                typer.echo(f"{listed.name}: {key} = {value}")
    try:
        scan = read_scan(
            file,
            format=format,
            unit=unit,
            size_um=size_um,
            channel=channel,
            full_scale_um=full_scale_um,
            missing=marks(missing),
        )
    except InputError as error:
        # If no picture was asked for, the list of channels is enough.
        if picture is not None or unit or size_um or channel or full_scale_um or missing:
            raise
        typer.echo(f"no picture: {error}")
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
