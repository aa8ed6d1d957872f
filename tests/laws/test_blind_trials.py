"""Test the draws, sizes and judgements of blind trials, interrupted campaigns, and whole trials."""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import curve_fit

from benchmarks.blind_trials import __main__ as trials
from benchmarks.blind_trials import campaign
from benchmarks.blind_trials.__main__ import PAGE, RESULTS, main
from benchmarks.blind_trials.measured import inject, measured_jobs, middle
from benchmarks.blind_trials.publishing import as_markdown, mark_of, publish_scoreboard
from benchmarks.blind_trials.trial import run_trial, trial_folder
from benchmarks.record import published
from litho_data.foundation.errors import InputError
from litho_data.sharing.workers import Workers
from litho_data.store import PrintedScan, open_store
from litho_data.virtual_fab import (
    KNOBS,
    Fab,
    Job,
    KnobSetting,
    Microscope,
    Noise,
    Printer,
    scan_job,
    simulate,
)
from litho_data.virtual_fab.knobs import KnobBoard
from litho_models.boards.board import make_draws
from litho_models.boards.draws import (
    BASE_RMS_NM,
    GROUPED,
    LINEAR,
    MIXTURES,
    MIXTURES_RMS_NM,
    S_SHAPED,
    SINGLES,
    SINGLES_RMS_NM,
    draw_board,
    names_of,
)
from litho_models.boards.figures import figures_of, make_scoreboard, share, trial_table
from litho_models.boards.judging import bias_of, failed, false_names, judge, true_floor
from litho_models.boards.other_forms import FORMS, FormCause
from litho_models.boards.own_loop import answer_of
from litho_models.boards.planting import (
    fab_of,
    noise_free_um,
    plant,
    printer_of,
    refitted_rms_nm,
    share_of,
    trial_jobs,
    write_raw,
)
from litho_models.boards.records import (
    Answer,
    CauseDraw,
    Draw,
    Draws,
    Kind,
    Outcome,
    Planted,
    Scoreboard,
    Trial,
    TrialErrors,
)
from litho_models.loop.record import Candidate, CloseLoop, Explained, FoundEffect, ScanFinding, Strength
from litho_models.scan_terms import POLICIES, TermPixels, least_squares, term_maps
from litho_models.scan_terms.measurement import MeasurementModel, SharedPart
from tests.litho_models.prints import make_scans, write_store
from tests.test_architecture import _module_graph, _reached

EARLIER = pd.read_csv(RESULTS / "earlier.csv", keep_default_na=False)


# Drawing boards


def test_singles_follow_from_their_seed_and_have_what_was_promised():
    draws = draw_board("singles", 5)
    assert draws == draw_board("singles", 5) != draw_board("singles", 6)
    assert Counter(draw.kind for draw in draws) == SINGLES
    assert all(len(draw.causes) == (draw.kind != "empty") for draw in draws)
    rms_nm = np.array([cause.wanted_rms_nm for draw in draws for cause in draw.causes])
    # Every drawn cause must be larger than 8 nm to count, also after the error of the search on four scans.
    assert SINGLES_RMS_NM[0] <= rms_nm.min() <= rms_nm.max() <= SINGLES_RMS_NM[1]
    assert 0.87 * SINGLES_RMS_NM[0] > 8
    assert len({tuple(draw.printer.items()) for draw in draws}) == 48
    names = {kind: [c.name for d in draws if d.kind == kind for c in d.causes] for kind in SINGLES}
    assert all(len(set(dealt)) == len(dealt) for dealt in names.values())
    assert all(FORMS[name].deck == "both" for name in names["other-form"])
    assert all(names_of(name) for name in names["in-form"] + names["alias"])
    assert {KNOBS[name].refit_absorbs or KNOBS[name].nuisance_span for name in names["alias"]} == {True}


@pytest.mark.parametrize("seed", range(20267, 20271))
def test_the_published_boards_are_drawn_as_they_were(seed):
    """Check that drawing a board of single causes again gives the published draws."""
    was = EARLIER[EARLIER.board == seed]
    drawn = draw_board("singles", seed)
    assert [draw.seed for draw in drawn] == was.seed.tolist()
    assert [draw.causes[0].name if draw.causes else "" for draw in drawn] == was.cause.tolist()


