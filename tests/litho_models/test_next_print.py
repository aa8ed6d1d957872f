"""Test the next print: an open question becomes an experiment, whose result decides the question."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import numpy as np
import pytest
import tifffile
import torch
from scipy.ndimage import gaussian_filter
from scipy.stats import norm

from benchmarks import measured_plan, two_rounds
from benchmarks.record import published
from litho_data.cards.card import load_card
from litho_data.cards.tables import read_table
from litho_data.foundation.errors import InputError
from litho_data.store import PrintedScan
from litho_data.store.schema import DatasetId
from litho_data.virtual_fab import Truth, jobs_of_card, simulate, simulate_plan
from litho_data.virtual_fab.fab import Fab, scan_job
from litho_data.virtual_fab.knobs import KnobBoard, KnobSetting
from litho_data.virtual_fab.printer import Job
from litho_data.virtual_fab.settings import Microscope, Noise, Printer
from litho_models.effects import FieldContext, get_effect
from litho_models.effects.chain import EffectChain, Frame
from litho_models.effects.registry import TIP
from litho_models.fitting import base_models
from litho_models.fitting.least_squares import fit_least_squares
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import save_frozen
from litho_models.loop import prepared
from litho_models.loop.closing import Closed
from litho_models.loop.fits import RULES, State, TwinProblem, fit_state
from litho_models.loop.judging import judge_states
from litho_models.loop.model import Twin
from litho_models.loop.prepared import PreparedScan, prepare_scans
from litho_models.loop.record import CloseLoop, Decision
from litho_models.loop.results import _candidates, _found, _strengths
from litho_models.loop.search import Cause, Found
from litho_models.models import build_model
from litho_models.planning import answers
from litho_models.planning.answers import Z_DECIDED, _pairs, of_rivals, surely_better
from litho_models.planning.decided import with_decisions
from litho_models.planning.layouts import Limits, assemble, climb, score, starts
from litho_models.planning.open_questions import _cutoff_per_um, _owners, _question, _rivals, open_questions
from litho_models.planning.questions import (
    NONE,
    NoiseSpectrum,
    OpenQuestions,
    Owner,
    Question,
    Rival,
    fit_rivals,
    left_nm,
    noise_spectrum,
)
from litho_models.planning.record import NextPrint, PlannedQuestion
from litho_models.planning.rivalry import (
    PLAIN,
    TURNED,
    Contrast,
    Print,
    Rivalry,
    planned_scans,
    predict,
)
from litho_models.planning.rounds import MICROSCOPE, PRINTER, Judge, close_loop, compared, new_scans
from litho_models.planning.run import next_print
from litho_models.scan_terms.grouped import ALL
from litho_models.scan_terms.term import row_index
from tests.litho_models.loop_scans import (
    bare_state,
    base_model,
    blank_scan,
    blank_scans,
    planted,
    search_little,
    study_of,
    with_heights,
)
from tests.litho_models.prints import write_store
from tests.tables import require_tables_equal_record

SLOPE = {"slope-thinning": {"along_x_um": 0.2, "along_y_um": 0.0, "exponent": 2.0, "turn_deg": 0.0}}
AS_PRINTER, AS_MICROSCOPE = "slope-thinning as the printer's", "slope-thinning as the microscope's"
NOISE_NM = 10.0
DOCS = Path(__file__).parents[2] / "docs"
TWICE = (PLAIN, TURNED)
# The facts that all planned prints share.
SHARED = FieldContext(torch.zeros(1, 1, 8, 8), 0.1, 1.2, 0.1)
# This transform rotates a scan of a print of 6.4 µm by 90°.
QUARTER = np.array([[0.0, -1.0, 6.4], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def model(effects: dict[str, dict[str, float]]) -> Twin:
    """Return the base model of ``loop_scans`` with these effects."""
    twin = Twin.bare(base_model())
    for name, values in effects.items():
        twin = twin.with_effect(name, ALL, {"": get_effect(name).with_values(values)})
    return twin


def rival(effect: str, effects: dict[str, dict[str, float]], owner: Owner | None = None) -> Rival:
    twin = model(effects)
    nothing = np.zeros((len(twin.vector),) * 2).tolist()
    return Rival(
        effect=effect,
        owner=owner,
        effects=twin.values(),
        vector=twin.vector.tolist(),
        information=nothing,
        covariance=nothing,
    )


def slope_question(**changes: object) -> Question:
    name = "slope-thinning"
    return Question(
        name=name,
        kind="role",
        text="whose it is",
        experiment="turn it",
        rivals=[rival(name, SLOPE, owner) for owner in ("printer", "microscope")],
    ).model_copy(update=changes)


def white(tile_px: int = 16) -> NoiseSpectrum:
    return NoiseSpectrum(power_nm2=np.full((tile_px, tile_px), NOISE_NM**2).tolist())


def opened(questions: list[Question]) -> OpenQuestions:
    return OpenQuestions(
        schema=OpenQuestions.SCHEMA,
        dataset=DatasetId(name="made", sha256="0" * 64),
        noise=white(),
        level_share=[1 / 13] * 13,
        cutoff_per_um=0.5,
        write_field_um=None,
        questions=questions,
    )


@pytest.fixture(scope="module")
def rivalry() -> Rivalry:
    return Rivalry(slope_question(), base_model(), white())


@pytest.fixture(scope="module")
def limits() -> Limits:
    return Limits.of(opened([]), 0.1)


def closed_loop(folder: Path, questions: list[Question]) -> Path:
    save_frozen(base_model(), folder / "model", name="made")
    opened(questions).write(folder)
    return folder


def first_layout(limits: Limits, size_px: int = 96) -> np.ndarray:
    return starts(size_px, limits, 3)["random-1"]


def first_print(limits: Limits, size_px: int = 96, ways: Sequence[str] = TWICE) -> Print:
    return planned_scans(SHARED, first_layout(limits, size_px), ways)


# --- scans that are rotated, recorded backwards, or made with another tip


@pytest.mark.parametrize("turned_deg", [90.0, 180.0, 270.0])
def test_the_fab_and_the_models_agree_on_what_turning_does(turned_deg: float) -> None:
    """Check that a scan without noise and warp equals the print rotated by ``rot90``, as its transform
    states.
    """
    level = np.random.default_rng(1).integers(0, 13, (40, 40)).astype(np.uint8)
    fab = Fab(Printer(), Microscope.aligned(), Noise.off(), KnobBoard([], 0), 0)
    plain, turned = (scan_job(fab, Job("a", level, turned_deg=deg)) for deg in (0.0, turned_deg))
    along = turned.frame.scan_to_layout[:2, 0]
    quarters = round(math.atan2(along[1], along[0]) / (math.pi / 2)) % 4
    # At integer positions, cubic interpolation gives the same pixels up to rounding.
    assert np.abs(np.rot90(plain.height_um, quarters) - turned.height_um).max() < 1e-9
    assert quarters == turned_deg // 90


def test_effects_of_the_microscope_turn_with_the_scan_and_those_of_the_printer_do_not() -> None:
    height = torch.rand(1, 1, 24, 30)
    layout = torch.rand(1, 1, 24, 30)
    plain = FieldContext(layout, 0.1, 1.2)
    values = {"length_um": 0.3, "rising": 0.5, "direction": 1.0}
    lag, thinning = get_effect("feedback-lag"), get_effect("slope-thinning")
    chain = EffectChain(torch.nn.Identity(), {"feedback-lag": values})
    seen = chain(height, replace(plain, quarter_turns=1))
    by_hand = torch.rot90(lag(torch.rot90(height, 1, (-2, -1)), values, plain), -1, (-2, -1))
    assert torch.equal(seen, by_hand)
    back = chain(height, replace(plain, backward=True))
    assert torch.allclose(back, lag(height, {**values, "direction": -1.0}, plain))
    amounts = thinning.with_values({"along_x_um": 0.2})
    frames: tuple[dict[str, Frame], ...] = ({}, {"slope-thinning": "scan"})
    for own, axis in zip(frames, ("along_x_um", "along_y_um"), strict=True):
        chain = EffectChain(torch.nn.Identity(), {"slope-thinning": amounts}, own)
        expected = thinning(height, thinning.with_values({axis: 0.2}), plain)
        assert torch.allclose(chain(height, replace(plain, quarter_turns=1)), expected, atol=1e-6)
    tip = EffectChain(torch.nn.Identity(), {"tip-dilation": {"radius_um": 0.4}})
    assert torch.equal(tip(height, replace(plain, new_tip=True)), height)
    assert not torch.equal(tip(height, plain), height)


def test_the_position_of_a_window_turns_with_the_scan() -> None:
    """Check that a part of a field has the same scan coordinates as in the whole rotated field."""
    y, x = torch.meshgrid(torch.arange(20.0), torch.arange(14.0), indexing="ij")
    part = FieldContext(torch.zeros(1, 1, 8, 6), 0.1, 1.2, scan_shape=(20, 14), origin_px=(5, 3))
    for turns in range(4):
        own = replace(part, quarter_turns=turns).in_scan_frame()
        rows = torch.rot90(torch.stack([y, x])[:, 5:13, 3:9], turns, (-2, -1))
        whole = torch.rot90(torch.stack([y, x]), turns, (-2, -1))
        top, left = own.origin_px
        ny, nx = own.layout_um.shape[-2:]
        assert torch.equal(whole[:, top : top + ny, left : left + nx], rows)
        assert own.whole_shape() == tuple(whole.shape[-2:])


# --- the criterion


def test_noise_along_a_change_is_what_draws_of_that_noise_show() -> None:
    random = np.random.default_rng(2)
    blank = blank_scans(4, 80)

    def rough() -> np.ndarray:
        return gaussian_filter(random.normal(size=(80, 80)), (0, 2), mode="wrap")

    noise = [rough() for _ in blank]
    scale = 0.01 / np.std(noise)
    heights = [scan.layout_um + scale * own for scan, own in zip(blank, noise, strict=True)]
    scans = prepare_scans(with_heights(blank, heights))
    spectrum = noise_spectrum([left_nm(scan, scan.layout_um) for scan in scans])
    # The terms of each scan absorb some of the slow noise, and four scans give only few tiles.
    assert np.sqrt(np.mean(spectrum.power_nm2)) == pytest.approx(10.0, rel=0.1)
    for sigma in ((0, 2), (2, 0)):
        change = gaussian_filter(random.normal(size=(80, 80)), sigma, mode="wrap")
        draws = [1e3 * scale * np.sum(change * rough()) for _ in range(400)]
        # The standard deviation of 400 draws is known to 3.5 %, and the spectrum to about 10 %.
        sd = math.sqrt(spectrum.variance(torch.from_numpy(change)))
        assert sd == pytest.approx(np.std(draws), rel=0.2)


@pytest.mark.parametrize("scans", [1, 2])
def test_white_noise_is_as_large_along_any_difference(scans: int, rivalry: Rivalry, limits: Limits) -> None:
    """Check that the sum of several scans of one print has more noise, because these scans share the noise of
    the print.
    """
    prints = [first_print(limits, ways=[PLAIN] * scans)]
    [found] = rivalry.contrasts(prints, {(AS_PRINTER, AS_MICROSCOPE): model({})}).values()
    # The difference is computed in single precision.
    assert found.noise_nm == pytest.approx(NOISE_NM * math.sqrt(scans), rel=1e-4)


def test_only_a_turned_scan_separates_printer_from_microscope(rivalry: Rivalry, limits: Limits) -> None:
    # In scans that are not rotated, both models are equal, except for rounding in the refit.
    assert score(rivalry, [first_print(limits, ways=[PLAIN])]) < 1e-3
    assert score(rivalry, [first_print(limits)]) > 5


def test_the_linearised_refit_comes_near_the_full_one(rivalry: Rivalry, limits: Limits) -> None:
    prints, pair = [first_print(limits)], (AS_PRINTER, AS_MICROSCOPE)
    refits = (
        rivalry.refitted(prints, rounds=1),
        rivalry.refitted(prints, rounds=6),
        {pair: rivalry.twins[AS_MICROSCOPE]},
    )
    one, full, plain = (rivalry.contrasts(prints, refitted)[pair].rms_nm for refitted in refits)
    # The refit explains much of the difference, and its first step finds nearly all of this.
    assert full < 0.9 * plain
    assert one == pytest.approx(full, rel=0.1)


def test_a_model_that_fades_to_nothing_explains_no_loss_on_slopes(rivalry: Rivalry, limits: Limits) -> None:
    """Check that the gain of each scan scales the refitted model. If it scaled the true print, it would
    explain everything.
    """
    prints = [first_print(limits, ways=[PLAIN])]
    twin = rivalry.twins[AS_PRINTER]
    slot = [name for name, _ in twin.base.named_parameters()].index("weights")
    faded = twin.at(np.where(np.arange(len(twin.vector)) == slot, 1e-5, twin.vector))
    [found] = rivalry.contrasts(prints, {(AS_PRINTER, AS_MICROSCOPE): faded}).values()
    heights = [predict(one, prints[0][0]) for one in (twin, model({}))]
    # Gain, registration, tilt and bow explain some of the loss on slopes, but less than two thirds.
    assert found.rms_nm > 1e3 * float((heights[0] - heights[1]).std()) / 3


def test_a_difference_that_rests_on_numbers_known_badly_is_no_sure_one(limits: Limits) -> None:
    """Check a question whose answer rests on the small difference between the losses along the two axes."""
    nearly_equal = {"slope-thinning": {"along_x_um": 0.2, "along_y_um": 0.18, "exponent": 2.0}}
    prints = [first_print(limits)]

    def powers(sd_um: float) -> list[float]:
        rivals = []
        for owner in ("printer", "microscope"):
            own = rival("slope-thinning", nearly_equal, owner)
            covariance = np.zeros((len(own.vector),) * 2)
            # The third number from the end is the loss along y. The exponent and the direction follow it.
            covariance[-3, -3] = sd_um**2
            rivals.append(own.model_copy(update={"covariance": covariance.tolist()}))
        asked = slope_question(rivals=rivals)
        [pair] = _pairs(Rivalry(asked, base_model(), white()), prints)
        return pair.power

    sure, unsure = powers(0.0), powers(0.02)
    count = next(n for n, power_ in enumerate(sure) if power_ > 0.99)
    # With an error of 0.02 µm, the difference of 0.02 µm may as well be zero.
    assert unsure[count] < answers.ENOUGH
    assert unsure[0] > 0.1


def test_a_small_print_can_start_from_layouts_as_coarse_as_the_prints_so_far() -> None:
    coarse = replace(Limits.of(opened([]), 0.1), cutoff_per_um=0.25)
    assert all(np.ptp(level) > 0 for level in starts(64, coarse, 0).values())


def test_layouts_of_a_single_level_have_no_structure_and_no_plan(tmp_path: Path) -> None:
    varied = blank_scans(2, 64)
    flat = [replace(scan, mask_level=np.full_like(scan.mask_level, 6)) for scan in blank_scans(2, 32)]
    assert _cutoff_per_um([*flat, *varied]) == _cutoff_per_um(varied) > 0
    assert _cutoff_per_um([*varied, *blank_scans(2, 32)]) == _cutoff_per_um(blank_scans(2, 32))
    assert _cutoff_per_um(flat) == 0
    one_level = [float(level == 6) for level in range(13)]
    for number, facts in enumerate(({"cutoff_per_um": 0.0}, {"level_share": one_level})):
        loop = closed_loop(tmp_path / str(number), [slope_question()])
        opened([slope_question()]).model_copy(update=facts).write(loop)
        with pytest.raises(InputError, match="layouts of the earlier prints, got a single level in each"):
            next_print(loop, tmp_path / "plan", prints=2, field_um=6.4, steps=1)


@pytest.mark.parametrize("finer", [1, 3, 400])
def test_finer_levels_leave_the_range_of_heights(finer: int) -> None:
    """Check prints that use the lowest and the highest of 13 levels too rarely, each divided into finer
    levels.
    """
    share = np.array([0.0005, *[0.999 / 11] * 11, 0.0005])
    fine = np.repeat(share / finer, finer).tolist()
    found = Limits.of(opened([]).model_copy(update={"level_share": fine}), 0.1)
    # The range starts inside the second level from either end, where the sum of the shares reaches 0.001.
    assert finer <= found.lowest <= finer + 0.006 * finer
    assert found.highest == 13 * finer - 1 - found.lowest


def test_layouts_climb_and_stay_printable(rivalry: Rivalry, limits: Limits) -> None:
    start, scans_of = first_layout(limits), partial(planned_scans, SHARED, ways=TWICE)
    soft = climb(rivalry, start, scans_of, limits, steps=10)
    level = assemble([soft], 0, len(soft), limits)
    assert level.dtype == np.uint8
    assert score(rivalry, [scans_of(level)]) > 1.05 * score(rivalry, [scans_of(start)])
    assert limits.lowest <= level.min()
    assert level.max() <= limits.highest
    spectrum = np.abs(np.fft.fft2(soft - soft.mean())) ** 2
    beyond = np.maximum(*np.meshgrid(*[np.abs(np.fft.fftfreq(96, 0.1))] * 2)) > limits.cutoff_per_um
    # Clipping at the outer levels adds a little power above the cutoff.
    assert spectrum[beyond].sum() < 0.1 * spectrum.sum()


def test_the_power_of_repeats_is_that_of_draws() -> None:
    random = np.random.default_rng(3)
    from scipy.stats import f

    prints, scans, count = 6, 2, 4000
    bar = f.isf(0.005, prints - 1, prints)
    low = 19 * f.ppf(0.005, prints - 1, prints)
    found = []
    for share in (0.9, 0.0):
        data = math.sqrt(share) * random.normal(size=(count, prints, 1))
        data = data + math.sqrt(1 - share) * random.normal(size=(count, prints, scans))
        between = scans * data.mean(axis=2).var(axis=1, ddof=1)
        ratio = between / data.var(axis=2, ddof=1).mean(axis=1)
        found.append(np.mean(ratio > bar) if share else np.mean(ratio < low))
    # The standard error of 4000 draws is at most 0.8 %.
    assert answers.of_repeats(prints, scans) == pytest.approx(min(found), abs=0.025)
    assert answers.of_repeats(1, 2) == answers.of_repeats(4, 1) == 0.0


# --- the plan


def test_a_plan_is_a_dataset_in_waiting_and_resumes(tmp_path: Path) -> None:
    loop = closed_loop(tmp_path / "loop", [slope_question()])
    settings = {"prints": 2, "field_um": 6.4, "steps": 2}
    told: list[str] = []

    def killed(message: str) -> None:
        told.append(message)
        if message.startswith(ends):
            raise KeyboardInterrupt

    ends: tuple[str, ...] = ("optimising tile 2",)

    with pytest.raises(KeyboardInterrupt):
        next_print(loop, tmp_path / "plan", report=killed, **settings)
    assert not (tmp_path / "plan").exists()
    told.clear()
    ends = ("0 of 2 tiles are kept",)
    with pytest.raises(KeyboardInterrupt):
        next_print(loop, tmp_path / "plan", report=killed, **{**settings, "seed": 99})
    told.clear()
    plan = next_print(loop, tmp_path / "plan", report=told.append, **settings)
    assert plan is not None
    assert "1 of 2 tiles are kept" in told[0]
    assert not any(text.startswith("optimising tile 1") for text in told)
    assert NextPrint.read(tmp_path / "plan") == plan
    middle = {"questions.csv": {"power": "", "random_power": ""}}
    require_tables_equal_record(tmp_path / "plan", NextPrint.FILE_NAME, middle)
    # The long table is in a collapsed section of the page.
    assert '<summary class="section">Scans<' in (tmp_path / "plan" / "report.html").read_text("utf-8")
    with pytest.raises(InputError, match=r"seed = 0, but now 99 is requested"):
        next_print(loop, tmp_path / "plan", **{**settings, "seed": 99})
    question = plan.questions[0]
    assert question.status == "decides"
    named = [f"if {name} fits the scans better" for name in question.rivals]
    assert [one.partition(" than ")[0] for one in question.outcomes[: len(named)]] == named
    assert question.power[0] <= question.power[1]
    assert load_card(tmp_path / "plan" / "card.toml").plan is not None
    jobs = {job.id: job for job in jobs_of_card(tmp_path / "plan" / "card.toml", first=5)}
    assert jobs["N1F2"].turned_deg == 90
    assert jobs["N1F1"].printed == jobs["N1F2"].printed != jobs["N2F1"].printed
    # A staircase has no room in 64 px.
    references = [jobs[f"N0F{n}"] for n in (1, 2, 3)]
    assert [one.use for one in references] == ["substrate", "flat", "grating"]
    assert references[-1].grating_um == 1.0
    assert (tmp_path / "plan" / "microscope.md").read_text("utf-8").count("90°") >= 2
    assert not (tmp_path / "plan-cache").exists()

    simulate(tmp_path / "fab", count=1, size_px=64, seed=4, knobs=["galvo-lag=0.2@9"])
    with pytest.raises(InputError, match="seed"):
        simulate_plan(tmp_path / "plan", tmp_path / "fab", tmp_path / "fab-2", seed=4)
    card = simulate_plan(tmp_path / "plan", tmp_path / "fab", tmp_path / "fab-2", seed=5)
    printed = load_card(card)
    assert printed.plan is not None
    assert printed.plan.dataset_sha256 == plan.dataset.sha256
    truths = [Truth.read(tmp_path / name / "truth") for name in ("fab", "fab-2")]
    assert truths[0].knobs == truths[1].knobs
    turned = np.array(next(s.scan_to_layout for s in truths[1].scans if s.id == "N1F2"))
    # The microscope rotates every scan by up to 0.6°.
    assert abs(math.degrees(math.atan2(turned[1, 0], turned[0, 0])) - 90) < 1
    rows = read_table(card.parent / "scans.csv")
    assert rows["N1F2"]["turned_deg"] == 90
    assert rows["N0F1"]["use"] == "substrate"


def test_a_plan_keeps_what_the_first_card_says(tmp_path: Path) -> None:
    write = {"slow_axis": "x", "field_um": 200.0, "surround": "substrate"}
    closed = looped(SLOPE, "slope-thinning", write=write, seen_by="confocal")
    open_ = open_questions(closed, opened([]).dataset, [])
    loop = closed_loop(tmp_path / "loop", [])
    open_.write(loop)
    next_print(loop, tmp_path / "plan", prints=2, field_um=6.4, steps=0, layouts="random")
    card = load_card(tmp_path / "plan" / "card.toml")
    assert card.write is not None
    assert card.write.model_dump() == write
    assert card.scan.instrument == "confocal"
    sheet = (tmp_path / "plan" / "printer.md").read_text("utf-8")
    assert "Write the lines along y, each line to the right of the previous one." in sheet
    open_.model_copy(update={"instrument": "sem"}).write(loop)
    with pytest.raises(InputError, match="got electron micrographs of films, wanted scans of heights"):
        next_print(loop, tmp_path / "other")


@pytest.mark.parametrize("slow_axis", ["x", "y"])
def test_written_lines_run_in_a_plan_as_in_the_loop(slow_axis: Literal["x", "y"]) -> None:
    """Check an effect of the written lines on a planned print and on the same print in the loop."""
    scan = blank_scan(0, write={"slow_axis": slow_axis})
    twin = model({"galvo-lag": get_effect("galvo-lag").trials[0]})
    [printed] = planned_scans(replace(SHARED, slow_axis=slow_axis), scan.mask_level, [PLAIN])
    planned = predict(twin, printed)
    seen = twin.height(*prepare_scans([scan]))
    assert np.abs(planned.numpy() - seen).max() < 1e-6
    other = twin.height(*prepare_scans([replace(scan, write={"slow_axis": "xy"[slow_axis == "x"]})]))
    assert np.abs(other - seen).max() > 1e-3


def test_nothing_open_and_no_questions_kept_are_said(tmp_path: Path) -> None:
    loop = closed_loop(tmp_path / "loop", [])
    assert next_print(loop, tmp_path / "plan") is None
    assert not (tmp_path / "plan").exists()
    (loop / OpenQuestions.FILE_NAME).unlink()
    with pytest.raises(InputError, match=r"open_questions\.json"):
        next_print(loop, tmp_path / "plan")


@pytest.mark.parametrize(("prints", "field_um"), [(0, 25.6), (13, 25.6), (2, 3.0)])
def test_numbers_and_sizes_of_prints_that_cannot_be_planned_are_refused(
    prints: int, field_um: float, tmp_path: Path
) -> None:
    loop = closed_loop(tmp_path / "loop", [slope_question()])
    with pytest.raises(
        InputError, match=f"got {prints} of {field_um:g} µm, wanted 1 to 12 prints with a side"
    ):
        next_print(loop, tmp_path / "plan", prints=prints, field_um=field_um)


@pytest.mark.parametrize(("levels", "steps"), [((5, 6), []), ((5, 6, 7), ["steps"])])
def test_a_staircase_needs_three_usable_levels(
    levels: Sequence[int], steps: list[str], tmp_path: Path
) -> None:
    loop = closed_loop(tmp_path / "loop", [slope_question()])
    share = [(level in levels) / len(levels) for level in range(13)]
    opened([slope_question()]).model_copy(update={"level_share": share}).write(loop)
    plan = next_print(loop, tmp_path / "plan", prints=2, field_um=30.0, steps=0, layouts="random")
    assert plan is not None
    assert plan.levels == (levels[0], levels[-1])
    assert [one.use for one in plan.scans if one.print == "0"] == ["substrate", "flat", *steps, "grating"]
    # Each reference with steps shows steps, which the noise analysis needs.
    for one in plan.scans:
        if one.use == "steps":
            layout = tifffile.imread(tmp_path / "plan" / "layouts" / f"{one.id}.tif")
            assert {*np.unique(layout[75])} >= {*levels}


def test_the_page_quotes_the_plan_for_the_measured_prints() -> None:
    plan = NextPrint.read(measured_plan.RESULTS)
    for name, text in measured_plan.texts(plan).items():
        assert published(measured_plan.PAGE, name) == text
    assert plan.run.command in measured_plan.PAGE.read_text(encoding="utf-8")


def test_the_plan_for_the_measured_prints_is_ready_and_of_their_dataset() -> None:
    plan = NextPrint.read(measured_plan.RESULTS)
    assert plan.dataset == CloseLoop.read(DOCS / "results" / "neural-lithography" / "causes").dataset
    jobs = jobs_of_card(measured_plan.RESULTS / "card.toml", first=0)
    assert [job.id for job in jobs] == [scan.id for scan in plan.scans]


# --- the second round


def second_round(
    seed: int, effects: dict[str, dict[str, float]] = SLOPE, owner: Owner | None = None
) -> list[PrintedScan]:
    """Return scans of two prints at 0° and 90°, with an effect of the printer or the microscope."""
    random = np.random.default_rng(seed)
    [name] = effects
    chain = rival(name, effects, owner).twin(model({})).chain()
    scans = []
    for number, blank in enumerate(blank_scans(12, 64)[-2:]):
        rough = gaussian_filter(random.normal(size=blank.shape), 1.0)
        for at, placed in enumerate((np.eye(3), QUARTER)):
            scan = replace(
                blank, id=f"N{number}F{at}", print_id=str(number), scan_to_layout=placed, turned_deg=90.0 * at
            )
            one = prepare_scans([scan])[0]
            with torch.no_grad():
                height = chain(one.context.layout_um, one.context)[0, 0].numpy()
            scans += with_heights([scan], [height + 0.006 * rough / rough.std()])
    return scans


def unmeasured(scan: PrintedScan) -> PrintedScan:
    """Return a scan of another print, in which almost no pixel was measured."""
    few = np.arange(scan.valid.size).reshape(scan.shape) < 1000
    return replace(scan, id="N9F1", print_id="9", valid=few)


def judge(effects: dict[str, dict[str, float]], new: Sequence[PrintedScan]) -> Judge:
    """Return a judge that knows the new scans and four scans of the first round, which have these effects."""
    first = planted([(name, ALL, {"": own}) for name, own in effects.items()], count=4, size_px=64)
    return Judge(model(effects), study_of(first), prepare_scans(new))


EARLY, LATE = (get_effect("slope-thinning").with_values({"along_x_um": size}) for size in (0.25, 0.15))


def by_order() -> list[PrintedScan]:
    """Return scans, two of each print, with a loss on slopes that is stronger in the early scans."""
    return planted([("slope-thinning", "order 5-6", {"before": EARLY, "from there on": LATE})], count=10)


@pytest.fixture
def one_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    search_little(monkeypatch, ["slope-thinning"])


@pytest.mark.slow
@pytest.mark.pictures
def test_two_stores_become_a_result_a_model_and_a_plan(
    one_cause: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Check two rounds of a loop. The strength of the effect is known to differ between groups of scans."""
    monkeypatch.setattr(base_models, "build_model", lambda *name, **facts: base_model())
    first = write_store(tmp_path / "first.zarr", by_order())
    new = second_round(5, SLOPE, "microscope")
    second = write_store(tmp_path / "second.zarr", [*new, unmeasured(new[0])])
    result = close_loop(first, tmp_path / "loop", new_prints=[second], base="affine-mtf", folds=3)
    assert CloseLoop.read(tmp_path / "loop") == result
    asked = OpenQuestions.read(tmp_path / "loop").questions
    question = next(one for one in asked if one.name == "slope-thinning")
    assert (question.kind, [one.name for one in question.rivals]) == ("role", [AS_PRINTER, AS_MICROSCOPE])
    assert question.rivals[0].effects["slope-thinning"]["along_x_um"] == pytest.approx(0.2, abs=0.06)
    # Multiples such as 0.75 and 1.25 would give a spread of half or more.
    assert question.spread < 0.2
    assert [one.left for one in result.decisions] == [[AS_MICROSCOPE]]
    assert result.run.dropped == ["N9F1: fewer than 1024 measured pixels"]
    assert [(one.name, one.role) for one in result.effects] == [("slope-thinning", "measurement")]
    card = ModelCard.read(tmp_path / "loop" / "model")
    assert list(card.measurement_effects) == ["slope-thinning"]
    assert card.attributed == {"slope-thinning": "microscope"}
    plan = next_print(tmp_path / "loop", tmp_path / "plan", prints=2, field_um=6.4, steps=1)
    assert plan is not None
    planned = next(one for one in plan.questions if one.name == "slope-thinning")
    assert planned.status == "decides"
    assert {scan.turned_deg for scan in plan.scans if scan.use == "dataset"} == {0, 90}


