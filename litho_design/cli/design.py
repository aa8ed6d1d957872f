"""The design commands and `settings`. Each command parses its options, calls one function and prints the
result.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from litho_data.commands.app import DaskOption, WorkersOption
from litho_data.commands.settings import changed
from litho_data.reports.paper import with_paper_copies
from litho_design.cli.options import (
    BandPx,
    Device,
    Extrapolate,
    Given,
    Out,
    as_toml,
    takes_parts,
    takes_settings,
)
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.images.measurements import MeasuredSource
from litho_design.lenses.settings import LensSettings, lens_settings
from litho_design.optimisation.settings import DesignSettings
from litho_design.reliefs.settings import ReliefSettings, relief_settings

if TYPE_CHECKING:
    from litho_design.judging.gap import GapResult
    from litho_design.tasks.design import Design

S = TypeVar("S", bound=DesignSettings)

# These functions make the default settings. If the changes passed to them contain a variant or a task, it
# overrides the one given here.
_hologram = partial(hologram_settings, "default")
_lens = partial(lens_settings, "direct", "default")

_TARGET_HELP = "an image file, or a drawing: text, ring, chart, spots, letters"
Model = Annotated[str, typer.Option(help="folder of a frozen model, zoo:NAME, or `none` for nominal heights")]
Target = Annotated[str, typer.Option(help=f"target image: {_TARGET_HELP}")]
SpreadOf = Annotated[
    Path | None,
    typer.Option(
        help="dataset store from whose measured prints, except the locked scans, the spread of gain and "
        "offset is computed",
        hidden=True,
    ),
]
Judges = Annotated[
    list[str] | None,
    typer.Option(
        "--judge",
        help="MODEL or NAME=MODEL that judges; repeatable; by default the zoo's models of this printer",
    ),
]
Robust = Annotated[
    bool,
    typer.Option(help="search for the lowest loss over the model and all judges"),
]
Objects = Annotated[
    list[Path] | None,
    typer.Option(
        help="computational lens: image or folder of images to use instead of the drawings; repeatable"
    ),
]
HeldOutObjects = Annotated[
    list[Path] | None,
    typer.Option(
        help="computational lens: image, or folder of images, used only for scores; repeatable. The default "
        "is the last quarter of --objects, sorted by name, but at least two images",
        hidden=True,
    ),
]


def first(
    out: Annotated[Path, typer.Option(help="folder of the result")] = Path("first"),
    target: Target = "text",
    device: Device = "cpu",
) -> None:
    """Design a small hologram with and without a printer model, and show both prints (takes about a minute).

    Example: litho-design first --target ring
    """
    from litho_design.workflows.first import first as make_first

    _print_comparison(make_first(out, target=target, device=device), out)


@takes_settings(HologramSettings())
def hoe(
    model: Model,
    out: Out,
    given: Given,
    target: Target = "text",
    spread_of: SpreadOf = None,
    judge: Judges = None,
    robust: Robust = False,
    large: Annotated[
        bool,
        typer.Option(
            "--large",
            help="work in bands of rows, for elements too large for the memory of one process; `torchrun "
            "--no-python` shares the bands among processes",
            hidden=True,
        ),
    ] = False,
    band_px: BandPx = 512,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design a holographic element; an interrupted run in OUT resumes.

    Example: litho-design hoe --model zoo:pbl --target photo.png --size-px 512 --out hologram
    """
    settings = _settings(given, _hologram, "hoe", spread_of)
    from litho_design.optimisation.ranks import Ranks
    from litho_design.workflows.design import design_hologram

    design = design_hologram(
        target, model, out, settings=settings, judges=judge, robust=robust,
        band_px=band_px if large else None, device=device, extrapolate=extrapolate,
    )  # fmt: skip
    if not large or Ranks.joined().rank == 0:
        _print_design(design, out)


