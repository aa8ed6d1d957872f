"""What the layout still explains when no term along one covariate is left: a ridge over many of its features.

It is tried last and stands beside nothing: it holds most of what other terms see, so that it would contain
every cause. What it gains is a shared response to the layout that has neither a name nor a covariate.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import nn

from litho_models.fitting.ridge import feature_rows
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.probes.linear import Left, LinearProbe, probe_of_rows
from litho_models.models.features import Features, FeaturesConfig, RandomFeaturesConfig
from litho_models.prediction.tiles import predict_field

LAYOUT_FEATURES = "layout-features"


def richest_features(scan: PreparedScan) -> Features:
    """All features of the zoo, without the random ones, for scans like this one; weights are not fitted."""
    first = scan.stored
    config = RandomFeaturesConfig.of_variant(
        pitch_um=first.pitch_um, level_height_um=first.level_height_um, levels=first.levels
    )
    return Features(FeaturesConfig(**config.model_dump(include=set(FeaturesConfig.model_fields))))


def layout_features(left: Left) -> LinearProbe | None:
    """One coefficient per feature of the layout; None where no layout varies."""
    if all(np.ptp(scan.stored.layout_um) == 0 for scan in left.scans):
        return None
    model = richest_features(left.scans[0])
    spread: list[np.ndarray] = []

    def unscaled(scan: PreparedScan, prediction: np.ndarray) -> np.ndarray:
        rows = feature_rows(model, scan.stored, scan.sample)
        spread.append(rows.var(axis=1))
        return rows

    ones = np.ones(model.parameter_count)
    map_of = partial(_correction, model=model, scale=ones)
    measured = probe_of_rows(LAYOUT_FEATURES, unscaled, map_of, np.diag(ones), None, _no_numbers, left)
    # To make features takes long: they are measured as they are, and their inner products scaled.
    scale = np.sqrt(np.mean(spread, axis=0))
    scale[scale == 0] = 1.0
    return replace(
        measured,
        rows_of=partial(_rows, model=model, scale=scale),
        map_of=partial(_correction, model=model, scale=scale),
        grams=measured.grams / np.outer(scale, scale),
        rights=measured.rights / scale,
    )


def _rows(scan: PreparedScan, prediction: np.ndarray, model: Features, scale: np.ndarray) -> np.ndarray:
    return feature_rows(model, scan.stored, scan.sample) / scale[:, None]


def _correction(
    coefficients: np.ndarray, scan: PreparedScan, prediction: np.ndarray, model: Features, scale: np.ndarray
) -> np.ndarray:
    """The weighted features over the whole field, by tiles: all of them at once would take gigabytes."""
    weighted = Features(model.config)
    weighted.weights = nn.Parameter(torch.as_tensor(coefficients / scale, dtype=torch.float32))
    with torch.no_grad():
        return predict_field(weighted, scan.layout)[0, 0].numpy()


def _no_numbers(coefficients: np.ndarray) -> dict[str, tuple[float, str]]:
    """None that would mean something: features overlap, so that their coefficients stand for each other."""
    return {}
