"""The blind trials: draws, sizes, judging, how a campaign survives, and trials end to end."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.blind_trials import campaign
from benchmarks.blind_trials.__main__ import PAGE, REPORTED_SEED, results_of
from benchmarks.blind_trials.draws import BOARD, BOARD_RMS_NM, EARLIER_RMS_NM, draw_board, draw_earlier
from benchmarks.blind_trials.judging import judge, named_outside_span, scan_terms, strangers
from benchmarks.blind_trials.other_forms import FORMS, FormCause
from benchmarks.blind_trials.planting import (
    knob_settings,
    plant,
    printer_of,
    refitted_rms_nm,
    trial_jobs,
)
from benchmarks.blind_trials.records import (
    Cost,
    Draw,
    Draws,
    ErrorPair,
    Kind,
    KnobDraw,
    Named,
    Outcome,
    Planted,
    Scoreboard,
    Trial,
    TrialErrors,
)
from benchmarks.blind_trials.report import write_report
from benchmarks.blind_trials.scoreboard import (
    as_markdown,
    make_scoreboard,
    publish,
    published,
    summarise,
)
from benchmarks.blind_trials.trial import run_trial, trial_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.workers import Workers
from litho_data.virtual_fab import KNOBS, Fab, Microscope, Noise, Printer, Truth, scan_job
from litho_data.virtual_fab.knobs import KnobBoard
from litho_models.effects import CATALOGUE
from litho_models.loop.result.record import AddedEffect, Candidate, CloseLoop, Residual
from litho_models.scan_terms import POLICIES, TermPixels, least_squares, term_maps

DEVELOPMENT_SEED = 0


# Draws


def test_a_board_follows_from_its_seed_and_has_what_was_promised():
    draws = draw_board(5)
    assert draws == draw_board(5)
    assert draws != draw_board(6)
    assert [draw.number for draw in draws] == list(range(48))
    assert Counter(draw.kind for draw in draws) == BOARD
    assert all(len(draw.knobs) == (draw.kind != "empty") for draw in draws)
    rms_nm = np.array([knob.wanted_rms_nm for draw in draws for knob in draw.knobs])
    # All that is drawn is to count: above 8 nm with room for what the search on four scans is off by.
    assert BOARD_RMS_NM[0] <= rms_nm.min() <= rms_nm.max() <= BOARD_RMS_NM[1]
    assert 0.87 * BOARD_RMS_NM[0] > 8
    assert len({tuple(draw.printer.items()) for draw in draws}) == 48


def test_causes_of_a_board_are_dealt_once_and_come_from_their_class():
    for seed in range(5):
        names = {
            kind: [k.name for d in draw_board(seed) if d.kind == kind for k in d.knobs] for kind in BOARD
        }
        assert all(len(set(dealt)) == len(dealt) for dealt in names.values())
        assert not set(names["other-form"]) & KNOBS.keys()
        assert set(names["other-form"]) <= FORMS.keys()
        assert all(KNOBS[name].effect != "off-catalogue" for name in names["in-form"] + names["alias"])
        assert not any(KNOBS[name].refit_absorbs or KNOBS[name].nuisance_span for name in names["in-form"])
        assert all(KNOBS[name].refit_absorbs or KNOBS[name].nuisance_span for name in names["alias"])


def test_the_page_lists_all_forms():
    rows = [
        f"| `{form.name}` | {form.stage} | 0…{form.limit:g} {form.unit} | {form.meaning} |".replace(
            " 1 |", " |"
        )
        for form in FORMS.values()
    ]
    table = PAGE.read_text(encoding="utf-8").split("<!-- forms -->")[1].split("<!-- end of forms -->")[0]
    assert [line for line in table.splitlines() if line.startswith("| `")] == rows


def test_the_drawing_reads_no_catalogue():
    """In a fresh interpreter: what draws and sizes a board loads neither the effects nor the loop."""
    code = (
        "import sys, benchmarks.blind_trials.draws, benchmarks.blind_trials.planting\n"
        "print(*(m for m in sys.modules if m.startswith(('litho_models.effects', 'litho_models.loop'))))"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert not loaded.split()


def same_draws(draws: Sequence[Draw], committed: Scoreboard) -> None:
    """The draws of a committed board, sizes to a few roundings: a processor has its own exponential."""
    for drawn, trial in zip(draws, committed.trials, strict=True):
        was = trial.draw
        assert drawn.model_copy(update={"knobs": []}) == was.model_copy(update={"knobs": []})
        assert [knob.name for knob in drawn.knobs] == [knob.name for knob in was.knobs]
        sizes, were = ([knob.wanted_rms_nm for knob in one.knobs] for one in (drawn, was))
        assert sizes == pytest.approx(were, rel=8 * np.finfo(float).eps)


def test_an_earlier_board_is_drawn_as_it_was():
    draws = draw_earlier(40, 5)
    assert draws == draw_earlier(40, 5)
    assert draws != draw_earlier(40, 6)
    assert {draw.kind for draw in draws} == {"single", "two", "none", "off-catalogue"}
    rms_nm = np.array([knob.wanted_rms_nm for draw in draws for knob in draw.knobs])
    assert EARLIER_RMS_NM[0] <= rms_nm.min() <= rms_nm.max() <= EARLIER_RMS_NM[1]
    pairs = [draw.knobs for draw in draws if draw.kind == "two"]
    assert all(KNOBS[a.name].effect != KNOBS[b.name].effect for a, b in pairs)
    committed = Scoreboard.read(results_of(20266))
    same_draws(draw_earlier(len(committed.trials), committed.seed), committed)


def test_too_few_trials_are_refused():
    with pytest.raises(InputError, match="one of each kind"):
        draw_earlier(3, 0)


# Sizes


def drawn(knobs: Mapping[str, float], kind: Kind = "single", seed: int = 4) -> Draw:
    wanted = [KnobDraw(name=name, wanted_rms_nm=size) for name, size in knobs.items()]
    return Draw(number=0, kind=kind, seed=seed, knobs=wanted)


def test_a_knob_reaches_the_drawn_rms_after_the_projection_of_policy_full():
    draw = drawn({"galvo-lag": 12.0})
    jobs = trial_jobs(draw, 3, 96)
    (planted,) = plant(draw, jobs)
    squares = []
    for job in jobs:
        with_knob, without = (
            scan_job(
                Fab(Printer(), Microscope.aligned(), Noise.off(), KnobBoard(knobs, draw.seed), draw.seed), job
            ).noiseless_um
            for knobs in (knob_settings([planted], draw.seed), [])
        )
        basis = term_maps(TermPixels(without), POLICIES["full"])
        change = (with_knob - without).ravel()
        squares.append(np.mean((change - least_squares(basis, change) @ basis) ** 2))
    rms_nm = 1e3 * np.sqrt(np.mean(squares))
    # The same projection written twice, in float64.
    assert planted.rms_nm == pytest.approx(rms_nm, rel=1e-6)
    # The search stops within 1 %.
    assert rms_nm == pytest.approx(12.0, rel=0.011)
    assert not planted.at_limit


def test_a_knob_that_cannot_reach_the_size_stands_at_its_limit_and_says_what_it_reached():
    draw = drawn({"datum-offset": 20.0, "vignetting": 1e4}, "two")
    datum, vignetting = plant(draw, trial_jobs(draw, 2, 64))
    assert datum.strength == KNOBS["datum-offset"].limit
    assert vignetting.strength == KNOBS["vignetting"].limit
    assert datum.at_limit
    assert vignetting.at_limit
    # An offset is removed by the projection; what is left is rounding of a 0.3 µm constant.
    assert datum.rms_nm < 1e-6
    assert 1 < vignetting.rms_nm < 1e4


def noise_free(cause: FormCause | None, jobs, printer: Printer) -> list[np.ndarray]:
    fab = Fab(printer, Microscope.aligned(), Noise.off(), KnobBoard((), 0), 0, cause)
    scans = [scan_job(fab, job).noiseless_um for job in jobs]
    margin = (len(scans[0]) - len(jobs[0].level)) // 2
    return [scan[margin:-margin, margin:-margin] for scan in scans]


@pytest.mark.parametrize("name", sorted(FORMS))
def test_a_form_does_nothing_at_strength_zero_and_the_same_twice(name):
    draw = drawn({name: 10.0}, "other-form")
    jobs = trial_jobs(draw, 2, 64)
    plain = noise_free(None, jobs, Printer())
    for strength, differs in ((0.0, False), (0.3 * FORMS[name].limit, True)):
        once, again = (noise_free(FormCause(name, strength, 3), jobs, Printer()) for _ in range(2))
        np.testing.assert_array_equal(once, again)
        # The last field in the order of printing has every step behind it.
        assert np.array_equal(once[-1], plain[-1]) != differs


@pytest.mark.parametrize(
    "name",
    [
        "periodic-lines",
        *(
            pytest.param(name, marks=pytest.mark.long)
            for name in ("alternate-slices", "cubic-slope-loss", "fringes", "seam-in-height")
        ),
    ],
)
def test_a_planted_form_has_the_size_that_it_claims(name):
    """It counts, and it is no more than what the plain fab and the scans' own terms leave."""
    # A network of short reach, for speed.
    draw = drawn({name: 9.0}, "other-form").model_copy(update={"printer": {"network_reach_um": 0.3}})
    jobs = trial_jobs(draw, 2, 96)
    (planted,) = plant(draw, jobs)
    # Sought to 3 % on these same two fields.
    assert planted.at_limit or planted.rms_nm == pytest.approx(9.0, rel=0.031)
    printer = printer_of(draw)
    heights = noise_free(FormCause(name, planted.strength, draw.seed), jobs, printer)
    squares = []
    for height, plain in zip(heights, noise_free(None, jobs, printer), strict=True):
        basis = term_maps(TermPixels(plain), POLICIES["full"] | {"warp"})
        change = (height - plain).ravel()
        squares.append(np.mean((change - least_squares(basis, change) @ basis) ** 2))
    # A refit of the base can only take more; pixels are thinned in one and not in the other (5 %).
    assert 8.0 < planted.rms_nm < 1.05e3 * np.sqrt(np.mean(squares))


