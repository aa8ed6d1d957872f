"""Design an element with a frozen model of the printer, and write the result into a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict, TypeVar, Unpack

import numpy as np

from litho_data.foundation.errors import InputError
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.holograms.task import HologramTask
from litho_design.images.measurements import MeasuredSource
from litho_design.images.targets import Target, load_target
from litho_design.judging.loaded import load_design
from litho_design.judging.measured import measured_print
from litho_design.large.bands import Bands
from litho_design.large.hologram import HOLOGRAM, SEARCH, BandedHologram, only
from litho_design.large.lens import RingLens
from litho_design.lenses.objects import with_objects
from litho_design.lenses.settings import LensSettings, lens_settings
from litho_design.lenses.task import lens_task
from litho_design.optimisation.ranks import Ranks
from litho_design.optimisation.settings import DesignSettings
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer
from litho_design.printers.source import Device, load_printer, load_printers, models_at_hand
from litho_design.reliefs.settings import ReliefSettings, relief_settings
from litho_design.reliefs.targets import load_relief
from litho_design.reliefs.task import ReliefTask
from litho_design.reports.design import write_design_report
from litho_design.tasks.design import Design
from litho_design.tasks.run import run_design
from litho_design.tasks.task import Task, registered_task

S = TypeVar("S", bound=DesignSettings)


class How(TypedDict, total=False):
    """Arguments that all design functions share.

    Attributes:
        judges: models (MODEL or NAME=MODEL) that predict the print of the finished layout. The range of the
            scores that the model of the design and the judges predict is called the width of the design. By
            default, the judges are the zoo's models that were trained on the same prints as the model of the
            design.
        robust: in the search, also use the judges that provide gradients. ``Task.over_models`` then combines
            the losses computed with the individual models, and a penalty on the disagreement of the models is
            added.
        device: torch device on which prints and waves are computed.
        extrapolate: accept heights beyond the range for which a model was calibrated; the result records this
            choice.
        announce: print the expected time and memory to stderr before starting (the default).
    """

    judges: Iterable[str | Printer] | None
    robust: bool
    device: Device
    extrapolate: bool
    announce: bool


def design_hologram(
    target: str | Path | np.ndarray | Target,
    model: str | Path | Printer,
    out: str | Path,
    *,
    settings: HologramSettings | None = None,
    band_px: int | None = None,
    **how: Unpack[How],
) -> Design:
    """Optimise the layout of a hologram so that its print shows the target image.

    Args:
        target: name of a drawing, path of an image file, or an array of shape (size_px, size_px) with values
            in [0, 1] (see ``load_target``).
        model: folder of a frozen model, ``zoo:NAME``, ``none`` for nominal heights, or a loaded printer.
        out: folder of the design; an interrupted run in it resumes.
        settings: geometry, optics, search and loss; ``hologram_settings()`` by default.
        band_px: if given, the element is designed in bands of at most this many rows, because it is too large
            for the memory of one process. Processes started by torchrun share the bands; with ``cuda``, each
            process uses its own GPU. The model must have a finite reach (distance up to which a level affects
            the print), and there are no judges.
        how: judges, robust, device, extrapolate, announce (see ``How``).

    Returns:
        The record written to ``out/design.json``.

    Raises:
        InputError: the target does not have the size of the layout or lacks dark or bright pixels, the model
            does not fit the layout, or the folder holds another result.
    """
    made = _of_kind(settings or hologram_settings(), HologramSettings)
    if band_px is not None:
        only(made, SEARCH | HOLOGRAM)
        ranks = Ranks.joined()
        bands = Bands(made.layout.size_px, band_px, ranks, made.layout.cell_px)
        how = _alone(how) | {"device": ranks.device(how.get("device", "cpu"))}

    def task(printer: Printer, others: list[Printer]) -> Task:
        wanted = load_target(target, made.layout.size_px)
        given: Any = {"inputs": {"target": wanted.pixels}, "record": wanted.record}
        if band_px is not None:
            return BandedHologram(made, printer, bands, **given)
        return HologramTask(made, printer, ensemble=others, **given)

    return _designed(task, made.layout, model, out, **how)


def design_lens(
    model: str | Path | Printer,
    out: str | Path,
    *,
    settings: LensSettings | None = None,
    objects: Sequence[str | Path] = (),
    held_out_objects: Sequence[str | Path] = (),
    tile_px: int | None = None,
    **how: Unpack[How],
) -> Design:
    """Optimise the layout of a lens so that its print focuses light (direct task), or so that objects can be
    reconstructed from the images behind it (computational task).

    Args:
        model: as for ``design_hologram``.
        out: folder of the design; an interrupted run in it resumes.
        settings: geometry, optics, task and search; ``lens_settings()`` by default.
        objects: pictures, or folders of pictures, that a computational lens images instead of the built-in
            drawings.
        held_out_objects: pictures, or folders of pictures, that are used only for the scores and not in the
            search (see ``with_objects``).
        tile_px: if given, a focusing lens is designed ring by ring, and the whole plane is never computed.
            The print of a strip along one radius is predicted in tiles of this many pixels. The lens may then
            be 10 mm wide or more. The model must have a finite reach.
        how: see ``How``.

    Returns:
        The record written to ``out/design.json``.

    Raises:
        InputError: the model or the folder is rejected for the reasons that ``design_hologram`` lists; the
            search is radial, but the layout has no rings or the aperture is square; or the objects are not
            pictures.
    """
    made = _of_kind(settings or lens_settings(), LensSettings)
    if tile_px is not None:
        only(made, SEARCH)
        how = _alone(how, *objects, *held_out_objects)

    def task(printer: Printer, others: list[Printer]) -> Task:
        if tile_px is not None:
            return RingLens(made, printer, tile_px)
        imaging, inputs = with_objects(made, objects, held_out_objects)
        return lens_task(imaging, printer, inputs=inputs, ensemble=others)

    return _designed(task, made.layout, model, out, **how)


def correct(
    relief: str | Path | np.ndarray,
    model: str | Path | Printer,
    out: str | Path,
    *,
    settings: ReliefSettings | None = None,
    after: str | Path | None = None,
    scan: MeasuredSource | None = None,
    **how: Unpack[How],
) -> Design:
    """Find the layout whose print comes closest to a target height map.

    Args:
        relief: a drawing (``lens``, ``blaze`` or ``staircase``), a greyscale image, a float TIFF of heights
            in µm, or an array of heights in µm of shape (size_px, size_px) (see ``load_relief``).
        model, out: as for ``design_hologram``.
        settings: layout, height, search and process window; ``relief_settings()`` by default.
        after: folder of an earlier result of ``correct``, whose layout was printed and measured.
        scan: measurement of the print of that layout. The next print is expected to deviate from the
            prediction of each model in the same way as this print did.
        how: see ``How``; ``robust`` is True by default.

    Returns:
        The record written to ``out/design.json``. The file ``unprintable_um.npy`` contains the part of the
        relief that no layout can print.

    Raises:
        InputError: ``load_relief`` rejects the relief; the model or the folder is rejected for the reasons
            that ``design_hologram`` lists; only one of ``after`` and ``scan`` is given; the size, pitch or
            levels of the design in ``after`` differ from those in ``settings``; or the scan shows another
            element.
    """
    made = _of_kind(settings or relief_settings(), ReliefSettings)

    def task(printer: Printer, others: list[Printer]) -> Task:
        heights, record = load_relief(relief, made.layout, made.height_um)
        inputs = {"relief_um": heights} | _first_print(made, after, scan)
        return ReliefTask(made, printer, inputs=inputs, ensemble=others, record=record)

    robustly: How = {"robust": True, **how}
    return _designed(task, made.layout, model, out, **robustly)


def _first_print(
    settings: ReliefSettings, after: str | Path | None, scan: MeasuredSource | None
) -> dict[str, np.ndarray]:
    """Return the layout and the measured print of a first element, as inputs for the design of the second
    element.

    The result is empty if there is no first element.
    """
    if after is None and scan is None:
        return {}
    if after is None or scan is None:
        given = "a first element without a scan" if scan is None else "a scan without its element"
        raise InputError("second round", got=given, wanted="both --after and --scan")
    first = load_design(after)
    if first.record.layout != settings.layout:
        raise InputError(
            f"design {after}", got="another layout", wanted="a design with the same size, pitch and levels"
        )
    printed_um, *_ = measured_print(first, scan)
    return {"first_level": first.level.numpy(), "first_print_um": printed_um.numpy()}


def design(
    task: type[Task],
    model: str | Path | Printer,
    out: str | Path,
    *,
    settings: DesignSettings | None = None,
    inputs: Mapping[str, np.ndarray] | None = None,
    **how: Unpack[How],
) -> Design:
    """Optimise the layout for a user-defined task (see ``Task``).

    Args:
        task: a class registered by ``register_task``.
        model: as for ``design_hologram``.
        out: folder of the design; an interrupted run in it resumes.
        settings: geometry, optics, search and process window; ``design_settings()`` by default.
        inputs: mapping from names to the arrays that the task needs.
        how: see ``How``.

    Returns:
        The record written to ``out/design.json``.

    Raises:
        InputError: the task is not registered, or the model or the folder is rejected for the reasons that
            ``design_hologram`` lists.
    """
    if isinstance(task, str):
        hint = "for holograms, lenses and reliefs, use design_hologram, design_lens and correct"
        raise InputError("task", got=repr(task), wanted="a class derived from Task", hint=hint)
    registered_task(task.name)
    made = settings or DesignSettings()

    def of_task(printer: Printer, others: list[Printer]) -> Task:
        return task(made, printer, inputs=inputs, ensemble=others)

    return _designed(of_task, made.layout, model, out, **how)


def _designed(
    make: Callable[[Printer, list[Printer]], Task],
    layout: LayoutSettings,
    model: str | Path | Printer,
    out: str | Path,
    *,
    judges: Iterable[str | Printer] | None = None,
    robust: bool = False,
    device: Device = "cpu",
    extrapolate: bool = False,
    announce: bool = True,
) -> Design:
    """Run the design of the task that ``make`` returns. The printers are checked first. Only then is ``make``
    called, which reads the target.
    """
    fit: Any = {"device": device, "extrapolate": extrapolate}
    printer = load_printer(model, layout, **fit)
    if judges is None:
        rivals = models_at_hand([printer.record()], layout, device=device)
    else:
        rivals = list(load_printers(judges, layout, **fit).values())
    in_search = [one for one in rivals if robust and not one.only_judges]
    task = make(printer, in_search)
    task.judges = [one for one in rivals if one not in in_search]
    return run_design(task, out, write_design_report, announce=announce)


def _alone(how: How, *objects: Any) -> How:
    """Check that neither objects nor judges nor a robust search are requested. A large element supports none
    of them. Return the arguments with an empty list of judges.
    """
    if how.get("robust") or objects or how.get("judges"):
        got = "objects, judges or a robust search"
        raise InputError("large element", got=got, wanted="one model, without objects or judges")
    return {**how, "judges": ()}


def _of_kind(settings: S, kind: type[S]) -> S:
    if not isinstance(settings, kind):
        raise InputError("settings", got=type(settings).__name__, wanted=kind.__name__)
    return settings
