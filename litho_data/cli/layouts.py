"""The commands `masks` and `simulate`: parse arguments, call one function, print where the result is."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from litho_data.commands.app import option
from litho_data.foundation.quantities import LENGTH_UM


def _list_patterns(wanted: bool) -> None:
    if wanted:
        from litho_data.layouts import PATTERNS

        for name, (_, meaning) in PATTERNS.items():
            typer.echo(f"{name:14} {meaning}")
        raise typer.Exit


def _list_knobs(wanted: bool) -> None:
    if wanted:
        from litho_data.virtual_fab import KNOBS

        for knob in KNOBS.values():
            typer.echo(f"{knob.name:26}{f'0 … {knob.limit_with_unit}':16}{knob.meaning} [{knob.effect}]")
        raise typer.Exit


def masks(
    out: Annotated[Path, option("folder to write; an older set with the same settings is replaced")],
    pattern: Annotated[
        str, option("random, or the name of a calibration pattern (see --list-patterns)")
    ] = "random",
    count: Annotated[
        int, option("number of random layouts, or of doses for the pattern dose-matrix", min=1)
    ] = 12,
    size_px: Annotated[int, option("side length of a layout, pixels", min=64)] = 512,
    levels: Annotated[
        int, option("number of levels L; a layout contains the levels 0 to L − 1", min=2, max=65536)
    ] = 13,
    cutoff_per_um: Annotated[
        float, option("cut-off frequency of the low-pass filter that makes random layouts, cycles/µm")
    ] = 0.25,
    passband: Annotated[
        str, option("pass band of the filter: square (as in the published layouts) or round")
    ] = "square",
    quantiser: Annotated[
        str,
        option(
            "rounding to whole levels: round (as in the paper's equation) or floor (as in the published "
            "layouts)"
        ),
    ] = "round",
    field_px: Annotated[
        int | None,
        option("side length of a larger field from whose middle each random layout is cut, pixels"),
    ] = None,
    pitch_um: Annotated[float, option("pixel pitch, µm")] = 0.1,
    level_height_um: Annotated[float, option("nominal height of one level, µm")] = 0.1,
    seed: Annotated[int, option("seed of every random draw", min=0)] = 0,
    list_patterns: Annotated[
        bool,
        typer.Option(
            "--list-patterns", help="list the patterns and stop", callback=_list_patterns, is_eager=True
        ),
    ] = False,
) -> None:
    """Write layouts (TIFF files of level numbers), their statistics, and a dataset card. The scans of the
    prints can be added to the dataset later.

    Example: litho-data masks --count 24 --levels 13 --out prints
    """
    from litho_data.layouts import write_layout_set

    card = write_layout_set(
        out,
        pattern=pattern,
        count=count,
        size_px=size_px,
        levels=levels,
        cutoff_per_um=cutoff_per_um,
        passband=passband,
        pitch_um=pitch_um,
        level_height_um=level_height_um,
        seed=seed,
        quantiser=quantiser,
        field_px=field_px,
    )
    typer.echo(f"card    {card}\nreport  {card.parent / 'report.html'}")


def simulate(
    out: Annotated[
        Path,
        option(
            "folder to write, with raw/ and truth/ in it; an older run with the same settings is replaced"
        ),
    ],
    preset: Annotated[
        str, option("plain, demo, measured-like or second-printer; for printed films: e-beam or projection")
    ] = "plain",
    layouts: Annotated[
        Path | None, option("dataset card whose layouts are printed instead of random ones")
    ] = None,
    plan: Annotated[
        Path | None,
        option("folder of a plan that litho-models next-print wrote, to print and scan it; needs --fab"),
    ] = None,
    fab: Annotated[
        Path | None,
        option(
            "output folder of an earlier run, whose printer and microscope carry out the plan; needs a new "
            "--seed"
        ),
    ] = None,
    count: Annotated[int | None, option("number of scans; by default that of the preset", min=1)] = None,
    size_px: Annotated[
        int | None, option("side length of a layout, pixels; by default that of the preset", min=32)
    ] = None,
    seed: Annotated[int, option("seed of every random draw", min=0)] = 0,
    knob: Annotated[
        list[str] | None,
        option("an effect to simulate, as name=strength or name=strength@seed; repeatable; see --list-knobs"),
    ] = None,
    noise: Annotated[str, option("noise of printer and microscope: default or off")] = "default",
    microscope: Annotated[
        str, option("default (scans are slightly warped) or aligned (scans are not warped)")
    ] = "default",
    write_field_um: Annotated[
        float | None, option("side length of one write field that all fields of a print share, µm")
    ] = None,
    stitch_field_um: Annotated[
        float | None, option("side length of the fields that the effect named stitching displaces, µm")
    ] = None,
    references: Annotated[
        bool,
        option(
            "add scans of a bare substrate, of a flat print and of a print with five steps", "--references"
        ),
    ] = False,
    list_knobs: Annotated[
        bool,
        typer.Option("--list-knobs", help="list the knobs and stop", callback=_list_knobs, is_eager=True),
    ] = False,
) -> None:
    """Simulate printer and microscope: print layouts, scan the prints, and write the files a laboratory would
    deliver.

    Example: litho-data simulate --preset demo --knob laser-drift=0.05 --out fab
    """
    from litho_data.foundation import InputError
    from litho_data.virtual_fab import jobs_of_card, simulate, simulate_plan
    from litho_data.virtual_fab.films import (
        FILM_PRINTERS,
        FilmTruth,
        film_knobs,
        simulate_films,
    )
    from litho_data.virtual_fab.settings import preset as named_preset

    if (plan is None) != (fab is None):
        raise InputError(
            "--plan and --fab",
            got="only one of the two",
            wanted="both: the plan to print, and the earlier run whose printer prints it",
        )
    used = {
        "--preset": preset != "plain",
        "--layouts": layouts is not None,
        "--count": count is not None,
        "--size-px": size_px is not None,
        "--knob": bool(knob),
        "--noise": noise != "default",
        "--microscope": microscope != "default",
        "--write-field-um": write_field_um is not None,
        "--stitch-field-um": stitch_field_um is not None,
        "--references": references,
    }
    options = [name for name, is_used in used.items() if is_used]
    if plan is not None and fab is not None:
        if options:
            wanted = "only --out and --seed, because the plan and the fab set all other options"
            raise InputError("options given with --plan", got=", ".join(options), wanted=wanted)
        card = simulate_plan(plan, fab, out, seed=seed)
        typer.echo(f"card   {card}\ntruth  {card.parent.parent / 'truth' / 'truth.json'}")
        return
    if layouts is not None and (used["--count"] or used["--size-px"] or used["--write-field-um"]):
        wanted = "no --count, --size-px or --write-field-um, because the card's layouts set them"
        raise InputError("options given with --layouts", wanted=wanted)
    if preset in FILM_PRINTERS:
        of_films = ("--preset", "--count", "--size-px", "--knob")
        if unused := [name for name in options if name not in of_films]:
            wanted = "only --out, --seed, --count, --size-px and --knob"
            raise InputError(f"options given with --preset {preset}", got=", ".join(unused), wanted=wanted)
        knobs = film_knobs(knob or ())
        card = simulate_films(out, preset, count=count or 12, size_px=size_px or 256, seed=seed, knobs=knobs)
        typer.echo(f"card   {card}\ntruth  {card.parent.parent / 'truth' / FilmTruth.FILE_NAME}")
        return
    given = {"count": count, "size_px": size_px, "knobs": knob, "noise": noise, "microscope": microscope}
    overruled = {name: value for name, value in given.items() if value not in (None, "default")}
    settings: dict[str, Any] = vars(named_preset(preset)) | overruled
    printer = settings["printer"]
    if stitch_field_um is not None:
        if not printer.pitch_um <= stitch_field_um <= LENGTH_UM.high:
            wanted = f"a length from {printer.pitch_um:g} µm (the pitch) to {LENGTH_UM.high:g} µm"
            raise InputError("--stitch-field-um", got=stitch_field_um, wanted=wanted)
        printer = settings["printer"] = replace(printer, stitch_field_um=stitch_field_um)
    card = simulate(
        out,
        **settings,
        seed=seed,
        write_field_um=write_field_um,
        references=references,
        jobs=jobs_of_card(layouts, printer=printer) if layouts is not None else None,
    )
    typer.echo(f"card   {card}\ntruth  {card.parent.parent / 'truth' / 'truth.json'}")