@pytest.mark.long
def test_what_the_base_can_imitate_does_not_count():
    """The plain fab at other parameters is the Physics model: nothing is left, wherever a fit starts."""
    draw = drawn({}, "empty")
    jobs = trial_jobs(draw, 4, 96)
    other = replace(Printer(), threshold_steepness=2.2, loose_retention=0.45, network_reach_um=1.6)
    heights = [1.02 * height + 0.03 for height in noise_free(None, jobs, other)]
    # Kernels cut at 4 σ leave 0.001 nm of a change of more than 25 nm.
    assert refitted_rms_nm(heights, jobs, Printer()) < 0.01
    assert refitted_rms_nm(heights, jobs, other) < 0.01


@pytest.mark.long
def test_an_alias_is_planted_at_the_drawn_size_and_hardly_any_of_it_counts():
    draw = drawn({"dose-exponent": 12.0}, "alias")
    (planted,) = plant(draw, trial_jobs(draw, 4, 96))
    assert not planted.at_limit
    # docs/virtual_fab.md: a refit leaves 6 % of it.
    assert planted.rms_nm < 0.2 * 12.0


def test_a_cause_acts_on_the_print_and_on_the_scan_at_its_own_stage():
    draw = drawn({})
    (job,) = trial_jobs(draw, 1, 64)
    for name, on_print in (("far-copy", True), ("cubic-slope-loss", True), ("periodic-lines", False)):
        fab = Fab(Printer(), Microscope.aligned(), Noise.off(), KnobBoard((), 0), 0)
        plain = scan_job(fab, job)
        found = scan_job(replace(fab, cause=FormCause(name, 0.5 * FORMS[name].limit, 1)), job)
        assert np.array_equal(found.clean_um, plain.clean_um) != on_print
        assert not np.array_equal(found.noiseless_um, plain.noiseless_um)