@pytest.mark.parametrize("owner", ["printer", "microscope"])
def test_two_turned_prints_say_whose_a_loss_on_slopes_is(owner: Owner) -> None:
    new = second_round(5, SLOPE, owner)
    decision = judge(SLOPE, new).among_rivals(slope_question())
    assert decision.verdict == "decided"
    assert decision.left == [f"slope-thinning as the {owner}'s"]


@pytest.mark.slow
@pytest.mark.parametrize("owner", ["printer", "microscope"])
def test_two_turned_prints_say_whether_an_asymmetric_tip_is_one(owner: Owner) -> None:
    """Check an asymmetric tip. In one orientation, a scan with it looks like a print with raised flanks."""
    effects = {TIP: {"radius_um": 0.6, "along": 1.0, "across": 0.25}}
    assert _owners(TIP, effects[TIP]) == ["printer", "microscope"]
    assert _owners(TIP, {**effects[TIP], "across": 1.0}) == [None]
    rivals = [rival(TIP, effects, one) for one in ("printer", "microscope")]
    question = slope_question(name=TIP, rivals=rivals)
    decision = judge(effects, second_round(5, effects, owner)).among_rivals(question)
    assert decision.verdict == "decided"
    assert decision.left == [f"{TIP} as the {owner}'s"]


