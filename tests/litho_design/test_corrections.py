"""Test the benchmark of corrections. Each correction is scored by judges that were not used to make it."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks import corrections
from benchmarks.corrections import ALLOWED, RELIEFS, as_markdown, corrected, holds, over_idle, wanted_um
from litho_design.printers.printer import Printer
from litho_design.printers.training import own_error_um
from litho_design.reliefs.settings import relief_settings
from litho_design.reliefs.task import ReliefTask
from tests.litho_design.conftest import BlurPrinter, unreported

SEEDS = (5, 6)


class Hidden(BlurPrinter):
    """Imitate a printer with two effects that its models lack: slopes along x lose height, and high places
    shrink.
    """

    def __init__(self, seed: int):
        draw = np.random.default_rng(seed)
        super().__init__(sigma_um=draw.uniform(0.2, 0.3), gain=draw.uniform(0.7, 0.8), name="hidden")
        self.lost_um, self.bend = draw.uniform(0.05, 0.1), draw.uniform(0.05, 0.15)

    def forward(self, layout_um, pitch_um=0.1):
        height = super().forward(layout_um)
        slope = torch.gradient(height, spacing=pitch_um, dim=-1)[0].abs()
        return height - self.bend * height.square() - self.lost_um * slope


def fitted(name: str, sigma_um: float, hidden: Hidden, layout) -> Printer:
    """Return a blur model that is fitted to prints of smooth layouts. Its card states its errors on these
    prints.
    """
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(6, 1, 12, 12, generator=generator) * 1.2
    layouts = torch.nn.functional.interpolate(coarse, size=96, mode="bicubic").clamp(0, 1.2)
    unit = BlurPrinter(sigma_um=sigma_um, gain=1.0, offset_um=0.0)
    with torch.no_grad():
        seen, blurred = hidden(layouts), unit(layouts)
    gain, offset = np.polyfit(blurred.flatten().numpy(), seen.flatten().numpy(), 1)
    model = BlurPrinter(sigma_um=sigma_um, gain=float(gain), offset_um=float(offset), name=name)
    baseline = []
    for print_um, expected in zip(seen[:, 0].numpy(), (gain * blurred + offset)[:, 0].numpy(), strict=True):
        baseline.append({
            "error_nm": 1e3 * float(np.abs(print_um - expected).mean()),
            "relief_nm": 1e3 * float(expected.std()),
            "gain": float(np.polyfit(expected.ravel(), print_um.ravel(), 1)[0]),
        })  # fmt: skip
    model.card = {"baseline": baseline}
    return Printer(model, layout, source="closed form")


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    changes = {"layout.size_px": 64, "search.iterations": 40, "search.polish_rounds": 20}
    settings = relief_settings(changes | {"window.yield_draws": 2})
    found = []
    for seed in SEEDS:
        hidden = Hidden(seed)
        models = [
            fitted(name, sigma, hidden, settings.layout) for name, sigma in (("fine", 0.2), ("wide", 0.3))
        ]
        judge = Printer(hidden, settings.layout, source="hidden")
        place = tmp_path_factory.mktemp(f"seed{seed}")
        with unreported():
            found += [corrected(name, seed, models, judge, place / name, settings) for name in RELIEFS]
    return found


def test_a_correction_is_no_worse_than_none_by_a_judge_that_took_no_part(rows):
    assert all(over_idle(row) < ALLOWED for row in rows)
    blazes = [over_idle(row, ("best affine",)) for row in rows if row["relief"] == "blaze"]
    assert np.median(blazes) < 1
    assert all(over_idle(row) < 0.8 for row in rows if row["relief"] in ("freeform", "staircase"))


def test_the_stated_width_contains_the_printed_heights(rows):
    assert sum(map(holds, rows)) >= 9
    # The width is not trivially large, because the reliefs have an rms height of at least 170 nm.
    assert np.median([row["between_nm"][1] for row in rows]) < 100
    # The models agree with each other, so without their errors the width would contain hardly any print.
    smooth = [row for row in rows if row["relief"] in ("cap", "freeform", "staircase")]
    assert sum(abs(row["printed_nm"]["corrected"] / row["stated_nm"] - 1) < 0.1 for row in smooth) < 3


def test_the_error_of_a_model_is_that_of_its_prints_and_grows_with_the_relief():
    own = {"error_nm": 8.0, "relief_nm": 100.0, "gain": 1.0}
    # The error is sqrt(pi / 2) * 8 nm on reliefs up to those of its own prints, and proportional beyond.
    for relief_um, wanted in ((0.05, 0.01003), (0.1, 0.01003), (0.3, 0.03008)):
        assert own_error_um({"baseline": [own]}, relief_um) == pytest.approx(wanted, rel=1e-3)
    gains = [{**own, "gain": gain} for gain in (0.9, 1.1)]
    assert own_error_um({"baseline": gains}, 0.1) == pytest.approx(math.hypot(0.01003, 0.01), rel=1e-3)
    assert own_error_um({}, 0.1) == 0


def test_a_relief_is_corrected_for_the_expected_error_over_its_models():
    settings = relief_settings({"layout.size_px": 32})
    models = [BlurPrinter(gain=gain, name=f"gain {gain}") for gain in (0.6, 0.9)]
    printers = [Printer(one, settings.layout, source="closed form") for one in models]
    inputs = {"relief_um": wanted_um("cap", 0, settings)}
    together = ReliefTask(settings, printers[0], inputs=inputs, ensemble=printers[1:])
    level = together.untouched()["uncorrected"].float()[None, None]
    alone = [float(ReliefTask(settings, one, inputs=inputs).objective(level)[0]) for one in printers]
    # The result is the rms of the errors of equally weighted models, neither the largest error nor the mean.
    assert float(together.objective(level)[0]) == pytest.approx(
        math.sqrt(np.mean(np.square(alone))), rel=1e-5
    )


def test_a_correction_of_another_size_is_not_used(tmp_path, monkeypatch):
    def sized(relief, seed, _models, judge, _place, settings):
        errors = dict.fromkeys(corrections.COLUMNS, settings.layout.size_px)
        judged = {"relief": relief, "seed": seed, "judge": judge.name, "between_nm": [0, 999]}
        return judged | {"printed_nm": errors}

    monkeypatch.setattr(corrections, "corrected", sized)
    monkeypatch.setattr(corrections, "_printers", lambda *_: [(5, [], SimpleNamespace(name="fab"))])
    for size in (64, 128):
        monkeypatch.setattr("sys.argv", ["corrections", "--out", str(tmp_path), "--size", str(size)])
        corrections.main()
        record = json.loads((tmp_path / "corrections.json").read_text())
        assert {row["printed_nm"]["corrected"] for row in record["rows"]} == {record["size_px"]} == {size}


def test_the_table_says_which_corrections_are_worse(rows):
    better = [{**row, "printed_nm": {**row["printed_nm"], "corrected": 1.0}} for row in rows]
    told = as_markdown({"rows": better, "size_px": 64})
    assert f"In 0 of {len(rows)} cases, the error of the corrected print is more than 5 % larger" in told
    better[0]["printed_nm"]["corrected"] = 999.0
    told = as_markdown({"rows": better, "size_px": 64})
    assert f"In 1 of {len(rows)} cases, the error of the corrected print is more than 5 % larger" in told
    assert "more than 5 % larger (cap by hidden 5" in told