@pytest.mark.parametrize("seed", range(4))
def test_mixtures_have_what_was_promised(seed):
    draws = draw_board("mixtures", seed)
    assert draws == draw_board("mixtures", seed) != draw_board("mixtures", seed + 1)
    assert Counter(draw.kind for draw in draws) == MIXTURES
    # A fifth of the trials have no cause.
    assert len(draws) >= 40
    assert 0.18 < MIXTURES["empty"] / len(draws) < 0.22
    causes = [cause for draw in draws for cause in draw.causes]
    assert {len(draw.causes) for draw in draws} == {0, 2, 3, 4}
    assert {one.wanted_rms_nm >= MIXTURES_RMS_NM[0] for one in causes} == {True}
    assert max(one.wanted_rms_nm for one in causes) <= MIXTURES_RMS_NM[1]
    assert 0.4 < sum(one.name in FORMS for one in causes) / len(causes) < 0.65
    linear = [one for one in causes if one.name == "linear-slope-loss"]
    s_shaped = [one for one in causes if one.name == "s-shaped-axis"]
    assert [one.by for one in linear] == ["batch"] * LINEAR
    assert [(one.by, len(one.place), one.weak) for one in s_shaped] == [("field", 2, 0.0)] * S_SHAPED
    assert sum(one.by != "all" for one in causes) == LINEAR + S_SHAPED + GROUPED
    bases = [draw.base for draw in draws if draw.base]
    assert Counter(one.name for one in bases) == {n: 3 for n in FORMS if FORMS[n].deck == "base"}
    assert all(BASE_RMS_NM[0] <= one.wanted_rms_nm <= BASE_RMS_NM[1] for one in bases)
    for draw in draws:
        # The judge could not tell apart two causes with the same name.
        names = [
            name for one in [*draw.causes, *([draw.base] if draw.base else [])] for name in names_of(one.name)
        ]
        assert len(set(names)) == len(names)


def test_the_published_list_names_all_forms():
    listed = pd.read_csv(RESULTS / "forms.csv")
    assert listed.to_numpy().tolist() == [[form.name, form.meaning] for form in FORMS.values()]


def test_the_drawing_reads_no_catalogue():
    """Check that drawing and sizing a board imports no effects and no loop, not even in functions."""
    graph = _module_graph("litho_models")
    # Importing a module also runs the packages that contain it.
    graph = {name: imported | ({name.rpartition(".")[0]} & graph.keys()) for name, imported in graph.items()}
    for name in ("draws", "planting"):
        reached = _reached(graph, f"litho_models.boards.{name}")
        assert "litho_models.boards.records" in reached
        assert not [one for one in reached if one.startswith(("litho_models.effects", "litho_models.loop"))]


# Sizes of causes


def drawn(*causes: CauseDraw, kind: Kind = "mixture", **settings: object) -> Draw:
    return Draw(number=0, kind=kind, seed=4, causes=list(causes), **settings)


def cause(name: str, rms_nm: float = 12.0, **groups: object) -> CauseDraw:
    return CauseDraw(name=name, wanted_rms_nm=rms_nm, **groups)


def set_to(one: CauseDraw, strength: float = 1.0, rms_nm: float | None = None) -> Planted:
    return Planted(
        draw=one,
        names=[*names_of(one.name)],
        strength=strength,
        unit="1",
        at_limit=False,
        rms_nm=one.wanted_rms_nm if rms_nm is None else rms_nm,
    )


def test_raw_files_are_those_that_the_fab_writes(tmp_path):
    draw = drawn(cause("galvo-lag"))
    jobs, planted = trial_jobs(draw, 2, 64), [set_to(draw.causes[0], 0.4)]
    card = write_raw(draw, planted, jobs, tmp_path / "own")
    by_fab = simulate(
        tmp_path / "fab",
        jobs=jobs,
        seed=draw.seed,
        knobs=[KnobSetting("galvo-lag", 0.4, draw.seed)],
    )
    for folder in ("layouts", "scans"):
        for file in (by_fab.parent / folder).iterdir():
            assert (card.parent / file.relative_to(by_fab.parent)).read_bytes() == file.read_bytes()


def test_a_strength_by_batch_or_field_is_the_cause_alone_at_that_strength():
    by_batch, by_field = (
        cause("galvo-lag", by="batch", place="0.0", weak=0.5),
        cause("s-shaped-axis", by="field", place="24", weak=0.0),
    )
    draw = drawn(by_batch, by_field)
    jobs = trial_jobs(draw, 4, 64)
    assert [share_of(by_batch, job) for job in jobs] == [1.0, 1.0, 0.5, 0.5]
    assert [share_of(by_field, job) for job in jobs] == [0.0, 1.0, 0.0, 1.0]
    together = noise_free_um(draw, [set_to(by_batch, 0.4), set_to(by_field, 0.5)], jobs)
    for at, lag, axis in ((0, 0.4, 0.0), (1, 0.4, 0.5), (2, 0.2, 0.0), (3, 0.2, 0.5)):
        alone = [set_to(cause("galvo-lag"), lag), set_to(cause("s-shaped-axis"), axis)]
        np.testing.assert_array_equal(together[at], noise_free_um(draw, alone, [jobs[at]])[0])