# Judging


def loop_result(
    *sets: tuple[str, ...], verdict: str = "traced", rest: str = "undecided", **said: str
) -> CloseLoop:
    """What the loop would write had it added these effects, each with those that look the same.

    A set may begin with its verdict; ``said`` are the verdicts of candidates (with _ for -).
    """
    verdicts = {name.replace("_", "-"): value for name, value in said.items()}
    return CloseLoop.model_construct(
        effects=[added(*names) for names in sets],
        candidates=[
            Candidate.model_construct(
                name=name,
                verdict=verdicts.get(name, "below-noise"),
                reason="none",
                p_screen=None,
                gain_nm=None,
            )
            for name in CATALOGUE | {"quantisation": None}
        ],
        residual=Residual.model_construct(state=rest, signature=""),
        verdict=verdict,
    )


def added(name: str, *others: str) -> AddedEffect:
    if name == "partial":
        return AddedEffect.model_construct(name=others[0], verdict="partial", confusable_with=[])
    probe = name not in CATALOGUE
    verdict = "traced-to-covariate" if probe else "confusable" if others else "explained"
    return AddedEffect.model_construct(name=name, verdict=verdict, confusable_with=list(others))


def planted_effect(effect: str, rms_nm: float = 20.0, name: str = "") -> Planted:
    return Planted(
        name=name or effect,
        effect=effect,
        strength=1.0,
        unit="1",
        at_limit=False,
        wanted_rms_nm=rms_nm,
        rms_nm=rms_nm,
        nuisance_span=False,
    )


