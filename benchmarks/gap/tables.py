"""Make the Markdown tables of the comparison from the record of its results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.gap.tasks import FAB, MEASURED, REDUCED

# The scores that the table of each task shows, with +1 if a higher score is better and -1 if a lower one is.
SHOWN = {
    "hoe": {"si_psnr_db": +1, "ssim": +1, "eff_signal": +1},
    "lens-direct": {"cbr": +1, "strehl": +1, "focusing_efficiency": +1},
    "lens-computational": {"mae_calibrated": -1, "mae_design": -1, "strehl": +1},
}
LABELS = {
    "si_psnr_db": "SI-PSNR (dB)",
    "ssim": "SSIM",
    "eff_signal": "power on the signal",
    "cbr": "centre-to-background ratio",
    "strehl": "Strehl ratio",
    "focusing_efficiency": "focusing efficiency",
    "mae_calibrated": "image MAE with the calibrated PSF",
    "mae_design": "image MAE with the design PSF",
}
_FIGURES = {
    "hoe": "Images before and after printing, and the centre of each print",
    "lens-direct": "PSFs and their spectra before and after printing",
    "lens-computational": "PSFs and their spectra before and after printing",
}
TITLES = {
    "hoe": "Hologram",
    "lens-direct": "Lens, direct imaging",
    "lens-computational": "Lens, computational imaging",
    "hoe-measured": "The same hologram through the models of the measured prints",
}


def as_markdown(record: Mapping[str, Any]) -> str:
    """Return all tables of a record, each with the conditions under which it was made."""
    parts = [_fab_text(record)] if record["models"] else []
    for name, task in record["tasks"].items():
        if not name.endswith(REDUCED):
            parts.append(_task_part(name, task, _rows(record, name), _best_arm(record, name)))
    minutes = sum(sum(task["minutes"].values()) for task in record["tasks"].values())
    designs = sum(len(task["seeds"]) * len(task["minutes"]) for task in record["tasks"].values())
    parts.append(
        f"The searches for all {designs} designs took {minutes / 60:.1f} hours in total, each in one thread "
        "of a busy computer."
    )
    return "\n\n".join(parts)


def _fab_text(record: Mapping[str, Any]) -> str:
    effort = record["plan"]["effort"]
    knobs = ", ".join(f"`{name}` {value:g}" for name, value in record["plan"]["print_knobs"].items())
    return (
        f"Strengths of the fab's effects (10 nm rms each): {knobs}. The models were trained on "
        f"{record['training_scans']} of {effort['scans']} scans of its prints, each {effort['scan_px']} px "
        f"wide. The networks were trained for {effort['training_steps']:,} steps. "
        f"{_precision_text(effort['search_precision'])} In the tables of designs, a cell contains the score "
        "predicted by the model of the design, an arrow, the score after printing, and ± half of its 95 % "
        "interval (Student's t) over seeds.\n\n" + _model_table(record["models"])
    )


def _precision_text(search: str) -> str:
    if search == "float32":
        return "The searches, the prints and the scores were computed in float32."
    return f"The searches were computed in {search}, the prints and the scores in float32."


def _rows(record: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    return [row for row in record["summary"] if row["task"] == name]


def _kind(name: str) -> str:
    return next(kind for kind in SHOWN if name.startswith(kind))


def _independent(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the judges that are no arms."""
    arms = {row["arm"] for row in rows}
    return [judge for judge in dict.fromkeys(row["judge"] for row in rows) if judge not in arms]


def _best_arm(record: Mapping[str, Any], name: str) -> str:
    """Return a text that names the best arm of a task, from the same task at reduced size, if there is one.
    The reduced task has more seeds.

    The text is empty if there is only one seed, or if the judges are arms themselves. Then, each judge
    prefers the designs made with it.
    """
    reduced = f"{name}{REDUCED}" if f"{name}{REDUCED}" in record["tasks"] else name
    task, rows = record["tasks"][reduced], _rows(record, reduced)
    judges = _independent(rows)
    if not judges or len(task["seeds"]) < 2:
        return ""
    figure, sign = next(iter(SHOWN[_kind(name)].items()))
    means = {
        row["arm"]: row["judged"] for row in rows if (row["judge"], row["figure"]) == (judges[0], figure)
    }
    told = lead_text(task["paired"], means, figure, sign, judges[0])
    if reduced == name:
        return told
    scale, count = record["plan"]["effort"]["reduced_to"], len(task["seeds"])
    return f"The task was repeated with elements {scale:g} times as wide and {count} seeds. {told}"