@pytest.mark.parametrize("shape", [(64, 96), (96, 64)])
def test_a_noise_free_scan_of_a_long_field_is_its_print(shape):
    draw = drawn()
    level = np.random.default_rng(0).integers(0, 13, shape).astype(np.uint8)
    job = Job(id="P11", level=level, index=0, order=0.0)
    printed_um = scan_job(fab_of(draw, [], job), job).clean_um
    np.testing.assert_allclose(noise_free_um(draw, [], [job])[0], printed_um, atol=1e-6)


@pytest.mark.parametrize("name", sorted(FORMS))
def test_a_form_does_nothing_at_strength_zero_and_the_same_twice(name):
    draw = drawn(cause(name))
    jobs = trial_jobs(draw, 2, 64)
    plain = noise_free_um(draw, [], jobs)
    for strength, differs in ((0.0, False), (0.3 * FORMS[name].limit, True)):
        once, again = (noise_free_um(draw, [set_to(cause(name), strength)], jobs) for _ in range(2))
        np.testing.assert_array_equal(once, again)
        # Every cause that starts at some field acts on the field that is printed last.
        assert np.array_equal(once[-1], plain[-1]) != differs


def test_a_full_hill_response_replaces_the_logistic():
    """Check that, without shrinkage and base layer, the print follows a Hill curve of the dose."""
    draw = drawn(printer={"loose_retention": 1.0, "base_um": 0.0})
    (job,) = trial_jobs(draw, 1, 64)
    fab = fab_of(draw, [], job, noise=Noise.off(), microscope=Microscope.aligned())
    # At steepness 1e-4 the logistic is linear to 1e-5, so the print is proportional to the dose.
    straight = replace(fab, printer=replace(fab.printer, threshold_steepness=1e-4))
    dose = scan_job(straight, job).clean_um / fab.printer.full_height_um
    hill = scan_job(replace(fab, cause=FormCause({"hill-response": 1.0}, 9)), job)
    conversion = hill.clean_um / fab.printer.full_height_um
    inner = (dose > 0.1) & (dose < 0.9)

    def curve(at: np.ndarray, exponent: float, half: float) -> np.ndarray:
        return at**exponent * (1 + half**exponent) / (at**exponent + half**exponent)

    found, _ = curve_fit(curve, dose[inner], conversion[inner], [2.0, 0.5])
    np.testing.assert_allclose(conversion[inner], curve(dose[inner], *found), atol=1e-4)
    assert 1.5 < found[0] < 2.5
    assert 0.4 < found[1] < 0.7


@pytest.mark.parametrize(
    "name",
    [
        "periodic-lines",
        *(pytest.param(n, marks=pytest.mark.long) for n in ("cubic-slope-loss", "fringes", "seam-in-height")),
    ],
)
def test_a_planted_form_has_the_size_that_it_claims(name):
    """Check the size of a planted form. It is the residual that the plain fab and the scan terms cannot
    explain.
    """
    # A short reach of the polymer network saves time.
    draw = drawn(cause(name, 9.0), printer={"network_reach_um": 0.3})
    jobs = trial_jobs(draw, 2, 96)
    (planted,) = plant(draw, jobs, "physics")
    # The strength was searched to 3 % on these two fields.
    assert planted.at_limit or planted.rms_nm == pytest.approx(9.0, rel=0.031)
    pairs = zip(noise_free_um(draw, [planted], jobs), noise_free_um(draw, [], jobs), strict=True)
    squares = []
    for height, plain in pairs:
        basis = term_maps(TermPixels(plain), POLICIES["full"] | {"warp"})
        change = (height - plain).ravel()
        squares.append(np.mean((change - least_squares(basis, change) @ basis) ** 2))
    # A refit of the base can only explain more. Only one of the two sizes uses all pixels, so allow 5 %.
    assert 8.0 < planted.rms_nm < 1.05e3 * np.sqrt(np.mean(squares))


@pytest.mark.long
def test_what_the_base_can_imitate_does_not_count():
    """Check that Physics fits a plain fab with other parameters exactly, from any starting point."""
    other = {"threshold_steepness": 2.2, "loose_retention": 0.45, "network_reach_um": 1.6}
    draw = drawn(printer=other)
    jobs = trial_jobs(draw, 4, 96)
    heights = [1.02 * height + 0.03 for height in noise_free_um(draw, [], jobs)]
    # The heights change by more than 25 nm. Of this, kernels truncated at 4 σ leave 0.001 nm.
    assert refitted_rms_nm(heights, jobs, Printer()) < 0.01
    assert refitted_rms_nm(heights, jobs, printer_of(draw)) < 0.01


