"""The plots of the loop's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from litho_data.foundation.report import spelt_out
from litho_data.foundation.report_pictures import LIGHT, new_figure
from litho_data.foundation.units import NM_PER_UM
from litho_models.loop.findings import LoopFindings
from litho_models.loop.identifiability import Profile
from litho_models.loop.probes import AddedProbe, far, with_intervals
from litho_models.loop.probes.displaced import DisplacedCopy
from litho_models.loop.probes.kernel import MissingKernel
from litho_models.loop.probes.places import drawn, drawn_profile, shifts
from litho_models.loop.structure import CovariateTest
from litho_models.loop.study import Score

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAPS, _ARROWS = 3, 11
# Probes whose numbers belong to powers of the shape.
OF_SHAPES = ("shape-powers", "order-shapes")
# Probes that are tables, and what they run along.
_TABLES = {
    "level-table": "printed level",
    "slope-table": "steepness of the print (µm/µm)",
    "axis-slope-table": "steepness along the axis (µm/µm)",
    "diagonal-slope-table": "steepness along the diagonal (µm/µm)",
}
# The scan runs from -1 to 1.
_OVER_SCAN = "y over the scan", "x over the scan"
_BEFORE, _AFTER, _SECOND = "#9aa5b1", "#2f7fd0", "#c05621"


def staircase_figure(frame: pd.DataFrame) -> Figure:
    """Held-out error after each step."""
    figure = new_figure(9, 0.42 * len(frame) + 1.2)
    axes = figure.subplots()
    y = np.arange(len(frame))[::-1]
    colours = [_BEFORE if label.startswith("base") else _AFTER for label in frame["model"]]
    mae = frame["MAE (nm)"].to_numpy()
    errors = np.abs(np.stack([mae - frame["low"], frame["high"] - mae]))
    axes.barh(y, mae, xerr=errors, color=colours, height=0.66, error_kw={"elinewidth": 1.2})
    for position, value, high in zip(y, mae, frame["high"], strict=True):
        axes.annotate(
            f"{value:.1f}", (high, position), (5, 0), textcoords="offset points", va="center", fontsize=9
        )
    axes.set_yticks(y, frame["model"])
    axes.set(xlim=(0, 1.12 * float(frame["high"].max())), xlabel="mean absolute error on held-out scans (nm)")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def map_figure(findings: LoopFindings, before: Score, after: Score) -> Figure:
    """Residual of the worst, the median and the best scan, before and after, on one scale."""
    ranking = np.argsort(-before.mse_nm2)
    picked = ranking[np.unique(np.linspace(0, len(ranking) - 1, _MAPS).astype(int))]
    limit = 2.5 * before.rmse_nm
    figure = new_figure(4.1 * len(picked) + 0.8, 8.2)
    axes = figure.subplots(2, len(picked), squeeze=False)
    for column, at in enumerate(picked):
        scan = findings.development[at]
        extent_um = [
            0,
            scan.usable.shape[1] * scan.stored.pitch_um,
            scan.usable.shape[0] * scan.stored.pitch_um,
            0,
        ]
        for row, (label, s) in enumerate((("before", before), ("after", after))):
            panel = axes[row, column]
            panel.imshow(
                s.residual_um[at] * NM_PER_UM, cmap="RdBu_r", vmin=-limit, vmax=limit, extent=extent_um,
                interpolation="nearest",
            )  # fmt: skip
            panel.set_title(f"{scan.id} {label}: {s.mae_nm[at]:.1f} nm", fontsize=10)
            panel.set(xlabel="x (µm)" if row else "", ylabel="" if column else "y (µm)")
    figure.colorbar(axes[0, 0].images[0], ax=axes, label="measured - predicted (nm)", shrink=0.6)
    return figure


def curve_figure(curves: list[CovariateTest]) -> Figure:
    """Mean residual along each covariate."""
    columns = 3
    rows = -(-len(curves) // columns)
    figure = new_figure(10, 2.3 * rows)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for panel, test in zip(axes, curves, strict=False):
        panel.axhline(0, color=LIGHT["ink"], lw=0.6)
        panel.errorbar(
            test.centres, test.curve_nm, 2 * test.error_nm, fmt="o-", color=_AFTER, ms=3.5, capsize=2
        )
        panel.set_xlabel(test.name, fontsize=8)
        panel.tick_params(labelsize=8)
    for panel in axes[len(curves) :]:
        panel.set_visible(False)
    for panel in axes[::columns]:
        panel.set_ylabel("residual (nm)", fontsize=8)
    return figure


def probe_figure(entry: AddedProbe) -> Figure:
    """What one generic term looks like: a kernel, a copy, a far response, a table, a profile or a map."""
    probe, common = entry.probe, entry.estimate.common
    if isinstance(probe, MissingKernel):
        kernel = probe.kernel_map(common) / probe.pitch_um**2
        shown = probe.size[0] * probe.pitch_um / 2, probe.size[1] * probe.pitch_um / 2
        away = _displaced("y"), _displaced("x")
        return _image(kernel, shown, "height per layout height and µm²", min(5.5, shown[0]), away)
    if isinstance(probe, DisplacedCopy):
        figure = _places_figure(probe.places_um, probe.gain_nm2(), "gain of one copy (nm²)")
        figure.axes[0].plot(common[1], common[0], "o", mfc="none", mec=_SECOND, ms=14)
        return figure
    if probe.name == "far-response":
        return _places_figure(*far.drawn(common), "height per layout height and µm")
    if probe.name in OF_SHAPES:
        return _bars_figure(entry)
    if probe.name in _TABLES:
        return _table_figure(entry)
    if "-shift-" in probe.name:
        parts = dict(zip(("along y", "along x"), shifts(common), strict=True))
        if probe.name.endswith("profile"):
            lines = {axis: drawn_profile(one) for axis, one in parts.items()}
            return _profile_figure(probe.name, lines, "displaced (µm)")
        return _arrows_figure(*(drawn(one, _ARROWS) for one in parts.values()))
    unit = "relative height" if "-gain-" in probe.name else "nm"
    scale = 1.0 if unit == "relative height" else NM_PER_UM
    if probe.name.endswith("profile"):
        return _profile_figure(probe.name, {"": drawn_profile(common) * scale}, unit)
    return _image(drawn(common) * scale, (1.0, 1.0), unit, 1.0, _OVER_SCAN)


def _places_figure(places_um: np.ndarray, values: np.ndarray, label: str) -> Figure:
    """Values (n,) at displacements (y, x) from the layout, (n, 2)."""
    y, x = places_um.T
    figure = new_figure(5, 4)
    axes = figure.subplots()
    points = axes.scatter(x, y, c=values, s=6, cmap="viridis")
    figure.colorbar(points, ax=axes, label=label)
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set(xlabel=_displaced("x"), ylabel=_displaced("y"))
    return figure


def _displaced(axis: str) -> str:
    return f"displaced along {axis} (µm)"


def _bars_figure(entry: AddedProbe) -> Figure:
    found = with_intervals(entry.probe, entry.estimate)
    values = np.array([value for value, _, _ in found.values()])
    ends = np.array([interval for _, _, interval in found.values()])
    figure = new_figure(6, 0.3 * len(found) + 1)
    axes = figure.subplots()
    axes.axvline(0, color=LIGHT["ink"], lw=0.6)
    axes.errorbar(
        values, np.arange(len(found)), xerr=np.abs(ends.T - values), fmt="o", color=_AFTER, ms=4, capsize=2
    )
    axes.set_yticks(np.arange(len(found)), list(found))
    axes.invert_yaxis()
    axes.set_xlabel("missing height (nm per unit)")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _table_figure(entry: AddedProbe) -> Figure:
    found = with_intervals(entry.probe, entry.estimate)
    values = pd.DataFrame(
        [(*name.rpartition("_")[::2], value, *interval) for name, (value, _, interval) in found.items()],
        columns=["covariate", "place", "height", "low", "high"],
    )
    figure = new_figure(6, 3)
    axes = figure.subplots()
    axes.axhline(0, color=LIGHT["ink"], lw=0.6)
    for colour, (covariate, table) in zip(
        (_AFTER, _SECOND), values.groupby("covariate", sort=False), strict=False
    ):
        errors = np.abs(table[["low", "high"]].to_numpy().T - table["height"].to_numpy())
        label = str(covariate).replace("_", " ")
        places = table["place"].astype(float)
        axes.errorbar(places, table["height"], errors, fmt="o-", color=colour, ms=4, capsize=2, label=label)
    if len(axes.containers) > 1:
        axes.legend(frameon=False)
    axes.set(xlabel=_TABLES[entry.probe.name], ylabel="missing height (nm)")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _profile_figure(name: str, lines: Mapping[str, np.ndarray], unit: str) -> Figure:
    """Profiles over the rows or the columns, by their labels."""
    figure = new_figure(6, 3)
    axes = figure.subplots()
    axes.axhline(0, color=LIGHT["ink"], lw=0.6)
    for (label, values), colour in zip(lines.items(), (_AFTER, _SECOND), strict=False):
        axes.plot(np.linspace(0, 1, len(values)), values, color=colour, label=label)
    if len(lines) > 1:
        axes.legend(frameon=False)
    axes.set(xlabel=f"{name.partition('-')[0]}s, from the first to the last", ylabel=unit)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _arrows_figure(y_um: np.ndarray, x_um: np.ndarray) -> Figure:
    """Where the print lies off its place, over the scan."""
    figure = new_figure(5, 4)
    axes = figure.subplots()
    at = np.linspace(-1, 1, len(y_um))
    longest_um = float(np.hypot(y_um, x_um).max())
    arrows = axes.quiver(at, at, x_um, y_um, angles="xy", color=_AFTER)
    axes.quiverkey(arrows, 0.8, 1.04, longest_um, f"{longest_um:.2f} µm", labelpos="E")
    axes.set_aspect("equal")
    axes.invert_yaxis()
    axes.set(ylabel=_OVER_SCAN[0], xlabel=_OVER_SCAN[1])
    return figure


def _image(
    values: np.ndarray, half: tuple[float, float], label: str, shown: float, along: tuple[str, str]
) -> Figure:
    figure = new_figure(5, 4)
    axes = figure.subplots()
    limit = float(np.abs(values).max()) or 1.0
    picture = axes.imshow(
        values, cmap="RdBu_r", vmin=-limit, vmax=limit,
        extent=(-half[1], half[1], half[0], -half[0]),
    )  # fmt: skip
    axes.set(xlim=(-shown, shown), ylim=(shown, -shown), ylabel=along[0], xlabel=along[1])
    figure.colorbar(picture, ax=axes, label=label)
    return figure


def profile_figure(profiles: Sequence[Profile]) -> Figure:
    """Root mean square residual against each number, the fitted value marked."""
    columns = min(len(profiles), 3)
    rows = -(-len(profiles) // columns)
    figure = new_figure(3.4 * columns, 2.6 * rows)
    axes = figure.subplots(rows, columns, squeeze=False)
    for one, own in zip(profiles, axes.flat, strict=False):
        own.plot(one.held, one.rmse_nm, "o-", color=_AFTER, ms=3, lw=1.2)
        own.axvline(one.fitted, color=_BEFORE, lw=1)
        own.set_title(one.effect, fontsize=9)
        own.set_xlabel(spelt_out(one.parameter), fontsize=8)
        own.ticklabel_format(axis="both", useOffset=False)
        own.locator_params(axis="x", nbins=4)
        own.tick_params(labelsize=7)
        own.spines[["top", "right"]].set_visible(False)
    for own in axes.flat[len(profiles) :]:
        own.set_visible(False)
    for first in axes[:, 0]:
        first.set_ylabel("RMSE (nm)", fontsize=8)
    return figure