@pytest.mark.parametrize(
    ("kind", "planted", "sets", "wanted"),
    [
        ("in-form", ["vignetting"], [("datum-offset",), ("vignetting",)], ["right"]),
        ("in-form", ["vignetting"], [("trench-residue", "vignetting")], ["set-contains-it"]),
        ("in-form", ["vignetting"], [("trench-residue",)], ["wrong"]),
        ("in-form", ["vignetting"], [("datum-offset",), ("tilt-bow",)], ["missed"]),
        ("in-form", ["vignetting"], [("missing-kernel",)], ["missed"]),
        ("in-form", ["vignetting"], [("partial", "vignetting")], ["partial"]),
        ("in-form", ["vignetting"], [("partial", "trench-residue")], ["missed"]),
        ("single", ["scan-line-stripes"], [("scan-line-stripes",)], ["right"]),
        ("two", ["vignetting", "galvo-lag"], [("vignetting",), ("galvo-lag",)], ["right", "right"]),
        ("two", ["vignetting", "galvo-lag"], [("vignetting",)], ["right", "missed"]),
        ("two", ["vignetting", "galvo-lag"], [("vignetting",), ("trench-residue",)], ["right", "wrong"]),
        ("empty", [], [("datum-offset",), ("registration-residual",)], ["clean"]),
        ("empty", [], [("vignetting",)], ["false-positive"]),
        ("empty", [], [("missing-kernel",)], ["false-positive"]),
        ("none", [], [("partial", "vignetting")], ["false-positive"]),
        ("other-form", ["off-catalogue"], [("missing-kernel",)], ["traced-to-covariate"]),
        ("other-form", ["off-catalogue"], [("missing-kernel",), ("vignetting",)], ["named-a-cause"]),
        ("off-catalogue", ["off-catalogue"], [("vignetting", "trench-residue")], ["named-a-cause"]),
        ("other-form", ["off-catalogue"], [("partial", "vignetting")], ["partial"]),
        ("other-form", ["off-catalogue"], [("datum-offset",)], ["missed"]),
    ],
)
def test_judgements(kind, planted, sets, wanted):
    outcomes = judge(kind, [planted_effect(effect) for effect in planted], loop_result(*sets))
    assert [outcome.judgement for outcome in outcomes] == wanted


def test_structure_left_is_noticed_where_there_is_a_cause_and_invented_where_there_is_none():
    for verdict, rest, structured in (
        ("nothing-missing", "undecided", False),
        ("nothing-missing", "nothing-missing", False),
        ("too-few-scans", "too-few-scans", False),
        ("unexplained", "unexplained", True),
        ("nothing-missing", "unexplained", True),
    ):
        found = loop_result(verdict=verdict, rest=rest)
        (other,) = judge("other-form", [planted_effect("off-catalogue")], found)
        (empty,) = judge("empty", [], found)
        assert (other.judgement, empty.judgement) == (
            ("unexplained", "false-positive") if structured else ("missed", "clean")
        )


def test_absorbed_is_right_for_what_a_refit_takes_up_only():
    found = loop_result(dose_exponent="absorbed")
    for rms_nm, wanted in ((2.0, "absorbed"), (9.0, "missed")):
        (outcome,) = judge("alias", [planted_effect("dose-exponent", rms_nm)], found)
        assert outcome.judgement == wanted