@pytest.mark.long
def test_what_any_base_model_of_the_loop_can_imitate_does_not_count():
    """Check that a cause is as large as the best of the loop's base models leaves it."""
    blurred = drawn(cause("diffusion-blur"))
    jobs = trial_jobs(blurred, 4, 96)
    heights = noise_free_um(blurred, [set_to(blurred.causes[0], 0.3)], jobs)
    # The blur changes the scans by 14 nm, but a wider spot looks nearly the same. With a given spot, 3 nm
    # remain.
    assert refitted_rms_nm(heights, jobs, Printer()) < 1.0
    started_low = drawn(cause("interface-offset"))
    heights = noise_free_um(started_low, [set_to(started_low.causes[0], 0.5)], jobs)
    # A free curve of the height loses the same depth everywhere; the Physics model has no such curve.
    assert refitted_rms_nm(heights, jobs, Printer(), "auto") < 0.5 * refitted_rms_nm(heights, jobs, Printer())


def test_a_cause_with_weak_scans_is_sized_on_strong_scans_too():
    draw = drawn(cause("vignetting", 9.0, by="field", place="2", weak=0.0), printer={"network_reach_um": 0.3})
    (planted,) = plant(draw, trial_jobs(draw, 12, 96), "physics")
    # Three of the twelve scans are strong. The strength is searched on one of them and on three weak ones.
    # The layouts differ, so the strong scans are not changed equally.
    assert not planted.at_limit
    assert planted.rms_nm == pytest.approx(9.0, rel=0.5)


@pytest.mark.long
@pytest.mark.parametrize(("name", "kind"), [("dose-exponent", "alias"), ("diffusion-blur", "mixture")])
def test_an_alias_is_planted_at_the_drawn_size_and_hardly_any_of_it_counts(name, kind):
    draw = drawn(cause(name), kind=kind)
    (planted,) = plant(draw, trial_jobs(draw, 4, 96), "physics")
    assert not planted.at_limit
    # A refit of the Physics model leaves 6 % of either.
    assert planted.rms_nm < 0.2 * 12.0


def test_a_cause_acts_on_the_print_and_on_the_scan_at_its_own_stage():
    (job,) = trial_jobs(drawn(), 1, 64)
    fab = Fab(Printer(), Microscope.aligned(), Noise.off(), KnobBoard((), 0), 0)
    plain = scan_job(fab, job)
    for name, on_print in (("far-copy", True), ("cubic-slope-loss", True), ("periodic-lines", False)):
        found = scan_job(replace(fab, cause=FormCause({name: 0.5 * FORMS[name].limit}, 1)), job)
        assert np.array_equal(found.clean_um, plain.clean_um) != on_print
        assert not np.array_equal(found.noiseless_um, plain.noiseless_um)


LEVELS = {name: getattr(Printer, name) for name in ("levels", "level_height_um", "pitch_um")}


def test_what_is_injected_into_a_store_is_what_the_fab_makes_of_its_layouts(tmp_path):
    store = open_store(write_store(tmp_path / "made.zarr", [replace(s, **LEVELS) for s in make_scans(2)]))
    draw = drawn(cause("seam-in-height"), kind="measured")
    planted, jobs = [set_to(draw.causes[0], 50.0)], measured_jobs(store)
    inject(store, tmp_path / "injected.zarr", draw, planted, jobs)
    changed = open_store(tmp_path / "injected.zarr")
    for job in jobs:
        step_nm = 1e3 * (changed.scan(job.id).height_um - store.scan(job.id).height_um)
        # Each height changes by zero or by the whole step, up to float32 rounding at heights of some µm.
        sides = np.unique(np.round(step_nm[np.isfinite(step_nm)], 2))
        np.testing.assert_allclose(sides, [0.0, 50.0], atol=0.02)
    assert [job.level.shape for job in middle(jobs, 32)] == [(32, 32)] * 2


# Judging


def found(
    name: str,
    *others: str,
    knowledge: str = "cause",
    by: str = "all",
    exponent: tuple[float, float] | None = None,
) -> FoundEffect:
    strengths = {}
    if exponent:
        strengths = {"exponent": [Strength(label="", value=np.mean(exponent), unit="1", ci95=exponent)]}
    return FoundEffect.model_construct(
        name=name, knowledge=knowledge, by=by, strengths=strengths, confusable_with=list(others)
    )