def single_scans(name: str, heights_um: Callable[[PreparedScan, int], np.ndarray]) -> Decision:
    """Return the decision about a scan term from six prints, each scanned at 0° and 90°."""
    base, random = model({}), np.random.default_rng(8)
    scans = []
    for number, blank in enumerate(blank_scans(12, 64)[::2]):
        for at, placed in enumerate((np.eye(3), QUARTER)):
            scan = replace(blank, id=f"N{number}F{at}", print_id=str(number), scan_to_layout=placed)
            [one] = prepare_scans([scan])
            noise = random.normal(0, 0.004, blank.shape)
            scans += with_heights([scan], [base.height(one) + noise + heights_um(one, number)])
    judge_ = Judge(base, study_of(scans), prepare_scans(scans))
    kind = "lines" if "line" in name else "per-scan"
    question = slope_question(name=name, kind=kind, rivals=[])
    return judge_.of_lines(question) if kind == "lines" else judge_.of_single_scans(question)


@pytest.mark.parametrize("owner", [PRINTER, MICROSCOPE])
def test_turned_scans_say_whether_lines_were_written_or_scanned(owner: str) -> None:
    offsets = np.random.default_rng(9).normal(0, 0.004, 64)

    def lines(scan: PreparedScan, number: int) -> np.ndarray:
        return np.roll(offsets, number)[scan.line if owner == MICROSCOPE else row_index((64, 64))]

    assert single_scans("line-roughness", lines).left == [owner]