def test_what_is_seen_without_a_model_or_handed_to_design_is_named_too():
    found = loop_result(
        quantisation="explained", line_roughness="explained", registration_residual="explained"
    )
    # The default noise is line-shaped, and a scan may be bent.
    assert [one.names for one in named_outside_span(found)] == [["quantisation"]]
    assert judge("empty", [], found)[0].judgement == "false-positive"
    assert judge("in-form", [planted_effect("quantisation")], found)[0].judgement == "right"
    partial = loop_result(("partial", "vignetting"))
    for exported, wanted in (([], "partial"), (["vignetting"], "named-a-cause")):
        (outcome,) = judge("other-form", [planted_effect("off-catalogue")], partial, exported)
        assert outcome.judgement == wanted


def test_periodic_lines_are_noticed_by_accepting_offsets_of_lines():
    found = loop_result(("scan-line-stripes",), verdict="nothing-missing")
    for name, wanted in (("periodic-lines", "traced-to-covariate"), ("far-copy", "missed")):
        (outcome,) = judge("other-form", [planted_effect("off-catalogue", name=name)], found)
        assert outcome.judgement == wanted


def test_terms_of_single_scans_are_those_of_the_catalogue():
    result = loop_result(("datum-offset",), ("position-gain-map",), ("vignetting",), ("scan-line-stripes",))
    assert scan_terms(result) == ["datum-offset", "scan-line-stripes"]


def test_a_false_name_beside_a_right_one_is_a_stranger():
    named = [
        Named(names=["vignetting"], verdict="explained"),
        Named(names=["galvo-lag", "feedback-lag"], verdict="confusable"),
        Named(names=["level-table"], verdict="traced-to-covariate"),
    ]
    assert strangers(named, [planted_effect("vignetting")]) == ["galvo-lag | feedback-lag"]
    assert strangers(named, [planted_effect("vignetting"), planted_effect("feedback-lag")]) == []


# Scoreboard


def finished_trial(draw: Draw, judgements: list[str], rms_nm: float = 20.0, after_nm: float = 12.0) -> Trial:
    planted = [
        planted_effect(knob.name, rms_nm).model_copy(update={"name": knob.name}) for knob in draw.knobs
    ]
    effects = [one.effect for one in planted] or ["none"]
    return Trial(
        schema=Trial.SCHEMA,
        draw=draw,
        planted=planted,
        outcomes=[
            Outcome(effect=effect, rms_nm=rms_nm if planted else 0.0, judgement=judgement, loop_says="…")
            for effect, judgement in zip(effects, judgements, strict=True)
        ],
        also_named=[],
        named=[],
        scan_terms=[],
        verdict="traced",
        dropped=[],
        errors=TrialErrors(
            before=ErrorPair(mae_nm=20, rmse_nm=25),
            after=ErrorPair(mae_nm=after_nm, rmse_nm=15),
            floor=ErrorPair(mae_nm=12, rmse_nm=15),
        ),
        cost=Cost(build_s=1, loop_s=2, cpu_s=3),
        failure="",
    )


def campaign_of_seven() -> tuple[Draws, list[Trial]]:
    draws = [
        drawn({"vignetting": 20}, "in-form"),
        drawn({"galvo-lag": 20}, "in-form"),
        drawn({"galvo-lag": 20, "vignetting": 20}, "two"),
        drawn({}, "empty"),
        drawn({"far-copy": 20}, "other-form"),
        drawn({"fringes": 5}, "other-form"),
        drawn({"rim": 20}, "other-form"),
    ]
    draws = [draw.model_copy(update={"number": number}) for number, draw in enumerate(draws)]
    with_false_name = finished_trial(draws[2], ["missed", "set-contains-it"], after_nm=12 * 1.06)
    trials = [
        finished_trial(draws[0], ["right"], after_nm=12 * 1.04),
        campaign.failed(draws[1], [], "boom | and\nmore"),
        with_false_name.model_copy(update={"also_named": ["tip-dilation"]}),
        finished_trial(draws[3], ["clean"]),
        finished_trial(draws[4], ["unexplained"], after_nm=12 * 1.29),
        finished_trial(draws[5], ["named-a-cause"], rms_nm=5),
        campaign.failed(draws[6], [], "boom"),
    ]
    return Draws(schema=Draws.SCHEMA, seed=0, n_scans=12, size_px=256, trials=draws), trials