def said(
    *effects: FoundEffect,
    verdict: str = "traced",
    matters: bool = False,
    parts: Sequence[SharedPart] = (),
    seen: Sequence[str] = (),
    **more: str,
) -> Answer:
    """Return the result of a loop. ``seen`` lists its findings in single scans; ``more`` gives its verdicts.

    The keywords in ``more`` are the names of candidates, with _ in place of -.
    """
    result = CloseLoop.model_construct(
        base_model="",
        errors=[],
        effects=list(effects),
        candidates=[
            Candidate.model_construct(name=name.replace("_", "-"), verdict=own) for name, own in more.items()
        ],
        single_scans=[ScanFinding.model_construct(name=name, seen=True, confusable_with=[]) for name in seen],
        explained=[
            Explained(stage="base", squared_error_nm2=300, explained_nm2=90, matters=True),
            Explained(stage="all", squared_error_nm2=200, explained_nm2=9, matters=matters),
        ],
        measurement=MeasurementModel(levelling="none", parts=list(parts), field_um=(9, 9), scans=4),
        verdict=verdict,
    )
    return answer_of(result)


SHARED, THINNING = ["noticed", "set-contains-it"], ["slope-thinning"]
LAW, TABLE = found("height-power-2", knowledge="law"), found("level-table", knowledge="description")


@pytest.mark.parametrize(
    ("names", "result", "wanted", "false"),
    [
        (["vignetting"], said(found("vignetting")), ["right"], []),
        (["vignetting"], said(found("galvo-lag", "vignetting")), ["set-contains-it"], []),
        (["vignetting"], said(found("galvo-lag", "feedback-lag")), ["noticed"], ["galvo-lag | feedback-lag"]),
        (["vignetting"], said(verdict="nothing-missing"), ["missed"], []),
        (["vignetting"], said(verdict="unexplained"), ["noticed"], []),
        (["vignetting"], said(verdict="nothing-missing", matters=True), ["noticed"], []),
        (["quantisation"], said(seen=["quantisation"]), ["right"], []),
        (["far-copy"], said(TABLE), ["noticed"], []),
        # The largest cause is judged first. A law or a set counts for one cause only.
        (["vignetting", "far-copy"], said(LAW), ["noticed", "lawful"], []),
        (["vignetting", "far-copy"], said(found("vignetting"), LAW), ["right", "lawful"], []),
        (["galvo-lag", "tip-dilation"], said(found("galvo-lag", "tip-dilation")), SHARED, []),
        (["linear-slope-loss"], said(found("line-shortening")), ["right"], []),
        (["linear-slope-loss"], said(found("slope-thinning", exponent=(1.1, 1.3))), ["right"], []),
        (["cubic-slope-loss"], said(found("slope-thinning", exponent=(2.8, 3.1))), ["right"], []),
        (["cubic-slope-loss"], said(found("slope-thinning", exponent=(1.9, 2.1))), ["noticed"], THINNING),
        (["cubic-slope-loss"], said(found("slope-thinning")), ["noticed"], THINNING),
        ([], said(verdict="nothing-missing"), ["clean"], []),
        ([], said(TABLE), ["false-positive"], []),
        # The fab's default noise contains line offsets, but no rounding.
        ([], said(verdict="nothing-missing", seen=["scan-line-stripes"]), ["clean"], []),
        ([], said(verdict="nothing-missing", seen=["quantisation"]), ["false-positive"], ["quantisation"]),
        (["periodic-lines"], said(verdict="nothing-missing", seen=["scan-line-stripes"]), ["noticed"], []),
        ([], said(verdict="nothing-missing", matters=True), ["false-positive"], []),
        ([], said(found("vignetting")), ["false-positive"], ["vignetting"]),
    ],
)  # fmt: skip
def test_judgements(names, result, wanted, false):
    draw = drawn(*(cause(name, 10.0 + at) for at, name in enumerate(names)))
    planted = [set_to(one) for one in draw.causes]
    assert [one.verdict for one in judge(draw, planted, result, [], [])] == wanted
    assert false_names(planted, result) == false


def test_the_form_of_a_base_is_not_to_be_found_and_its_names_are_not_false():
    base = cause("two-part-spot")
    draw, planted = drawn(base=base), [set_to(base)]
    result = said(found("long-range-proximity", "diffusion-blur"), found("vignetting"))
    assert false_names(planted, result) == ["vignetting"]
    assert [one.name for one in judge(draw, planted, result, [], [])] == ["none"]


def test_absorbed_is_right_for_an_alias_that_a_refit_takes_up():
    draw = drawn(cause("dose-exponent"), kind="alias")
    for rms_nm, wanted in ((2.0, "absorbed"), (9.0, "missed")):
        planted = [set_to(draw.causes[0], rms_nm=rms_nm)]
        (outcome,) = judge(draw, planted, said(verdict="nothing-missing", dose_exponent="absorbed"), [], [])
        assert outcome.verdict == wanted


