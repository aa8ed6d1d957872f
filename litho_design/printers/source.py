"""Load printers: frozen models from folders or the zoo, virtual fabs, and nominal heights."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from litho_data.foundation.errors import InputError
from litho_data.foundation.names import require_plain_name
from litho_design.printers.fab import is_fab, load_fab
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer, PrinterRecord

Device = str | torch.device
# The models of the zoo (the models shipped with the package) that judge designs, one of each kind. Ridge
# regressions are left out, because they extrapolate badly from the smooth training layouts to other layouts.
JUDGES = ("physics", "pbl", "fno")


def load_printer(
    source: str | Path | Printer,
    layout: LayoutSettings,
    *,
    name: str = "",
    device: Device = "cpu",
    extrapolate: bool = False,
) -> Printer:
    """Load the printer for ``source``: a folder of a frozen model, ``zoo:NAME``, or ``none`` for nominal
    heights.

    ``source`` may also be the folder ``truth`` of a virtual fab. The fab can judge layouts, but a search
    cannot use it. ``name`` is the name of the printer in results; by default, it is the name of the model. A
    loaded printer is returned unchanged.

    Raises:
        InputError: ``source`` does not name a frozen model, the pitch of the model differs from that of the
            layout, the model was not calibrated for the heights of the levels, or this machine does not have
            the device.
    """
    if isinstance(source, Printer):
        return source
    check_device(device)
    source = str(source)
    if source == "none":
        return Printer(None, layout, source=source, name=name).to(device)
    if is_fab(source):
        return Printer(load_fab(source, layout), layout, source=source, name=name).to(device)
    from litho_models import load_frozen, zoo

    folder = zoo.model_folder(source, other=["none"])
    simulator = load_frozen(folder, device=device, extrapolate=extrapolate)
    _check_calibration(simulator.card, layout, extrapolate)
    return Printer(simulator, layout, source=source, name=name, extrapolate=extrapolate).to(device)


def load_printers(
    sources: Mapping[str, str | Path | Printer] | Iterable[str | Printer],
    layout: LayoutSettings,
    *,
    device: Device = "cpu",
    extrapolate: bool = False,
) -> dict[str, Printer]:
    """Load several printers, and return a dict from name to printer.

    ``sources`` is a mapping from names to models, or a list whose items are NAME=MODEL, MODEL, ``none`` or
    loaded printers.

    Raises:
        InputError: the name of a printer is not plain (see ``require_plain_name``), two printers have the
            same name, or ``load_printer`` rejects a printer.
    """
    fit: Any = {"device": device, "extrapolate": extrapolate}
    if isinstance(sources, Mapping):
        return {
            require_plain_name("name of a model", name): load_printer(source, layout, name=name, **fit)
            for name, source in sources.items()
        }
    printers: dict[str, Printer] = {}
    for item in sources:
        source, name = item, ""
        if isinstance(item, str):
            first, _, rest = item.strip().partition("=")
            source, name = (rest, first) if rest else (first, "")
            if not first:
                raise InputError("models", got=f"{item!r}", wanted="none, MODEL or NAME=MODEL")
        printer = load_printer(source, layout, name=name, **fit)
        if printer.name in printers:
            raise InputError(
                "models",
                got=f"{printer.name!r} twice",
                wanted="a different name for each",
                hint="use NAME=MODEL",
            )
        printers[require_plain_name("name of a model", printer.name)] = printer
    return printers


def models_at_hand(
    known: Sequence[PrinterRecord], layout: LayoutSettings, *, device: Device = "cpu"
) -> list[Printer]:
    """Of the zoo's models that ``JUDGES`` names, load those that were trained on the same prints as the first
    of the ``known`` models.

    The ``known`` models themselves are left out, and so are models that were not calibrated for the layout.
    """
    from litho_models import zoo

    dataset, weights = known[0].dataset_sha256, {one.sha256 for one in known}
    found = []
    for name in JUDGES if dataset else ():
        # Models are selected by their cards, so that the models of other printers need not be loaded.
        card = zoo.card(name)
        if (card.get("dataset") or {}).get("sha256") != dataset:
            continue
        try:
            _check_calibration(card, layout, extrapolate=False)
        except InputError:
            continue
        printer = load_printer(f"{zoo.PREFIX}{name}", layout, device=device)
        if printer.weights_sha256() not in weights:
            found.append(printer)
    return found


def _check_calibration(card: Mapping[str, Any], layout: LayoutSettings, extrapolate: bool) -> None:
    for name, asked in (("pitch_um", layout.pitch_um), ("level_height_um", layout.level_height_um)):
        calibrated = card[name]
        if abs(calibrated - asked) > 1e-9 and not (extrapolate and name == "level_height_um"):
            raise InputError(
                f"{name} of the layout",
                got=f"{asked:g} µm",
                wanted=f"{calibrated:g} µm, with which the model was trained",
                hint=f"design with --pitch-um {calibrated:g}, or use a model with a pitch of {asked:g} µm"
                if name == "pitch_um"
                else "use --extrapolate to accept extrapolated heights",
            )
    highest, asked = card["calibrated_range_um"][1], (layout.levels - 1) * layout.level_height_um
    if asked > highest + 1e-6 and not extrapolate:
        raise InputError(
            "highest level of the layout",
            got=f"{layout.levels} levels of {layout.level_height_um:g} µm ({asked:g} µm)",
            wanted=f"at most {highest:g} µm, up to which the model was calibrated",
            hint="use fewer levels, or --extrapolate to accept extrapolated heights",
        )


def check_device(device: Device) -> None:
    """Check that this machine has a device.

    Raises:
        InputError: the machine does not have the device.
    """
    try:
        wanted = torch.device(device)
        there = wanted.type != "cuda" or (wanted.index or 0) < torch.cuda.device_count()
    except RuntimeError:
        there = False
    if not there:
        raise InputError(
            "device", got=repr(str(device)), wanted="cpu, or a GPU of this machine: cuda, cuda:1 …"
        )