@takes_settings(ReliefSettings())
@takes_parts(scan=MeasuredSource)
def correct(
    relief: Annotated[
        str,
        typer.Argument(
            help="greyscale image, float TIFF of heights in µm, or a drawing: lens, blaze, staircase"
        ),
    ],
    model: Model,
    out: Out,
    given: Given,
    scan: MeasuredSource | None,
    after: Annotated[
        Path | None,
        typer.Option(
            help="folder of a printed and measured correction; its error is subtracted from the target"
        ),
    ] = None,
    spread_of: SpreadOf = None,
    judge: Judges = None,
    robust: Robust = True,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Find the layout whose print comes closest to a target relief.

    Example: litho-design correct blaze --model zoo:pbl --out blaze
    """
    settings = _settings(given, relief_settings, "correct", spread_of)
    from litho_design.workflows.design import correct as correct_relief

    design = correct_relief(
        relief, model, out, settings=settings, after=after, scan=scan,
        judges=judge, robust=robust, device=device, extrapolate=extrapolate,
    )  # fmt: skip
    _print_design(design, out)


@takes_settings(LensSettings())
def lens(
    model: Model,
    out: Out,
    given: Given,
    objects: Objects = None,
    held_out_objects: HeldOutObjects = None,
    spread_of: SpreadOf = None,
    judge: Judges = None,
    robust: Robust = False,
    large: Annotated[
        bool, typer.Option("--large", help="design ring by ring, for a focusing lens of any size")
    ] = False,
    band_px: BandPx = 512,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design a multi-level diffractive lens; an interrupted run in OUT resumes.

    Example: litho-design lens --model zoo:pbl --distance-um 200 --out lens
    """
    settings = _settings(given, _lens, "lens", spread_of)
    from litho_design.workflows.design import design_lens

    design = design_lens(
        model, out, settings=settings, objects=objects or (), held_out_objects=held_out_objects or (),
        judges=judge, robust=robust, tile_px=band_px if large else None,
        device=device, extrapolate=extrapolate,
    )  # fmt: skip
    _print_design(design, out)


@takes_settings(HologramSettings(), LensSettings(), leave_out=("task", "search.seed", "ensemble.weight"))
@with_paper_copies
def compare(
    models: Annotated[
        str,
        typer.Option(
            help="models to design with, separated by commas: none, MODEL (folder or zoo:NAME) or NAME=MODEL"
        ),
    ],
    out: Out,
    given: Given,
    judge: Annotated[
        list[str] | None,
        typer.Option(
            help="model that only judges: NAME=MODEL or MODEL, or truth/ of a virtual fab; repeatable"
        ),
    ] = None,
    task: Annotated[
        Literal["hoe", "lens-direct", "lens-computational"], typer.Option(help="what to design")
    ] = "hoe",
    target: Annotated[str, typer.Option(help=f"for hoe: {_TARGET_HELP}")] = "text",
    objects: Objects = None,
    held_out_objects: HeldOutObjects = None,
    spread_of: SpreadOf = None,
    seeds: Annotated[int, typer.Option(help="number of seeds (0, 1, 2 …)")] = 3,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    device: Device = "cpu",
    extrapolate: Extrapolate = False,
) -> None:
    """Design with every model (arm), and compare how every judge predicts the prints of these designs.

    Example: litho-design compare --models none,zoo:pbl --out gap
    """
    settings: Any
    if task == "hoe":
        settings = _settings(given, _hologram, task, spread_of)
    else:
        kind = {"task": task.removeprefix("lens-")}
        settings = _settings(given, lambda changes: _lens({**changes, **kind}), task, spread_of)
    from litho_design.workflows.compare import compare as run_comparison

    result = run_comparison(
        settings, models.split(","), out, judges=judge or (), target=target, objects=objects or (),
        held_out_objects=held_out_objects or (), seeds=range(seeds), device=device,
        extrapolate=extrapolate, workers=workers, dask=dask,
    )  # fmt: skip
    _print_comparison(result, out)


@takes_settings(HologramSettings(), LensSettings(), ReliefSettings())
def settings(
    element: Annotated[Literal["hoe", "lens", "relief"], typer.Argument(help="kind of element")],
    given: Given,
) -> None:
    """Print all settings with their meanings as a file for --config, without designing anything.

    Example: litho-design settings hoe > hoe.toml
    """
    makes: dict[str, Callable[[Mapping[str, Any]], DesignSettings]]
    makes = {"hoe": _hologram, "lens": _lens, "relief": relief_settings}
    print(as_toml(_settings(given, makes[element], element)), end="")


def _settings(
    given: Given,
    make: Callable[[Mapping[str, Any]], S],
    task: str,
    spread_of: Path | None = None,
) -> S:
    """Merge the preset, the settings file, the measured spreads and the command line. Each of these sources
    overrides the sources before it.
    """
    made = make(given.over(make({}), task))
    if spread_of is None:
        return made
    from litho_data.store import open_store
    from litho_design.optimisation.process_window import measured_window

    window = measured_window(open_store(spread_of), made.window)
    return changed(made.model_copy(update={"window": window}), given.options)


def _print_comparison(result: GapResult, out: Path) -> None:
    from litho_design.reports.advice import called, named
    from litho_design.tasks.task import registered_task

    figure = registered_task(result.task).headline[0]
    for judge in result.judges:
        found = [item for item in result.summary if (item.judge, item.figure) == (judge, figure)]
        told = ", ".join(f"{item.judged_mean:.3f} if designed with {called(item.arm)}" for item in found)
        print(f"{named(figure)} as printed by {called(judge)}: {told}")
    print(out / "report.html")


def _print_design(design: Design, out: Path) -> None:
    from litho_design.reports.advice import (
        baseline_line,
        distribution_warning,
        headline,
        stroke_advice,
        thickness_warning,
        width_sentence,
    )

    for warning in filter(None, (distribution_warning(design), thickness_warning(design))):
        print(warning, file=sys.stderr)
    print(stroke_advice(design))
    if said := width_sentence(design):
        print(said)
    if design.baselines:
        print(baseline_line(design.baselines))
    page = out / "report.html"
    told = f"{headline(design.predicted)} (predicted by the model of the design)"
    print(f"{page if page.exists() else out}: {told}")