def _task_part(name: str, task: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], verdict: str) -> str:
    kind = _kind(name)
    shown = SHOWN[kind]
    values = {(row["arm"], row["judge"], row["figure"]): row for row in rows}
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    judges = _independent(rows)
    independent = bool(judges)
    if not independent:
        judges = [judge for judge in dict.fromkeys(row["judge"] for row in rows) if judge != "none"]
        shown = dict(list(shown.items())[:1])
    # With one judge, a table has a column for each score. With several judges, it has a column for each
    # judge, with the first score.
    heads = [f"{LABELS[figure]}, designed → printed by {judge}" for judge in judges for figure in shown]
    # A lens is compared with a perfect lens, whose Strehl ratio is 1. A hologram is compared with the best
    # image that any search reached before printing. Its rms image error relative to the error of this image
    # follows from the two SI-PSNR.
    ceiling = task.get("ceiling") if independent else None
    heads += ["loss of Strehl ratio against a perfect lens"] if "strehl" in shown else []
    above = "excess rms image error over the best image before printing, printed by"
    heads += [f"{above} {judge}" for judge in judges if ceiling]
    if ceiling:
        reached_db = [row["designed"] for row in rows if row["figure"] == "si_psnr_db"]
        best_db = max([ceiling["si_psnr_db"], *reached_db])
    lines = [f"| designed with | {' | '.join(heads)} |", "|---" * (1 + len(heads)) + "|"]
    for arm in arms:
        cells = [
            _cell(values[arm, judge, figure], figure_digits(figure)) for judge in judges for figure in shown
        ]
        if "strehl" in shown:
            cells.append(f"{100 * (1 - values[arm, judges[0], 'strehl']['judged']):.1f} %")
        if ceiling:
            short_db = [best_db - values[arm, judge, "si_psnr_db"]["judged"] for judge in judges]
            cells += [f"{100 * (10 ** (db / 20) - 1):.0f} %" for db in short_db]
        lines.append(f"| {arm} | {' | '.join(cells)} |")
    seeds = len(task["seeds"])
    told = f"{seeds} seed{'s' * (seeds > 1)}"
    head = f"### {TITLES[name]}\n\n{task['iterations']} iterations for every design, {told}."
    if ceiling:
        reached = ", ".join(f"{LABELS[figure]} {ceiling[figure]:.3f}" for figure in SHOWN[kind])
        head += f" A continuous phase on the same grid, without printer or levels, reaches {reached}."
        head += f" The best image before printing has an SI-PSNR of {best_db:.3f} dB."
    head += "\n\n"
    place = f"results/gap/{FAB if independent else MEASURED}/{figure_file(name)}"
    picture = f"![{_FIGURES[kind]}]({place})"
    return "\n\n".join(part for part in (head + "\n".join(lines), verdict, picture) if part)


def figure_file(name: str) -> str:
    """Return the file name of the figure of a task."""
    return f"{name}.{'jpg' if name.startswith('hoe') else 'png'}"


def figure_digits(figure: str) -> int:
    """Return the number of decimals with which a score is shown. Image errors need five, because they are a
    few hundredths and differ by 1 %.
    """
    if figure == "cbr":  # this ratio has values from hundreds to thousands
        return 0
    return 5 if figure.startswith("mae") else 3


def _cell(row: Mapping[str, Any], digits: int) -> str:
    text = f"{row['designed']:.{digits}f} → {row['judged']:.{digits}f}"
    if row["low"] is None:
        return text
    return f"{text} ± {(row['high'] - row['low']) / 2:.{digits}f}"


def lead_text(
    paired: Sequence[Mapping[str, Any]], means: Mapping[str, float], figure: str, sign: int, judge: str
) -> str:
    """Return a text that names the arm with the best score after printing, and its lead over each other arm.

    Args:
        paired: differences between two arms in the scores of the judges, paired by seed, with their
            intervals.
        means: mean score of each arm after printing.
        figure: name of the score.
        sign: +1 if a higher score is better, -1 if a lower one is.
        judge: the judge that printed the designs.
    """
    digits = figure_digits(figure)
    best = max(means, key=lambda arm: sign * means[arm])
    against = []
    for item in paired:
        pair = (item["arm"], item["against"])
        if (item["judge"], item["figure"]) != (judge, figure) or best not in pair or not {*pair} <= {*means}:
            continue
        # The lead is positive if the best arm is better, also for scores where lower is better.
        other, turn = (pair[1], sign) if best == pair[0] else (pair[0], -sign)
        low, high = sorted(turn * end for end in item["ci95"])
        open_ = "" if low * high > 0 else ", which includes 0"
        interval = f"({low:.{digits}f} to {high:.{digits}f}{open_})"
        designs = "without a model" if other == "none" else f"with {other}"
        against.append(f"by {turn * item['mean']:.{digits}f} {interval} than {designs}")
    name, _, unit = LABELS[figure].removesuffix(")").partition(" (")
    return (
        f"Of the layouts printed by {judge}, those designed with {best} have the best {name}. It is better "
        f"{', '.join(against)} ({f'differences in {unit}, ' if unit else ''}with 95 % intervals)."
    )


def _model_table(models: Mapping[str, Mapping[str, float]]) -> str:
    lines = [
        "| model | error on unseen prints of the fab, with the offset of each scan fitted | "
        "the same error, with offset, gain, tilt and bow fitted |",
        "|---|---|---|",
    ]
    lines += [
        f"| {name} | {item['offset']:.2f} nm | {item['full']:.2f} nm |" for name, item in models.items()
    ]
    return "\n".join(lines)
