"""Check bases that are frozen, or trained without each fold. They must not leak, and the effects that they
lack must be found.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from torch import nn

from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_data.store.printed_scan import scan_sha256
from litho_models.effects import FieldContext, get_effect
from litho_models.evaluation.benchmark import benchmark
from litho_models.fitting import Fitted, TrainingConfig, fit
from litho_models.fitting.runs import train
from litho_models.frozen.card import ModelCard
from litho_models.frozen.freezing import freeze
from litho_models.loop import bases
from litho_models.loop.bases import bases_for, train_folds
from litho_models.loop.closing import close
from litho_models.loop.errors import HeldOut
from litho_models.loop.fits import Study, fit_state
from litho_models.loop.model import FoldedBase, Twin
from litho_models.loop.prepared import prepare_scans
from litho_models.loop.run import close_loop
from litho_models.loop.search import Found, search
from litho_models.models import build_model
from litho_models.scan_terms import measurement_fit
from litho_models.scan_terms.grouped import ALL
from litho_models.simulator import Simulator
from tests.litho_models.loop_scans import (
    LEVEL_HEIGHT_UM,
    LEVELS,
    PITCH_UM,
    base_model,
    planted,
    search_little,
    study_of,
    with_heights,
)
from tests.litho_models.prints import make_scans, write_store

LAW = "height-times-slope-size-x"
STRENGTH = {"strength": 0.04}


@pytest.fixture(autouse=True)
def no_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    search_little(monkeypatch)


def chosen(base: str, scans: Sequence[PrintedScan], cache: Path) -> nn.Module:
    (model,) = bases_for(base, study_of(scans), cache=cache).values()
    return model


def trained(scans: Sequence[PrintedScan]) -> Simulator:
    """Return a base that is trained on these scans outside the loop. The fit changes its gain and its offset,
    and nothing else.
    """
    model = base_model()
    with torch.no_grad():
        own = [model(torch.from_numpy(scan.layout_um)[None, None]).numpy().ravel() for scan in scans]
        heights = np.concatenate([scan.height_um.ravel() for scan in scans])
        gain, offset_um = np.polyfit(np.concatenate(own), heights, 1)
        model.weights.mul_(gain)
        model.offset_um.mul_(gain).add_(offset_um)
    return model


def fitted(scans: Sequence[PrintedScan]) -> Fitted:
    return cast(Fitted, SimpleNamespace(model=trained(scans)))


def bases_of(study: Study) -> dict[str, nn.Module]:
    return {
        "fitted here": base_model(),
        "trained per fold": train_folds(study, fitted),
    }


@pytest.mark.parametrize("base", ["fitted here", "trained per fold"])
def test_no_height_of_a_held_out_scan_changes_its_prediction(
    base: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check that the base, the law, the print and the shared terms do not depend on the heights of held-out
    scans.
    """
    monkeypatch.setattr(measurement_fit, "_FOR_ALL", {"background": [2]})
    monkeypatch.setattr(measurement_fit, "_FOR_GROUPS", {"gain": [0]})
    scans = planted([(LAW, ALL, {"": STRENGTH})], count=6)
    study = study_of(scans)
    out = np.flatnonzero(study.fold_of == 1).tolist()
    other = [s.height_um + 0.2 * s.layout_um**2 if i in out else s.height_um for i, s in enumerate(scans)]
    maps, fitted = [], []
    for own in (scans, with_heights(scans, other)):
        closed = close(study_of(own), {base: bases_of(study_of(own))[base]})
        # Add a law to the model, so that its strength is fitted too.
        state = fit_state(closed.base.twin.with_effect(LAW, ALL, {"": STRENGTH}), closed.study)
        fitted.append(state.per_fold[1].vector)
        maps.append(np.stack([HeldOut(closed.given).maps_um(state)[i] for i in out]))
    # The fit without a fold starts from the fit to all scans. It stops when a step reduces the error by less
    # than 1e-4 of it, so it may depend slightly on this start. The heights were changed by up to 0.2 µm.
    assert np.abs(maps[1] - maps[0]).max() < 1e-4
    np.testing.assert_allclose(fitted[1], fitted[0], atol=1e-3)


def test_a_network_is_trained_without_each_fold_and_once_on_all() -> None:
    scans = planted(count=6)
    study = study_of(scans)
    model = bases_of(study)["trained per fold"]
    assert isinstance(model, FoldedBase)
    assert len(model.models) == len(study.folds) + 1
    assert Twin.bare(model).own == 0

    def numbers(one: nn.Module) -> list[float]:
        return [float(p.detach()) for p in one.parameters()]

    for scan, fold in zip(scans, study.fold_of, strict=True):
        rest = [own for own, of in zip(scans, study.fold_of, strict=True) if of != fold]
        assert numbers(model.of_scan(scan.id)) == numbers(model.models[int(fold)]) == numbers(trained(rest))
    assert numbers(model.of_scan("elsewhere")) == numbers(trained(scans))


@pytest.mark.parametrize("name", ["affine", "linear"])
def test_a_trained_base_learns_what_the_printer_does_with_an_exposure(name: str) -> None:
    """Check a noiseless printer whose print depends only on the layout times the dose."""
    scans = [replace(scan, dose=(0.8, 1.2)[at % 2]) for at, scan in enumerate(planted(count=6))]
    truth = [1.3 * scan.exposed_um + 0.01 for scan in scans]
    stated = with_heights(scans, truth)
    trainer = partial(fit, name, config=TrainingConfig.of_recipe("fast", name))
    errors = []
    for known in (stated, [replace(scan, dose=1.0) for scan in stated]):
        study = study_of(known)
        learned = Twin.bare(train_folds(study, trainer))
        errors.append(
            np.mean([np.std(learned.height(s) - own) for s, own in zip(study.scans, truth, strict=True)])
        )
    # ``affine`` contains the truth. ``linear`` does not: it cannot follow the sharp edges of these layouts.
    assert errors[0] < {"affine": 1e-5, "linear": 0.6}[name] * errors[1]


