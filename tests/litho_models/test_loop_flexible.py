"""A base model that is taken as trained: what it lacks is added, what it carries is called absorbed."""

from __future__ import annotations

import pytest

from litho_data.store.schema import DatasetId
from litho_models.loop import LoopConfig, close_loop, corrected_chain
from litho_models.loop.result.summary import summarise
from tests.litho_models.loop_scans import printed_scans, true_model

EFFECT = {"vignetting": {"strength": 0.2}}


@pytest.mark.slow
@pytest.mark.parametrize(
    "carries_it", [pytest.param(False, marks=pytest.mark.long), True], ids=["lacks it", "carries it"]
)
def test_an_effect_is_added_to_or_absorbed_by_a_trained_model(carries_it: bool) -> None:
    scans = printed_scans(EFFECT, seed=1)
    trained = true_model(EFFECT if carries_it else {}).requires_grad_(False)
    findings = close_loop(scans, trained, LoopConfig(), trainer=lambda training: trained)
    dataset = DatasetId(name="made here", sha256="")
    result = summarise(findings, dataset=dataset, base_name="trained", dropped=[])
    verdict = {c.name: c.verdict for c in result.candidates}["vignetting"]
    if carries_it:
        assert verdict == "absorbed"
        # Of eight scans no test of the rest could show a structure.
        assert result.verdict == "too-few-scans"
    else:
        assert verdict == "explained"
        assert corrected_chain(findings).values()["vignetting"]["strength"] == pytest.approx(0.2, abs=0.02)