@pytest.mark.parametrize(
    ("what", "by", "wanted"),
    [
        ("shift-x", "character 4", "right"),
        ("shift-x", "character 2", "missed"),
        ("shift-x", "all", "missed"),
        ("shift-y", "character 4", "missed"),
    ],
)
def test_a_shared_displacement_is_right_if_its_groups_are_those_of_the_axis(what, by, wanted):
    one = cause("s-shaped-axis", by="field", place="24", weak=0.0)
    draw = drawn(one)
    jobs = trial_jobs(draw, 8, 64)
    scans = [
        PrintedScan(j.id, "", j.index, j.level, j.level, j.level > 0, 0.1, 0.1, 13, np.eye(3)) for j in jobs
    ]
    part = SharedPart(what=what, by=by, degree=3, shrinking=1.0, coefficients={"2": [0.1]})
    result = said(verdict="nothing-missing", parts=[part])
    assert judge(draw, [set_to(one)], result, jobs, scans)[0].verdict == wanted


def test_the_true_models_leave_the_noise_and_nothing_else():
    draw = drawn(cause("galvo-lag", by="field", place="13", weak=0.5))
    jobs, planted = trial_jobs(draw, 2, 96), [set_to(draw.causes[0], 0.4)]
    heights = []
    for job in jobs:
        fab = fab_of(draw, planted, job, noise=Noise(roughness_nm=0, line_nm=0, pixel_nm=5, datum_nm=30))
        made = scan_job(fab, job)
        heights.append((job, made))
    scans = []
    for job, made in heights:
        shape, pitch_um = made.height_um.shape, made.frame.pitch_um
        scans.append(
            SimpleNamespace(
                id=job.id, shape=shape, scan_to_layout=np.eye(3), pitch_um=pitch_um, bend_um=None,
                seen_by="afm",
                height_um=made.height_um.astype(np.float32), usable=np.ones(shape, bool),
            )
        )  # fmt: skip
    # The noise is normal with sd 5 nm. Over 2 × 10⁴ pixels its mean absolute value is known to 0.6 %.
    assert true_floor(draw, planted, jobs, scans, 0) == pytest.approx(5 * np.sqrt(2 / np.pi), rel=0.02)
    # If the cause acts on the wrong scans, the error grows.
    swapped = [set_to(cause("galvo-lag", by="field", place="24", weak=0.5), 0.4)]
    assert true_floor(draw, swapped, jobs, scans, 0) > 6


def test_the_bias_is_that_of_the_base_and_only_where_it_can_be_right():
    draw = drawn(cause("vignetting"), printer={"threshold_dose": 0.25})
    own = {"eta": 0.25, "kappa_min": 0.35, "sigma_diffusion_um": 2.0, "bias_um": 0.14, "spot_um": 0.2}
    # A logistic of steepness 1.6 equals a tanh of steepness 0.8. The fab has no gain.
    true = {"alpha": 0.8, "gain": 1.0, **own}
    answer = Answer(
        base_values={name: 1.3 * own for name, own in true.items()},
        corrected_values={name: 0.9 * own for name, own in true.items()},
    )
    # The model keeps its values in float32.
    assert bias_of(draw, answer) == pytest.approx((0.3, 0.1), rel=1e-5)
    assert bias_of(draw.model_copy(update={"base": cause("hill-response")}), answer) is None
    assert bias_of(draw, Answer()) is None


# Scoreboard


def finished_trial(draw: Draw, *verdicts: str, after_nm: float = 12.0, **more: object) -> Trial:
    names = [one.name for one in draw.causes] or ["none"]
    return Trial(
        draw=draw,
        planted=[set_to(one) for one in draw.causes],
        outcomes=[Outcome(name=n, verdict=v) for n, v in zip(names, verdicts, strict=True)],
        errors=TrialErrors(before_nm=20, after_nm=after_nm, floor_nm=12),
        **more,
    )


def board_of_mixtures() -> tuple[Draws, list[Trial]]:
    linear = cause("linear-slope-loss", by="batch", place="0.0", weak=0.5)
    draws = [
        drawn(cause("vignetting"), cause("far-copy")),
        drawn(linear, cause("galvo-lag", 7.0)),
        drawn(cause("tip-dilation"), cause("fringes")),
        drawn(kind="empty"),
        drawn(cause("crowding"), kind="measured"),
    ]
    draws = [draw.model_copy(update={"number": number}) for number, draw in enumerate(draws)]
    trials = [
        finished_trial(draws[0], "right", "lawful", after_nm=12 * 1.14, bias=(0.3, 0.1)),
        finished_trial(
            draws[1], "set-contains-it", "missed", after_nm=12 * 1.16, false_names=["z"], bias=(0.2, 0.1)
        ),
        failed(draws[2], "boom | and\nmore"),
        finished_trial(draws[3], "clean"),
        finished_trial(draws[4], "noticed", false_names=["theirs"]),
    ]  # fmt: skip
    board = {"board": "mixtures", "seed": 0, "n_scans": 12, "size_px": 256, "base": "auto"}
    return Draws(**board, trials=draws), trials