@pytest.mark.parametrize("owner", [PRINTER, MICROSCOPE])
def test_repeats_say_whose_a_datum_is(owner: str) -> None:
    random = np.random.default_rng(2)
    of_print = random.normal(0, 0.05, 6)

    def datum(scan: PreparedScan, number: int) -> np.ndarray:
        return np.full((64, 64), of_print[number] if owner == PRINTER else random.normal(0, 0.05))

    assert single_scans("datum-offset", datum).left == [owner]


@pytest.mark.parametrize(("share", "verdict"), [(0.005, "still open"), (0.03, "decided")])
def test_a_difference_below_one_per_cent_of_the_squared_error_decides_nothing(
    share: float, verdict: str
) -> None:
    """Check two rivals. The errors of ``b`` are those of ``a``, but larger. Errors that no rival describes
    may be equally large.
    """
    scans = prepare_scans(blank_scans(4, 64)[::2])
    random = np.random.default_rng(3)
    errors = [random.normal(0, 10, scan.usable.shape) for scan in scans]
    left = {
        name: [math.sqrt(1 + more) * error for error in errors]
        for name, more in (("a", 0.0), ("b", share), (NONE, 0.5))
    }
    decision = compared(slope_question(), scans, left)
    between = next(one for one in decision.comparisons if (one.better, one.worse) == ("a", "b"))
    assert between.z > Z_DECIDED
    assert decision.verdict == verdict


