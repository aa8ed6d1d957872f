"""The command ``litho-data tip``: estimate the tip of the microscope from its scans."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from litho_data.cli.scan import reads_scans
from litho_data.commands.app import argument, option
from litho_data.foundation import Facts, InputError

if TYPE_CHECKING:
    from litho_data.tip import TipEstimate


@reads_scans
def tip(
    scans: Annotated[list[Path], argument("one scan, or all scans made with one tip at the same pitch")],
    how: Facts,
    json: Annotated[bool, option("print the whole result as JSON", "--json")] = False,
    maps: Annotated[
        Path | None,
        option(
            "folder for NAME.certain.npy (true where the tip certainly touched the surface) and "
            "NAME.surface.gsf"
        ),
    ] = None,
) -> None:
    """Estimate the radius of the microscope's tip, or an upper limit on the radius. Find the pixels of each
    scan that the tip may not have touched.

    The surface in --maps is the highest surface from which this tip would produce the scan.

    Example: litho-data tip P11.gwy P12.gwy --maps maps
    """
    from litho_data.readers import read_scan
    from litho_data.tip import estimate_tip

    read = [read_scan(file, **how) for file in scans]
    found = estimate_tip(read)
    typer.echo(found.model_dump_json(by_alias=True, indent=1) if json else _text(found))
    if maps is None:
        return
    if found.radius_um is None:
        raise InputError(
            "--maps",
            got=found.reason,
            wanted="scans from which the radius, or an upper limit on it, can be estimated",
        )
    import numpy as np

    from litho_data.foundation.files import atomic_file
    from litho_data.level.scan import write_heights
    from litho_data.tip import reconstructed, tip_certain

    if len({scan.name for scan in read}) < len(read):
        raise InputError(
            "--maps",
            got="scans with the same name",
            wanted="different names, because the maps are named after the scans",
        )
    maps.mkdir(parents=True, exist_ok=True)
    for scan in read:
        height, pitch = scan.height_um, scan.require_pitch()
        with atomic_file(maps / f"{scan.name}.certain.npy") as temporary, open(temporary, "wb") as stream:
            np.save(stream, tip_certain(height, pitch, found.radius_um))
        surface = reconstructed(height, pitch, found.radius_um)
        write_heights(
            maps / f"{scan.name}.surface.gsf", surface, pitch_um=pitch, title=f"{scan.name} surface"
        )
    typer.echo(f"maps of {len(read)} scans in {maps}", err=json)


def _text(found: TipEstimate) -> str:
    if found.radius_um is None:
        return f"radius of the tip: no limit found, {found.reason}"
    value = f"{found.radius_um:.3g}"
    if found.kind == "estimate":
        lines = [f"radius {value} ± {found.radius_sd_um:.2g} µm (standard uncertainty)"]
    else:
        lines = [f"radius at most {value} µm: {found.reason}"]
    lines += [
        f"heights span {found.depth_um:.3g} µm, noise {found.pixel_noise_nm:.2g} nm per pixel and "
        f"{found.line_noise_nm:.2g} nm per line",
    ]
    for scan in found.scans:
        limit = (
            f"details below {scan.resolution_um:.3g} µm may come from the tip"
            if scan.resolution_um
            else "the tip does not limit the details"
        )
        lines.append(
            f"{scan.name}: {scan.certain_fraction:.1%} of the pixels were certainly touched; {limit}"
        )
    return "\n".join(lines)