def test_the_figures_count_failures_as_not_found_and_leave_out_small_causes():
    _, trials = campaign_of_seven()
    figures = summarise(trials)
    got = {name: (tally.count, tally.total) for name, tally in figures if hasattr(tally, "total")}
    assert got == {
        "in_form": (2, 4),
        "false_beside": (1, 2),
        "in_form_with_false_name": (1, 3),
        "named": (0, 2),
        "noticed": (1, 2),
        "unnoticed": (1, 2),
        "clean": (1, 1),
        # 1.04 and the empty one, of 1.04, a failure, 1.06 and the empty one.
        "at_floor_in_form": (2, 4),
        "at_floor_other": (2, 3),
    }
    assert figures.failed == 2


def test_the_scoreboard_survives_its_file_and_its_page_says_what_it_says(tmp_path):
    draws, trials = campaign_of_seven()
    scoreboard = make_scoreboard(draws, trials, "make it again")
    scoreboard.write(tmp_path)
    assert Scoreboard.read(tmp_path) == scoreboard
    page = tmp_path / "page.md"
    page.write_text(page_of(scoreboard.seed, "old") + page_of(7, "another board"), encoding="utf-8")
    publish(page, scoreboard)
    assert published(page, scoreboard.seed) == as_markdown(scoreboard)
    assert published(page, 7) == "another board"
    assert page.read_text(encoding="utf-8").startswith("top\n")
    assert page.read_text(encoding="utf-8").endswith("\nbottom\n")
    table = [line for line in published(page, scoreboard.seed).splitlines() if line.startswith("|")]
    # 12 figures and 8 planted causes, with two lines of head each.
    assert len(table) == 12 + 2 + 8 + 2
    assert "| … both together | 4 of 7 (57 %) | at least 90 % |" in table
    report = write_report(scoreboard, tmp_path).read_text(encoding="utf-8")
    assert report.count("<img") == 2
    assert (tmp_path / "scoreboard.csv").read_text(encoding="utf-8").count("\n") >= 9


def page_of(seed: int, text: str) -> str:
    marks = (f"<!-- scoreboard of seed {seed}: written by the command -->", "<!-- end of scoreboard -->")
    return f"top\n{marks[0]}\n{text}\n{marks[1]}\nbottom\n"


def test_an_unfinished_campaign_is_not_published(tmp_path):
    draws, trials = campaign_of_seven()
    page = tmp_path / "page.md"
    page.write_text(page_of(0, ""), encoding="utf-8")
    with pytest.raises(InputError, match="pending"):
        publish(page, make_scoreboard(draws, trials[:-1], ""))


@pytest.mark.parametrize("seed", range(20266, REPORTED_SEED + 1))
def test_the_published_table_is_the_committed_scoreboard(seed):
    scoreboard = Scoreboard.read(results_of(seed))
    assert published(PAGE, seed) == as_markdown(scoreboard)
    assert scoreboard.seed == seed
    assert scoreboard.summary in (None, summarise(scoreboard.trials))
    if seed >= 20267:
        same_draws(draw_board(seed), scoreboard)


# Campaign


def test_a_campaign_records_a_dying_trial_and_does_not_repeat_a_finished_one(tmp_path, monkeypatch, capsys):
    draws = campaign.make_draws(count=4, seed=0, n_scans=12, size_px=64)
    campaign.open_campaign(tmp_path, draws)
    started: list[int] = []

    def process(command: list[str], **_: object) -> subprocess.CompletedProcess[bytes]:
        number = int(command[command.index("--run-one") + 1])
        started.append(number)
        if number == 1:
            return subprocess.CompletedProcess(command, -9)
        if number == 2:
            raise subprocess.TimeoutExpired(command, 7)
        draw = draws.trials[number]
        judgements = ["missed"] * max(1, len(draw.knobs))
        finished_trial(draw, judgements).write(trial_folder(tmp_path, number))
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(campaign.subprocess, "run", process)
    options = {"workers": Workers(2), "timeout_s": 7.0, "keep_data": False}
    campaign.run_campaign(tmp_path, draws, numbers=[0, 1], **options)
    campaign.run_campaign(tmp_path, draws, numbers=[0, 1, 2, 3], **options)
    assert sorted(started) == [0, 1, 2, 3]
    failures = [trial.failure for trial in campaign.finished(tmp_path, draws)]
    assert failures == ["", "the process ended with exit code -9", "not finished after 7 s", ""]
    assert capsys.readouterr().out.count("trial ") == 4