def judged(form_nm: float | None, difference_nm: float, error_nm: float) -> Decision:
    """Return the decision if ``a`` is true, but its form has an error in the direction of ``b``."""
    scans = prepare_scans(blank_scans(4, 128)[::2])
    random = np.random.default_rng(4)
    left: dict[str, list[np.ndarray]] = {"a": [], "b": [], NONE: []}
    for scan in scans:
        along = gaussian_filter(random.standard_normal(scan.usable.shape), 1.0)
        along /= along.std()
        noise = random.normal(0, 10, scan.usable.shape)
        left["a"].append(noise + error_nm * along)
        left["b"].append(noise - (difference_nm - error_nm) * along)
        left[NONE].append(noise + random.normal(0, 100, scan.usable.shape))
    return compared(slope_question(form_nm=form_nm), scans, left)


def test_an_error_of_the_form_decides_nothing_below_its_bound() -> None:
    """Check an error in the form of the true rival. It favours the wrong rival by (2 · 4.5 / 5 - 1) · 25
    nm².
    """
    assert judged(None, 5.0, 4.5).left == ["b"]
    counted = judged(4.5, 5.0, 4.5)
    assert counted.verdict == "still open"
    assert "own error is at most 4.5 nm" in counted.evidence
    between = next(one for one in counted.comparisons if (one.better, one.worse) == ("b", "a"))
    assert between.difference_nm == pytest.approx(5.0, rel=0.01)
    assert between.gain_nm2 == pytest.approx(20.0, rel=0.2)
    assert between.z == 0
    assert judged(4.5, 40.0, 4.5).left == ["a"]
    without = [[one.z for one in judged(form_nm, 5.0, 0.0).comparisons] for form_nm in (None, 0.0)]
    assert without[0] == without[1]