def test_the_figures_count_failures_as_not_found_and_leave_out_small_causes():
    draws, trials = board_of_mixtures()
    values = [figure.value for figure in figures_of(make_scoreboard(draws, trials, ""))]
    assert [value.split(" (")[0] for value in values] == [
        "1 of 2",  # in the catalogue: vignetting is found, tip-dilation is not, and galvo-lag is too small
        "2 of 3",  # in another form: far-copy (by a law) and linear-slope-loss are found, but fringes is not
        "3 of 5",
        "3 of 5",
        "1 of 1",
        "none of 0",
        "1 of 4",  # false names, except those on the measured prints
        "1 of 3",
        "0 of 1",
        "1 of 1",
        "1",
        # The ratios are 1/3 and 1/2.
        "25.0 %, 10.0 %; 0.42",
    ]


def test_intervals_are_exact():
    # The upper limit by Clopper and Pearson for 0 of n is 1 − 0.025^(1/n).
    assert share([False] * 8) == f"0 of 8 (0–{100 * (1 - 0.025 ** (1 / 8)):.0f} %)"
    assert share([True] * 21) == f"21 of 21 ({100 * 0.025 ** (1 / 21):.0f}–100 %)"


def test_the_scoreboard_survives_its_file_and_its_page_says_what_it_says(tmp_path):
    draws, trials = board_of_mixtures()
    scoreboard = make_scoreboard(draws, trials, "make it again")
    scoreboard.write(tmp_path)
    assert Scoreboard.read(tmp_path) == scoreboard
    other = scoreboard.model_copy(update={"seed": 7})
    page = tmp_path / "page.md"
    page.write_text(page_of(scoreboard, "old") + page_of(other, "another board"), encoding="utf-8")
    publish_scoreboard(page, scoreboard)
    assert published(page, mark_of(scoreboard)) == as_markdown(scoreboard)
    assert published(page, mark_of(other)) == "another board"
    assert page.read_text(encoding="utf-8").startswith("top\n")
    assert page.read_text(encoding="utf-8").endswith("\nbottom\n")
    table = trial_table(scoreboard)
    assert table.name.tolist()[:4] == ["vignetting", "far-copy", "linear-slope-loss", "galvo-lag"]
    assert len(table) == 8
    with pytest.raises(InputError, match="pending"):
        publish_scoreboard(page, make_scoreboard(draws, trials[:-1], ""))


def page_of(scoreboard: Scoreboard, text: str) -> str:
    mark = mark_of(scoreboard)
    return f"top\n<!-- {mark}: written by the benchmark -->\n{text}\n<!-- end of {mark} -->\nbottom\n"


def test_the_published_table_is_the_committed_scoreboard():
    for file in RESULTS.glob("*/scoreboard.json"):
        scoreboard = Scoreboard.read(file)
        assert published(PAGE, mark_of(scoreboard)) == as_markdown(scoreboard)
        assert scoreboard.trials
    text = PAGE.read_text(encoding="utf-8")
    table = text.split("<!-- earlier boards -->")[1].split("<!-- end of earlier boards -->")[0].strip()
    assert table.splitlines()[2:] == [earlier_row(seed, own) for seed, own in EARLIER.groupby("board")]
    assert len(text.encode()) <= 10_000


def earlier_row(seed: int, rows: pd.DataFrame) -> str:
    """Return the row of an earlier board. It is computed by the rules of that board.

    These rules required a final error of at most 1.05 times the floor. For other forms, the limit was 1.3
    times the floor.
    """
    other, empty = ("other-form", "off-catalogue"), ("empty", "none")
    large = rows[pd.to_numeric(rows.rms_nm, errors="coerce") > 8]
    in_form, unnamed = large[~large.kind.isin(other)], large[large.kind.isin(other)]
    trials = rows.drop_duplicates("trial")
    ratio = trials.after_nm.astype(float) / trials.floor_nm.astype(float)
    cells = [
        in_form.outcome.isin(["right", "set-contains-it"]),
        unnamed.outcome == "named-a-cause",
        unnamed.outcome.isin(["traced-to-covariate", "partial", "unexplained"]),
        rows[rows.kind.isin(empty)].outcome == "clean",
        ratio <= np.where(trials.kind.isin(other), 1.3, 1.05),
    ]
    return f"| {seed} | {' | '.join(share(cell.tolist()) for cell in cells)} |"