def test_the_cache_of_fits_finds_a_scan_after_it_has_been_prepared() -> None:
    [scan] = planted(count=1)
    [prepared] = prepare_scans([scan])
    assert scan_sha256(prepared) == scan_sha256(scan) != scan_sha256(replace(scan, dose=0.8))


class Carrying(nn.Module):
    """Imitate a base that was trained elsewhere and already contains the law."""

    def __init__(self) -> None:
        super().__init__()
        self.base = base_model().requires_grad_(False)

    def forward(self, layout: torch.Tensor) -> torch.Tensor:
        context = FieldContext(layout, PITCH_UM, (LEVELS - 1) * LEVEL_HEIGHT_UM)
        return get_effect(LAW)(self.base(layout), STRENGTH, context)


def test_the_search_adds_a_law_that_a_trained_model_lacks_and_none_that_it_has() -> None:
    study = study_of(planted([(LAW, ALL, {"": STRENGTH})]))
    for base, names in ((base_model().requires_grad_(False), [LAW]), (Carrying(), [])):
        start = fit_state(Twin.bare(base), study)
        found = search(Found(start), [get_effect(LAW), get_effect("height-power-2")])
        assert [one.name for one in found.causes] == names
        assert found.state.twin.own == 0
        # The residual is the white noise of 4 nm.
        assert np.sqrt(found.state.mse_nm2) == pytest.approx(4.0, rel=0.05)
        if names:
            assert found.state.twin.values()[LAW] == pytest.approx(STRENGTH, rel=0.03)


def test_a_frozen_base_is_taken_as_it_is_and_only_at_its_pitch(tmp_path: Path) -> None:
    scans = planted(count=4)
    model = chosen("zoo:pbl", scans, tmp_path)
    assert Twin.bare(model).own == 0
    coarse = [replace(scan, pitch_um=0.2) for scan in scans]
    with pytest.raises(InputError, match=r"pitch of zoo:pbl, got 0.1 µm, wanted 0.2 µm"):
        chosen("zoo:pbl", coarse, tmp_path)
    # A frozen base is not fitted, so nested selection cannot repeat any choice.
    store = write_store(tmp_path / "s.zarr", scans)
    with pytest.raises(InputError, match="--nested with zoo:pbl"):
        close_loop(store, tmp_path / "out", base="zoo:pbl", nested="prints")


def test_a_frozen_network_is_no_base_for_the_scans_it_was_trained_on(tmp_path: Path) -> None:
    """Check that no error is called held out although the base has seen the scan."""
    scans = make_scans(6, size_px=56)
    store = write_store(tmp_path / "s.zarr", scans)
    moved = with_heights(scans, [one.height_um + 0.001 for one in scans])
    other = write_store(tmp_path / "other.zarr", moved, name="other prints")
    train(store, "features", tmp_path / "run")
    freeze(tmp_path / "run", tmp_path / "model")
    with pytest.raises(InputError, match="trained on scans of this store"):
        close_loop(store, tmp_path / "out", base=str(tmp_path / "model"))
    assert not (tmp_path / "out").exists()
    close_loop(other, tmp_path / "out", base=str(tmp_path / "model"))


def test_a_network_is_refused_for_nested_choices_before_it_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bases, "train_folds", None)
    store = write_store(tmp_path / "s.zarr", make_scans(6, size_px=56))
    with pytest.raises(InputError, match="--nested with features"):
        close_loop(store, tmp_path / "out", base="features", nested="prints")


def test_prints_are_left_out_only_if_there_are_two(tmp_path: Path) -> None:
    """Check that one print is refused at once, and not after the loop."""
    scans = [replace(scan, print_id="1") for scan in make_scans(6, size_px=56)]
    store = write_store(tmp_path / "s.zarr", scans)
    with pytest.raises(InputError, match="--nested prints, got scans of one print"):
        close_loop(store, tmp_path / "out", base="physics", nested="prints")


@pytest.mark.slow
def test_the_loop_starts_where_the_benchmark_ends(tmp_path: Path) -> None:
    """Check that the loop and the benchmark use the same fits of a network and state the same error."""
    store, out = write_store(tmp_path / "s.zarr", make_scans(6, size_px=56, bow_um=0.02)), tmp_path / "l"
    scored = benchmark(store, tmp_path / "b", models=["features"], folds=2).scores[0]
    loop = close_loop(store, out, base="features", folds=2, cache=tmp_path / "b" / "cache")
    first = loop.error("base", "offset", "published")
    assert first is not None
    # Predictions, pixels, terms and background are the same. Only the order of sums differs.
    assert first.mae_nm == pytest.approx(scored.mae_datum_free_nm, abs=1e-6)
    assert first.rmse_nm == pytest.approx(
        np.sqrt(np.mean([row.rmse_datum_free_nm**2 for row in scored.scans])), abs=1e-6
    )
    assert first.by_scan_nm == pytest.approx({row.scan: row.mae_datum_free_nm for row in scored.scans})
    # This depends on the background: without it, the same fits have another error.
    bare = loop.error("base", "offset", "print alone")
    assert bare is not None
    assert abs(bare.mae_nm - first.mae_nm) > 0.1
    # The saved model is the one that was trained on all scans.
    assert ModelCard.read(out / "model").model == "features"
    assert build_model("features").parameter_count == ModelCard.read(out / "model").parameters