def test_scans_of_one_print_may_differ_in_size() -> None:
    """Check a print that was scanned in two sizes. Its scans have the noise of two prints, but the spread
    between prints is that of one print.
    """
    random = np.random.default_rng(5)
    scans = [blank_scan(number, size_px) for number, size_px in ((0, 128), (1, 96), (2, 96))]
    left = {name: [random.normal(0, sd, scan.shape) for scan in scans] for name, sd in (("a", 4), ("b", 8))}

    def z_of(prints: str, spread: float) -> float:
        own = [replace(scan, print_id=name) for scan, name in zip(scans, prints, strict=True)]
        [found] = compared(slope_question(spread=spread), prepare_scans(own), left).comparisons
        assert found.better == "a"
        return found.z

    assert z_of("111", 0.0) == pytest.approx(z_of("122", 0.0))
    assert z_of("111", 1.0) < z_of("122", 1.0) < z_of("122", 0.0)


def test_a_gain_counts_only_beyond_what_an_error_of_the_form_can_cause() -> None:
    def z_of(gain: float, sd: float, form: float | None) -> float:
        form_nm = None if form is None else math.sqrt(form)
        return surely_better(slope_question(form_nm=form_nm), gain, 30.0, sd**2, prints=1, pixels=1)

    # With no error of the form and a gain as large as the difference, the result is gain over noise.
    assert z_of(30.0, 2.0, None) == z_of(30.0, 2.0, 0.0) == 15.0
    # An error of the form may account for 2 · √(30 · 1.2) = 12 of the gain.
    assert z_of(30.0, 2.0, 1.2) == pytest.approx(9.0)
    assert z_of(30.0, 2.0, 30.0) == 0.0
    # Prints halfway between the rivals favour one of them only by noise, so the gain has to exceed half.
    assert z_of(14.0, 0.1, None) < Z_DECIDED < z_of(16.0, 0.1, None)


def test_the_power_counts_the_form_as_the_decision_does() -> None:
    pixels, difference_nm, sd = 10_000, 5.0, 5e4
    squares = pixels * difference_nm**2
    contrast = Contrast(*(torch.tensor([one], dtype=torch.float64) for one in (squares, sd)), pixels)

    def powers(form_nm: float | None) -> list[float]:
        question = slope_question(form_nm=form_nm)
        return [answers.of_contrast(contrast, question, prints) for prints in (1, 4, 100)]

    today = [norm.cdf(math.sqrt(prints) * squares / sd - Z_DECIDED) for prints in (1, 4, 100)]
    assert powers(None) == pytest.approx(today)
    assert powers(0.0) == pytest.approx(today)
    # With an error half as large as the difference, no number of prints decides, except 0.5 % by chance.
    assert max(powers(2.5)) <= 0.005 + 1e-12
    assert powers(1.0)[1] == pytest.approx(norm.cdf(2 * (1 - 2 / 5) * squares / sd - Z_DECIDED))


def test_a_question_below_the_models_own_error_is_declared_before_printing(
    rivalry: Rivalry, limits: Limits
) -> None:
    prints = [first_print(limits, 64)]

    def asked(form_nm: float | None) -> PlannedQuestion:
        question = slope_question(form_nm=form_nm)
        own = Rivalry(question, base_model(), rivalry.noise)
        return of_rivals(own, {}, prints, prints, 4)

    plain = asked(None)
    assert plain.status == "decides"
    told = asked(plain.difference_nm)
    assert told.status == "no experiment separates"
    assert told.form_nm == plain.difference_nm == told.difference_nm
    said = f"own error is at most {told.form_nm:.1f} nm, and the two rivals differ by {told.form_nm:.1f} nm"
    assert f"the model's {said}; no experiment of this plan separates them" in told.why