# Interrupted campaigns


def small_board(**changes: object) -> Draws:
    settings = {"board": "singles", "seed": 0, "n_scans": 12, "size_px": 64, "base": "physics"}
    return make_draws(**(settings | changes))


def test_a_campaign_records_a_dying_trial_and_does_not_repeat_a_finished_one(tmp_path, monkeypatch, capsys):
    draws = small_board()
    campaign.open_campaign(tmp_path, draws)
    started: list[int] = []

    def process(command: list[str], **_: object) -> subprocess.CompletedProcess[bytes]:
        number = int(command[command.index("--run-one") + 1])
        assert command[-1] == "--keep-data"
        started.append(number)
        if number == 1:
            return subprocess.CompletedProcess(command, -9)
        if number == 2:
            raise subprocess.TimeoutExpired(command, 7)
        draw = draws.trials[number]
        finished_trial(draw, *["missed"] * max(1, len(draw.causes))).write(trial_folder(tmp_path, draw))
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(campaign.subprocess, "run", process)
    options = {"workers": Workers(2), "timeout_s": 7.0, "options": ["--keep-data"]}
    campaign.run_campaign(tmp_path, draws, numbers=[0, 1], **options)
    campaign.run_campaign(tmp_path, draws, numbers=[0, 1, 2, 3], **options)
    assert sorted(started) == [0, 1, 2, 3]
    failures = [trial.failure for trial in campaign.finished(tmp_path, draws)]
    assert failures == ["", "the process ended with exit code -9", "not finished after 7 s", ""]
    assert capsys.readouterr().out.count("trial ") == 4


def test_a_folder_with_other_draws_is_refused(tmp_path):
    campaign.open_campaign(tmp_path, small_board())
    campaign.open_campaign(tmp_path, small_board())
    with pytest.raises(InputError, match="other settings"):
        campaign.open_campaign(tmp_path, small_board(seed=1))


def test_fields_that_cannot_be_printed_are_refused_before_the_first_trial():
    with pytest.raises(InputError, match="at least 32"):
        small_board(size_px=8)


def test_measured_prints_that_are_not_given_are_asked_for_before_the_first_trial(
    tmp_path, monkeypatch, capsys
):
    command = ["trials", "--out", str(tmp_path), "--board", "mixtures", "--seed", "1"]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit, match="2"):
        main()
    assert "--measured STORE" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_command_of_a_scoreboard_makes_the_same_scoreboard(tmp_path, monkeypatch):
    monkeypatch.setattr(trials, "run_campaign", lambda *_, **__: None)
    words = ["trials", "--out", str(tmp_path), "--board", "mixtures", "--measured", "prints.zarr"]
    boards = []
    for _ in range(2):
        monkeypatch.setattr(sys, "argv", words)
        main()
        boards.append(Scoreboard.read(tmp_path))
        words = shlex.split(boards[-1].command)[2:]
    assert boards[0].command == boards[1].command
    assert boards[0].pending == boards[1].pending


def test_an_error_inside_a_trial_is_its_result(tmp_path, capfd):
    # A field of 8 px cannot be printed.
    draw = drawn(cause("vignetting"))
    trial = run_trial(draw, small_board().model_copy(update={"size_px": 8}), tmp_path)
    assert trial == Trial.read(trial_folder(tmp_path, draw))
    assert "at least 32" in trial.failure
    assert [(one.name, one.verdict) for one in trial.outcomes] == [("vignetting", "failed")]
    assert "Traceback" in capfd.readouterr().err


# Two whole trials


@pytest.mark.long
def test_one_cause_is_found_or_in_the_set(tmp_path: Path):
    trial = run_trial(drawn(cause("vignetting", 14.0), kind="in-form"), small_board(size_px=192), tmp_path)
    assert not trial.failure
    assert trial.outcomes[0].verdict in ("right", "set-contains-it"), trial.outcomes
    assert trial.errors is not None
    assert trial.errors.ratio is not None
    assert trial.errors.ratio <= 1.15


@pytest.mark.long
def test_nothing_is_reported_where_there_is_nothing(tmp_path: Path):
    trial = run_trial(drawn(kind="empty"), small_board(size_px=192), tmp_path)
    assert not trial.failure
    # Each scan has its own datum.
    assert {one.by for one in trial.found} <= {"scan"}
    assert trial.outcomes[0].verdict == "clean"
