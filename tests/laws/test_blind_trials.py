"""The blind trials: what is drawn, how it is judged, how a campaign survives, and three trials end to end."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from benchmarks.blind_trials import campaign
from benchmarks.blind_trials.__main__ import PAGE, REPORTED_SEED, RESULTS
from benchmarks.blind_trials.document import END, START, as_markdown, publish, published
from benchmarks.blind_trials.draws import LARGEST_RMS_NM, SMALLEST_RMS_NM, draw_trials
from benchmarks.blind_trials.judging import judge, scan_terms, strangers
from benchmarks.blind_trials.planting import plant, settings, trial_jobs
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
from benchmarks.blind_trials.scoreboard import make_scoreboard, summarise
from benchmarks.blind_trials.trial import run_trial, trial_folder
from litho_data.foundation.errors import InputError
from litho_data.virtual_fab import KNOBS, Fab, Microscope, Noise, Printer, Truth, scan_job
from litho_data.virtual_fab.knobs import KnobBoard
from litho_models.effects import CATALOGUE
from litho_models.loop.result.record import AddedEffect, Candidate, CloseLoop, Residual
from litho_models.scan_terms import POLICIES, TermPixels, least_squares, term_maps

DEVELOPMENT_SEED = 0


# Draws


def test_draws_follow_from_the_seed_and_have_all_kinds_and_sizes():
    draws = draw_trials(40, 5)
    assert draws == draw_trials(40, 5)
    assert draws != draw_trials(40, 6)
    assert [draw.number for draw in draws] == list(range(40))
    assert {draw.kind for draw in draws} == {"single", "two", "none", "off-catalogue"}
    sizes = {"single": 1, "off-catalogue": 1, "two": 2, "none": 0}
    assert all(len(draw.knobs) == sizes[draw.kind] for draw in draws)
    rms_nm = np.array([knob.wanted_rms_nm for draw in draws for knob in draw.knobs])
    assert rms_nm.min() >= SMALLEST_RMS_NM
    assert rms_nm.max() <= LARGEST_RMS_NM
    # Log-uniform: the middle of the range is its geometric mean. 42 draws: binomial sd 3.2, so ±4 sd.
    middle = (SMALLEST_RMS_NM * LARGEST_RMS_NM) ** 0.5
    assert abs(np.sum(rms_nm < middle) - rms_nm.size / 2) < 13


def test_every_knob_is_dealt_before_one_comes_again():
    names = [knob.name for draw in draw_trials(60, 1) if draw.kind == "single" for knob in draw.knobs]
    catalogue = {name for name, knob in KNOBS.items() if knob.effect != "off-catalogue"}
    in_deal = [k.name for d in draw_trials(60, 1) if d.kind in ("single", "two") for k in d.knobs]
    # 36 of 36 knobs among the first 36 dealt; a card that shares its effect with its partner is passed over.
    assert len(set(in_deal[: len(catalogue)])) >= len(catalogue) - 1
    assert set(names) <= catalogue
    pairs = [draw.knobs for draw in draw_trials(60, 1) if draw.kind == "two"]
    assert all(KNOBS[a.name].effect != KNOBS[b.name].effect for a, b in pairs)


def test_too_few_trials_are_refused():
    with pytest.raises(InputError, match="one of each kind"):
        draw_trials(3, 0)


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
            for knobs in (settings([planted], draw.seed), [])
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


# Judging


def loop_result(*sets: tuple[str, ...], verdict: str = "traced") -> CloseLoop:
    """What the loop would write had it added these effects, each with those that look the same."""
    return CloseLoop.model_construct(
        effects=[added(*names) for names in sets],
        candidates=[
            Candidate(name=name, verdict="below-noise", reason="none", p_screen=None, gain_nm=None)
            for name in CATALOGUE
        ],
        residual=Residual(state="undecided", signature=""),
        verdict=verdict,
    )


def added(name: str, *others: str) -> AddedEffect:
    probe = name not in CATALOGUE
    verdict = "traced-to-covariate" if probe else "confusable" if others else "explained"
    return AddedEffect.model_construct(name=name, verdict=verdict, confusable_with=list(others))


def planted_effect(effect: str, rms_nm: float = 20.0) -> Planted:
    return Planted(
        name=effect,
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
        ("single", ["vignetting"], [("datum-offset",), ("vignetting",)], ["right"]),
        ("single", ["vignetting"], [("trench-residue", "vignetting")], ["set-contains-it"]),
        ("single", ["vignetting"], [("trench-residue",)], ["wrong"]),
        ("single", ["vignetting"], [("datum-offset",), ("tilt-bow",)], ["missed"]),
        ("single", ["vignetting"], [("missing-kernel",)], ["missed"]),
        ("single", ["scan-line-stripes"], [("scan-line-stripes",)], ["right"]),
        ("two", ["vignetting", "galvo-lag"], [("vignetting",), ("galvo-lag",)], ["right", "right"]),
        ("two", ["vignetting", "galvo-lag"], [("vignetting",)], ["right", "missed"]),
        ("two", ["vignetting", "galvo-lag"], [("vignetting",), ("trench-residue",)], ["right", "wrong"]),
        ("none", [], [("datum-offset",), ("registration-residual",)], ["clean"]),
        ("none", [], [("vignetting",)], ["false-positive"]),
        ("none", [], [("missing-kernel",)], ["false-positive"]),
        ("off-catalogue", ["off-catalogue"], [("missing-kernel",)], ["traced-to-covariate"]),
        ("off-catalogue", ["off-catalogue"], [("missing-kernel",), ("vignetting",)], ["named-a-cause"]),
        ("off-catalogue", ["off-catalogue"], [("vignetting", "trench-residue")], ["named-a-cause"]),
    ],
)
def test_judgements(kind, planted, sets, wanted):
    outcomes = judge(kind, [planted_effect(effect) for effect in planted], loop_result(*sets))
    assert [outcome.judgement for outcome in outcomes] == wanted


def test_terms_of_single_scans_are_those_of_the_catalogue():
    result = loop_result(("datum-offset",), ("position-gain-map",), ("vignetting",), ("scan-line-stripes",))
    assert scan_terms(result) == ["datum-offset", "scan-line-stripes"]


def test_an_effect_without_a_name_may_be_noticed_or_missed():
    planted = [planted_effect("off-catalogue")]
    for verdict, wanted in (("unexplained", "unexplained"), ("nothing-missing", "missed")):
        assert judge("off-catalogue", planted, loop_result(verdict=verdict))[0].judgement == wanted


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


def campaign_of_five() -> tuple[Draws, list[Trial]]:
    one = drawn({"vignetting": 20})
    draws = [
        one,
        one.model_copy(update={"number": 1}),
        drawn({"galvo-lag": 20, "vignetting": 20}, "two").model_copy(update={"number": 2}),
        drawn({}, "none").model_copy(update={"number": 3}),
        drawn({"ghost-spot": 5}, "off-catalogue").model_copy(update={"number": 4}),
    ]
    trials = [
        finished_trial(draws[0], ["right"]),
        campaign.failed(draws[1], [], "boom | and\nmore"),
        finished_trial(draws[2], ["missed", "set-contains-it"], after_nm=12 * 1.16),
        finished_trial(draws[3], ["clean"], after_nm=12 * 1.14),
        finished_trial(draws[4], ["unexplained"], rms_nm=5),
    ]
    return Draws(schema=Draws.SCHEMA, seed=0, n_scans=12, size_px=256, trials=draws), trials


def test_the_figures_count_failures_as_not_found_and_leave_out_small_effects():
    _, trials = campaign_of_five()
    figures = summarise(trials)
    assert (figures.single_found.count, figures.single_found.total) == (1, 2)
    assert (figures.effects_found.count, figures.effects_found.total) == (2, 4)
    assert (figures.clean.count, figures.honest.count, figures.failed) == (1, 1, 1)
    assert (figures.at_floor.count, figures.at_floor.total) == (3, 5)
    small = finished_trial(drawn({"vignetting": 7.9}), ["missed"], rms_nm=7.9)
    assert summarise([*trials, small]).single_found == figures.single_found


def test_the_scoreboard_survives_its_file_and_its_page_says_what_it_says(tmp_path):
    draws, trials = campaign_of_five()
    scoreboard = make_scoreboard(draws, trials)
    scoreboard.write(tmp_path)
    assert Scoreboard.read(tmp_path) == scoreboard
    page = tmp_path / "page.md"
    page.write_text(f"top\n{START}\nold\n{END}\nbottom\n", encoding="utf-8")
    publish(page, scoreboard)
    assert published(page) == as_markdown(scoreboard)
    assert page.read_text(encoding="utf-8").startswith("top\n")
    assert page.read_text(encoding="utf-8").endswith("\nbottom\n")
    table = [line for line in published(page).splitlines() if line.startswith("|")]
    # 8 figures and 6 planted effects, with two lines of head each.
    assert len(table) == 8 + 2 + 6 + 2
    report = write_report(scoreboard, tmp_path).read_text(encoding="utf-8")
    assert report.count("data:image/png;base64,") == 2
    assert (tmp_path / "scoreboard.csv").read_text(encoding="utf-8").count("\n") >= 7


def test_an_unfinished_campaign_is_not_published(tmp_path):
    draws, trials = campaign_of_five()
    page = tmp_path / "page.md"
    page.write_text(f"{START}\n{END}\n", encoding="utf-8")
    with pytest.raises(InputError, match="pending"):
        publish(page, make_scoreboard(draws, trials[:-1]))


def test_the_published_table_is_the_committed_scoreboard():
    if not (RESULTS / Scoreboard.FILE_NAME).exists():
        assert published(PAGE) == "Not run at full size yet."
        return
    scoreboard = Scoreboard.read(RESULTS)
    assert published(PAGE) == as_markdown(scoreboard)
    assert scoreboard.seed == REPORTED_SEED
    assert [t.draw for t in scoreboard.trials] == draw_trials(len(scoreboard.trials), scoreboard.seed)
    assert scoreboard.summary == summarise(scoreboard.trials)


# Campaign


def test_a_campaign_records_a_dying_trial_and_does_not_repeat_a_finished_one(tmp_path, monkeypatch, capsys):
    draws = campaign.open_campaign(tmp_path, count=4, seed=0, n_scans=12, size_px=64)
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
    options = {"workers": 2, "timeout_s": 7.0, "keep_data": False}
    campaign.run_campaign(tmp_path, draws, numbers=[0, 1], **options)
    campaign.run_campaign(tmp_path, draws, numbers=[0, 1, 2, 3], **options)
    assert sorted(started) == [0, 1, 2, 3]
    failures = [trial.failure for trial in campaign.finished(tmp_path, draws)]
    assert failures == ["", "the process ended with exit code -9", "not finished after 7 s", ""]
    assert capsys.readouterr().out.count("trial ") == 4


def test_a_folder_with_other_draws_is_refused(tmp_path):
    campaign.open_campaign(tmp_path, count=4, seed=0, n_scans=12, size_px=64)
    with pytest.raises(InputError, match="other settings"):
        campaign.open_campaign(tmp_path, count=4, seed=1, n_scans=12, size_px=64)


def test_fields_that_cannot_be_printed_are_refused_before_the_first_trial(tmp_path):
    with pytest.raises(InputError, match="at least 32"):
        campaign.open_campaign(tmp_path, count=4, seed=0, n_scans=12, size_px=8)
    assert not list(tmp_path.iterdir())


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

    draws = draw_trials(24, DEVELOPMENT_SEED)
    return next(draw for draw in draws if draw.kind == kind and all(map(findable, draw.knobs)))


def run_small(kind: Kind, out: Path) -> Trial:
    return run_trial(development_draw(kind), out, n_scans=12, size_px=192)


@pytest.mark.slow
def test_one_effect_is_found_or_in_the_set(tmp_path):
    trial = run_small("single", tmp_path)
    assert not trial.failure
    assert trial.outcomes[0].judgement in ("right", "set-contains-it"), trial.outcomes
    assert trial.errors is not None
    assert trial.errors.mae_to_floor <= 1.15


@pytest.mark.slow
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


@pytest.mark.slow
def test_an_effect_outside_the_catalogue_is_never_given_a_name(tmp_path):
    trial = run_small("off-catalogue", tmp_path)
    assert not trial.failure
    assert trial.outcomes[0].judgement != "named-a-cause", trial.named
    assert not [one for one in trial.named if one.verdict != "traced-to-covariate"]