def test_two_names_of_one_model_end_in_one_optimum() -> None:
    """Check two fits of the same model. One of them has a start that would lead it elsewhere if it were
    fitted alone.
    """
    base = build_model(
        "physics", sigma_diffusion_init_um=0.3, alpha_init=2.0, eta_init=0.4, bias_init_um=0.03
    )
    twins = [
        Twin.bare(base).with_effect(name, ALL, {"": {"variance_um2": 0.1}})
        for name in ("diffusion-blur", "resampling-blur")
    ]
    random = np.random.default_rng(0)
    twin, blank = twins[0], blank_scans(4, 64)
    heights = [
        twin.height(scan) + 0.006 * gaussian_filter(random.normal(size=(64, 64)), 1.0) / 0.28
        for scan in prepare_scans(blank)
    ]
    windows = [scan.window for scan in prepare_scans(with_heights(blank, heights))]
    names = [name for name, _ in base.named_parameters()]
    start = twins[1].vector.copy()
    start[[names.index("raw_alpha"), names.index("raw_eta")]] = -4.0
    twins[1] = twins[1].at(start)

    def squares(twin: Twin, vector: np.ndarray) -> float:
        return sum(float(one @ one) for one in TwinProblem(twin, windows).residuals(vector))

    alone = fit_least_squares(TwinProblem(twins[1], windows), start, RULES).vector
    fits = fit_rivals(dict(zip("ab", twins, strict=True)), windows).values()
    best, other = (squares(twin, fit.vector) for twin, fit in zip(twins, fits, strict=True))
    assert squares(twins[1], alone) > 1.02 * best
    # A fit ends when a step reduces the loss by less than 0.05 %.
    assert other == pytest.approx(best, rel=1e-3)


