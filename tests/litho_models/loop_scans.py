"""Make small scans of a known print by a known microscope, to test the measurement model and the twin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from litho_data.store import PrintedScan
from litho_models.effects import get_effect
from litho_models.loop import closing
from litho_models.loop.fits import State, Study, fit_state
from litho_models.loop.model import Twin, Values
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.models import build_model
from litho_models.scan_terms import measurement_fit
from litho_models.simulator import Simulator

PITCH_UM, LEVELS, LEVEL_HEIGHT_UM = 0.1, 13, 0.1
FIELDS, BLUR_UM = 2, 0.25


def search_little(
    patch: pytest.MonkeyPatch,
    causes: Sequence[str] = (),
    laws: Sequence[str] = (),
    tables: Sequence[str] = (),
) -> None:
    """Make a loop search only for these causes, laws and tables, and for one surface that all scans share.
    The other candidates take time and have their own tests.
    """
    patch.setattr(closing, "screened_effects", lambda tip_radius_um: [get_effect(one) for one in causes])
    patch.setattr(closing, "LAWS", {one: get_effect(one) for one in laws})
    patch.setattr(closing, "TABLES", {one: get_effect(one) for one in tables})
    patch.setattr(measurement_fit, "_FOR_ALL", {"background": [2]})
    patch.setattr(measurement_fit, "_FOR_GROUPS", {})


def blank_scan(number: int, size_px: int = 48, **facts: object) -> PrintedScan:
    """Return a scan with a random layout and all heights 0. Each print has two scans."""
    rng = np.random.default_rng([3, number])
    smooth = gaussian_filter(rng.normal(size=(size_px, size_px)), 4.0, mode="wrap")
    ranks = np.argsort(np.argsort(smooth.ravel())).reshape(smooth.shape) / smooth.size
    level = np.floor(ranks * LEVELS).clip(0, LEVELS - 1).astype(np.uint8)
    printed, field = str(number // FIELDS + 1), str(number % FIELDS + 1)
    scan = PrintedScan(
        id=f"P{printed}F{field}",
        print_id=printed,
        order=number,
        mask_level=level,
        height_um=np.zeros(level.shape, np.float32),
        valid=np.ones(level.shape, bool),
        pitch_um=PITCH_UM,
        level_height_um=LEVEL_HEIGHT_UM,
        levels=LEVELS,
        scan_to_layout=np.eye(3),
        groups={"field": field},
    )
    return replace(scan, **facts)  # type: ignore[arg-type]


def blank_scans(count: int, size_px: int = 48) -> list[PrintedScan]:
    return [blank_scan(number, size_px) for number in range(count)]


def with_heights(scans: Sequence[PrintedScan], heights_um: Sequence[np.ndarray]) -> list[PrintedScan]:
    """Return the scans with their measured heights replaced by ``heights_um``."""
    pairs = zip(scans, heights_um, strict=True)
    return [replace(scan, height_um=own.astype(np.float32)) for scan, own in pairs]


def base_model() -> Simulator:
    """Return a base model with one blur, whose gain and offset differ from their initial values."""
    facts = {"pitch_um": PITCH_UM, "level_height_um": LEVEL_HEIGHT_UM, "levels": LEVELS}
    model = build_model("affine-mtf", sigmas_um=(BLUR_UM,), **facts)
    for name, value in (("weights", 0.9), ("offset_um", 0.03)):
        getattr(model, name).data.fill_(value)
    return model


def planted(
    effects: Sequence[tuple[str, str, Values]] = (),
    *,
    count: int = 10,
    size_px: int = 48,
    noise_um: float = 0.004,
    seed: int = 0,
    base: Simulator | None = None,
) -> list[PrintedScan]:
    """Return scans of a base model with effects, each given as (name, grouping, values by label). Every scan
    has a datum and white noise.
    """
    rng = np.random.default_rng(seed)
    scans = blank_scans(count, size_px)
    prepared = prepare_scans(scans)
    twin = Twin.bare(base or base_model())
    for name, by, values in effects:
        twin = twin.with_effect(name, by, values)
    heights = [
        twin.height(scan) + 0.02 * rng.normal() + rng.normal(0, noise_um, scan.shape) for scan in prepared
    ]
    return with_heights(scans, heights)


def study_of(scans: Sequence[PrintedScan], folds: int = 3, seed: int = 0) -> Study:
    """Return a study in which the scans are assigned to the folds in turn."""
    prepared: list[PreparedScan] = prepare_scans(scans)
    return Study(prepared, np.arange(len(scans)) % folds, seed)


def bare_state(study: Study) -> State:
    """Return the base model fitted to the study, without effects."""
    return fit_state(Twin.bare(base_model()), study)