def test_a_folder_with_other_draws_is_refused(tmp_path):
    board, other = (campaign.make_draws(count=None, seed=s, n_scans=12, size_px=64) for s in (0, 1))
    campaign.open_campaign(tmp_path, board)
    campaign.open_campaign(tmp_path, board)
    with pytest.raises(InputError, match="other settings"):
        campaign.open_campaign(tmp_path, other)


def test_fields_that_cannot_be_printed_are_refused_before_the_first_trial():
    with pytest.raises(InputError, match="at least 32"):
        campaign.make_draws(count=4, seed=0, n_scans=12, size_px=8)


@pytest.mark.long
def test_a_plan_says_what_counts_and_runs_nothing():
    draws = campaign.make_draws(count=None, seed=1, n_scans=2, size_px=64)
    few = {draw.kind: draw.number for draw in draws.trials if draw.kind in ("empty", "other-form")}
    *trials, counted = campaign.plan_lines(draws, [*few.values()])
    assert {line.split(": ")[1].rstrip(":") for line in trials} == few.keys()
    assert counted.startswith("counted: empty 0 of 1, other-form ")


def test_an_error_inside_a_trial_is_its_result(tmp_path, capfd):
    # 8 px cannot be printed.
    trial = run_trial(drawn({"vignetting": 20}), tmp_path, n_scans=2, size_px=8)
    assert trial == Trial.read(trial_folder(tmp_path, 0))
    assert "at least 32" in trial.failure
    assert [(o.effect, o.judgement) for o in trial.outcomes] == [("vignetting", "failed")]
    assert "Traceback" in capfd.readouterr().err


# Three trials from the raw folder


def development_draw(kind: Kind) -> Draw:
    """The first draw of a kind from the development seed that can be expected to be found."""

    def findable(knob: KnobDraw) -> bool:
        known = KNOBS[knob.name]
        return knob.wanted_rms_nm > 8 and not known.nuisance_span and not known.refit_absorbs

    draws = draw_earlier(24, DEVELOPMENT_SEED)
    return next(draw for draw in draws if draw.kind == kind and all(map(findable, draw.knobs)))


def run_small(kind: Kind, out: Path) -> Trial:
    return run_trial(development_draw(kind), out, n_scans=12, size_px=192)


@pytest.mark.long
def test_one_effect_is_found_or_in_the_set(tmp_path):
    trial = run_small("single", tmp_path)
    assert not trial.failure
    assert trial.outcomes[0].judgement in ("right", "set-contains-it"), trial.outcomes
    assert trial.errors is not None
    assert trial.errors.mae_to_floor <= 1.15


@pytest.mark.long
def test_nothing_is_reported_where_there_is_nothing(tmp_path):
    trial = run_small("none", tmp_path)
    assert not trial.failure
    assert trial.named == []
    assert trial.errors is not None
    assert trial.errors.mae_to_floor <= 1.15
    truth = Truth.read(tmp_path / "truth" / f"{trial.draw.number:02d}")
    floor_nm = np.sqrt(np.mean([scan.floor_rmse_nm**2 for scan in truth.scans]))
    # The truth's own figure is in the frame of the scans and over all of them: resampling smooths away
    # 1 %, and the roughness of 10 of 12 scans of (192 px)² has some 10⁴ independent places.
    assert trial.errors.floor.rmse_nm == pytest.approx(floor_nm, rel=0.04)


@pytest.mark.long
def test_an_effect_outside_the_catalogue_is_never_given_a_name(tmp_path):
    trial = run_small("off-catalogue", tmp_path)
    assert not trial.failure
    assert trial.outcomes[0].judgement != "named-a-cause", trial.named
    assert not [one for one in trial.named if one.verdict != "traced-to-covariate"]