def test_the_information_of_the_prints_is_known_for_all_their_pixels_whatever_the_sample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    name = "slope-thinning"
    scans = prepare_scans(planted([(name, ALL, {"": SLOPE[name]})], count=4))
    assert {len(scan.sample) for scan in scans} == {36 * 36}
    monkeypatch.setattr(prepared, "_SAMPLED_PX", len(scans[0].sample) // 4)
    few = prepare_scans(scans)
    known = []
    for study in (scans, few):
        own = SimpleNamespace(windows=study, scans=scans, report=lambda message: None)
        known += [np.trace(_rivals(cast(Any, own), {name: model(SLOPE)})[0].information)]
    # An evenly drawn quarter of the pixels gives a quarter of the sum, which is then scaled up.
    assert known[1] == pytest.approx(known[0], rel=0.1)


def looped(
    effects: dict[str, dict[str, float]], cause: str, alike: Sequence[str] = (), **facts: Any
) -> Closed:
    """Return a loop that named ``cause``, or one of the effects ``alike``, in scans with these effects and
    facts.
    """
    made = planted([(name, ALL, {"": own}) for name, own in effects.items()], count=8)
    bare = bare_state(study_of([replace(scan, **facts) for scan in made]))
    state = fit_state(model({cause: SLOPE.get(cause, {})}), bare.study)
    found = Cause(cause, ALL, tuple(alike), judge_states(bare, state), 0.01, None)
    screened = {name: cast(Any, SimpleNamespace(family_p=0.02)) for name in alike}
    named, lawful, described = Found(state, [found], screened), Found(state), Found(state)

    def rest(state: State) -> Any:
        return SimpleNamespace(most_nm=1.0)

    return Closed("affine-mtf", {}, bare, bare, named, lawful, described, rest, {})


def decided_for(*left: str, among: Sequence[Rival]) -> tuple[OpenQuestions, list[Decision]]:
    """Return the question among these rivals, and the decision that leaves some of them."""
    question = slope_question(kind="set", rivals=list(among))
    decision = Decision(
        question=question.name,
        kind=question.kind,
        declared=[one.name for one in among],
        left=list(left),
        verdict="decided" if len(left) == 1 else "still open",
        evidence="",
        prints=2,
        scans=4,
    )
    return opened([question]), [decision]


def test_what_is_decided_gets_its_owner_in_the_result() -> None:
    before = looped(SLOPE, "slope-thinning", ["layer-stacking"])
    rivals = slope_question().rivals
    for left, role in ((AS_PRINTER, "process"), (AS_MICROSCOPE, "measurement")):
        after = with_decisions(before, *decided_for(left, among=rivals))
        found = _found(after, after.named.causes[0], {}, 0.0)
        assert (found.role, found.verdict, found.confusable_with) == (role, "explained", [])
        assert after.final is before.final
    after = with_decisions(before, *decided_for(AS_PRINTER, AS_MICROSCOPE, among=rivals))
    assert vars(after.named.causes[0]) == vars(before.named.causes[0])


STACKING = {"layer-stacking": {"share": 0.3, "threshold": 0.5, "steepness": 6.0}}


def test_an_excluded_cause_makes_way_for_the_one_that_remains() -> None:
    """Check scans of one effect in which the loop named another. New prints decide for the true one."""
    before = looped(STACKING, "slope-thinning", ["layer-stacking", "diffusion-blur"])
    blur = {"diffusion-blur": {"variance_um2": 0.01}}
    start = {"layer-stacking": {**STACKING["layer-stacking"], "share": 0.2}}
    rivals = [rival(name, one) for one in (SLOPE, start, blur) for name in one]
    after = with_decisions(before, *decided_for("layer-stacking", among=rivals))
    assert after.final.twin.names == after.named.state.twin.names == ("layer-stacking",)
    assert before.final.twin.names == ("slope-thinning",)
    [found] = [_found(after, one, _strengths(after)[one.name], 0.0) for one in after.traced]
    assert (found.name, found.role, found.verdict) == ("layer-stacking", "process", "explained")
    assert found.confusable_with == []
    # The fitted value is that of these scans and not that of the rival.
    assert found.strengths["share"][0].value == pytest.approx(0.3, abs=0.03)
    told = {one.name: one for one in _candidates(after, [found], ())}
    assert "layer-stacking" not in told
    for name in ("slope-thinning", "diffusion-blur"):
        assert told[name].verdict == "contradicted"
        assert told[name].reason == "later prints exclude it: layer-stacking fits them better"
    # Two effects remain.
    after = with_decisions(before, *decided_for("layer-stacking", "diffusion-blur", among=rivals))
    [found] = [_found(after, one, _strengths(after)[one.name], 0.0) for one in after.traced]
    assert (found.name, found.verdict) == ("layer-stacking", "confusable")
    assert found.confusable_with == ["diffusion-blur"]
    assert after.final.twin.names == ("layer-stacking",)
    # An effect that was not confirmed before is added.
    suspects = opened([slope_question(name="a or b", kind="suspects", rivals=rivals[1:])])
    decisions = [
        one.model_copy(update={"question": "a or b"}) for one in decided_for("layer-stacking", among=[])[1]
    ]
    after = with_decisions(before, suspects, decisions)
    assert [one.name for one in after.traced] == ["slope-thinning", "layer-stacking"]
    assert set(after.final.twin.names) == {"slope-thinning", "layer-stacking"}


def test_new_prints_have_to_be_of_this_printer_and_turned_as_they_say(tmp_path: Path) -> None:
    from litho_data.store import open_store

    first = open_store(write_store(tmp_path / "first.zarr", blank_scans(2, 64)))
    turned = [replace(scan, turned_deg=None) for scan in second_round(5)]
    with pytest.raises(InputError, match=r"N0F1.*rotated by 90° on its layout, but 0° in its card"):
        new_scans(first, open_store(write_store(tmp_path / "second.zarr", turned)))
    coarser = [replace(scan, pitch_um=0.2) for scan in blank_scans(2, 64)]
    with pytest.raises(InputError, match=r"pitch_um.*0\.2.*0\.1"):
        new_scans(first, open_store(write_store(tmp_path / "coarse.zarr", coarser)))
    store = open_store(write_store(tmp_path / "foreign.zarr", blank_scans(2, 64)))
    store.__dict__["manifest"] = {"card": {"plan": {"dataset_sha256": "a" * 64}}}
    with pytest.raises(InputError, match="planned for dataset aaaaaaaaaaaa"):
        new_scans(first, store)


def test_new_scans_that_show_almost_nothing_are_left_out_and_named(tmp_path: Path) -> None:
    from litho_data.store import open_store

    first = open_store(write_store(tmp_path / "first.zarr", blank_scans(2, 64)))
    new = blank_scans(3, 64)
    store = open_store(write_store(tmp_path / "second.zarr", [*new, unmeasured(new[0])]))
    scans, left_out = new_scans(first, store)
    assert [scan.id for scan in scans] == [scan.id for scan in new]
    assert left_out == ["N9F1: fewer than 1024 measured pixels"]
    empty = open_store(write_store(tmp_path / "empty.zarr", [unmeasured(new[0])]))
    with pytest.raises(InputError, match=r"scans of .*empty\.zarr.*none that can be used"):
        new_scans(first, empty)


def test_a_question_is_put_in_words() -> None:
    names = ["diffusion-blur", "resampling-blur"]
    titles = [get_effect(name).title for name in names]
    assert _question("set", names).text == f"which effect is present: {titles[0]} or {titles[1]}"
    said = "height lost on slopes: caused by the printer or by the microscope"
    assert _question("role", ["slope-thinning"]).text == said
    assert _question("fact", ["vignetting"], text="no place").text.endswith(": no place")


def test_what_is_planted_is_drawn_before_anything_is_run_and_judged_by_its_owner() -> None:
    drawn = two_rounds.draws(24, 1)
    assert drawn == two_rounds.draws(24, 1)
    assert drawn != two_rounds.draws(24, 2)
    assert all(12 <= one["rms_nm"] <= 30 for one in drawn)
    assert {one["knob"] for one in drawn} == set(two_rounds.DEALT)
    assert [one["knob"] for one in two_rounds.draws(3, 1, ["galvo-lag", "tip-dilation"])][1:] == [
        "tip-dilation",
        "galvo-lag",
    ]
    answer = {
        "question": "slope-thinning",
        "kind": "role",
        "declared": [AS_PRINTER, AS_MICROSCOPE],
        "verdict": "decided",
        "evidence": "",
        "prints": 4,
        "scans": 8,
    }
    planned = PlannedQuestion.model_construct(power=[1.0] * 12, status="decides")
    for left, right in ((AS_PRINTER, True), (AS_MICROSCOPE, False)):
        decision = Decision.model_validate({**answer, "left": [left]})
        told = two_rounds.judged(decision, planned, "slope-thinning-x")
        assert told["counts"]
        assert told["right"] is right
        assert told["wrong"] is not right
    # If the question is a name, a name that was not planted is wrong. Its role is neither right nor wrong.
    other = Decision.model_validate({**answer, "declared": ["a", "b"], "left": ["a"]})
    for kind, wrong in (("set", True), ("suspects", True), ("role", False)):
        told = two_rounds.judged(other.model_copy(update={"kind": kind}), planned, "slope-thinning-x")
        assert not told["counts"]
        assert told["wrong"] is wrong


def test_a_trial_of_another_size_or_with_other_layouts_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(draw: dict[str, Any], _folder: Path, *made_with: Any) -> dict[str, Any]:
        size_px, arms, _ = made_with
        return {**draw, "size_px": size_px, "answers": {arm: [] for arm in arms}}

    monkeypatch.setattr(two_rounds, "run_trial", run)
    for size, arms in ((96, ["optimised"]), (96, ["optimised", "random"]), (192, ["optimised", "random"])):
        words = ["--out", str(tmp_path), "--trials", "2", "--size", str(size), "--arms", *arms]
        monkeypatch.setattr("sys.argv", ["two_rounds", *words])
        two_rounds.main()
        trials = json.loads((tmp_path / "20271.json").read_text())["trials"]
        assert [(one["size_px"], [*one["answers"]]) for one in trials] == [(size, arms)] * 2


def test_the_page_quotes_a_board_of_two_rounds() -> None:
    board = json.loads((two_rounds.RESULTS / "20273.json").read_text("utf-8"))
    assert published(two_rounds.PAGE, "two-rounds-20273") == two_rounds.summary(board["trials"])


def test_a_plan_is_printed_by_the_same_machine_with_new_chance() -> None:
    """Check that new prints have the same knobs but different roughness. Scans of one print share the
    roughness.
    """
    level = np.full((40, 40), 6, np.uint8)
    fab = Fab(
        Printer(), Microscope.aligned(), Noise(), KnobBoard([KnobSetting("tip-dilation", 0.5, 3)], 9), 9
    )
    first = scan_job(fab, Job("N1F1", level, index=12, print_index=12))
    again = scan_job(fab, Job("N1F2", level, index=13, print_index=12))
    other = scan_job(fab, Job("N2F1", level, index=14, print_index=14))

    def agreement(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])

    # The roughness is 15.9 nm, and line and pixel noise 1 nm. Two prints correlate only by chance.
    assert agreement(first.height_um, again.height_um) > 0.98
    assert abs(agreement(first.height_um, other.height_um)) < 0.6
    sharp = scan_job(fab, Job("N1F3", level, index=13, print_index=12, tip=2.0))
    assert not np.array_equal(again.height_um, sharp.height_um)
