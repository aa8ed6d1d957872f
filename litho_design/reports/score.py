"""Write the report of one score."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from litho_data.reports.page import Page
from litho_design.judging.photographs import LensPhotoScore
from litho_design.judging.score import Judgement, ScoreResult
from litho_design.reports.advice import WORDS, called, headline, spread_sentence
from litho_design.reports.pictures import Panel, panels_figure
from litho_design.reports.tables import meanings, score_table
from litho_design.tasks.task import registered_task


def write_score_report(folder: Path, result: ScoreResult, judgement: Judgement) -> Path:
    """Write ``report.html`` and ``scores.csv``."""
    page = Page(
        "Score of a printable layout",
        f"Designed through “{result.designed_with.name}”, printed by "
        f"{', '.join(called(score.judge.name) for score in result.scores)}.",
        run=result,
        facts={"layout, SHA-256": result.layout_sha256, "seeds": ", ".join(map(str, result.seeds))},
        words=WORDS,
    )
    page.verdict(_verdict(result))
    page.figure(
        panels_figure([[Panel(*shown, judgement.side_um) for shown in judgement.pictures.items()]]),
        "The target image, and the image behind each print, scaled to match the target. For a lens, the "
        "images show the square root of the PSF.",
    )
    if judgement.photos:
        page.figure(
            panels_figure([[Panel(*shown, judgement.frame_um) for shown in judgement.photos.items()]]),
            "The object, its photograph through the printed lens, and the deconvolved photographs, each "
            "scaled for the smallest error. The scores refer to this one object only.",
        )
    for score in result.scores:
        for remark in score.remarks():
            page.paragraph(f"{score.judge.name}: {remark}.")
    page.heading("All scores", folded=True)
    columns = {f"{result.designed_with.name} (design)": result.designed}
    for score in result.scores:
        name = score.judge.name + ("" if score.independent else " (not independent)")
        columns[name] = score.figures
        if score.uncertainty is not None:
            columns[f"± {score.judge.name}"] = score.uncertainty
    labels = meanings(registered_task(result.task).score_type) | meanings(LensPhotoScore)
    page.table(
        score_table(columns | (result.baselines or {}), labels),
        "Figures by judge (± one standard deviation) and figures of the baselines",
        "scores.csv",
        digits=3,
    )
    heights = [
        {
            "printed by": score.judge.name,
            "mean difference from the designed print, nm": 1000 * score.mean_height_difference_um,
            "rms difference, nm": 1000 * score.rms_height_difference_um,
        }
        for score in result.scores
        if score.mean_height_difference_um is not None and score.rms_height_difference_um is not None
    ]
    page.table(
        heights,
        "Differences between each print and the print that the design expected",
        "heights.csv",
        digits=1,
    )
    return page.write(folder)


def _verdict(result: ScoreResult) -> str:
    expected = f"The design expects {headline(result.designed)}. "
    if not any(score.independent for score in result.scores):
        return expected + (
            "No judge is independent of the design, so these scores only repeat predictions of models that "
            "its search used."
        )
    told = [
        f"{called(score.judge.name)}: {headline(score.figures, score.uncertainty)}"
        f"{_against(score.figures, result.designed)}"
        for score in result.scores
        if score.independent
    ]
    return f"{expected}Judged independently, by {'; by '.join(told)}. {_spread(result)}"


def _spread(result: ScoreResult) -> str:
    """Return a sentence that compares the main score in the record of the design with the main scores that
    the judging models predict.

    The sentence is empty if fewer than two models judge.
    """
    task = registered_task(result.task)
    figure = next((one for one in task.headline if one in result.designed), "")
    models, own = [one for one in result.scores if one.kind == "model"], result.designed_with
    taken = any(one.judge.name == own.name and one.judge.sha256 != own.sha256 for one in models)
    name = f"{own.name} of the design" if taken else own.name
    by_model = {name: result.designed.get(figure)} | {
        one.judge.name: one.figures.get(figure) for one in models
    }
    known = {name: value for name, value in by_model.items() if value is not None}
    return spread_sentence(figure, known, figure in task.errors, result.gain) if len(known) > 2 else ""


def _against(judged: Mapping[str, float], expected: Mapping[str, float]) -> str:
    """Return a text that states the difference between the judged and the expected SI-PSNR. The text is empty
    if the task has no SI-PSNR.
    """
    name = "si_psnr_db"
    if name not in judged or name not in expected:
        return ""
    more_db = judged[name] - expected[name]
    return f" ({abs(more_db):.1f} dB {'higher' if more_db > 0 else 'lower'} than expected)"
