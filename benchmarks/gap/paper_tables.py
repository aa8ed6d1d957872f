"""The tables of the paper's own search beside ours: as it was designed and as it was printed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.gap.tables import LABELS, SHOWN, TITLES, figure_digits, lead_text
from benchmarks.markdown_table import markdown_table

# Iterations of a design, and seeds: all of the paper's once, a third of them three times.
SEEDS_OF = {1000: 1, 333: 3}
SEARCHES = {"paper": ("--variant", "paper"), "ours": ()}
# PBL with all it predicts, as the paper's: what lies along the scan lines is in the other models, too.
ARMS = ("none", "physics", "fno", "pbl-scan-axis")
FAB = "fab"
# The models of the measured prints: machines that none of the arms knows.
MEASURED = {f"measured-{name}": name for name in ("physics", "fno", "pbl")}
NAMES = {"hoe": "hoe", "direct": "lens-direct", "computational": "lens-computational"}


def as_markdown(record: Mapping[str, Any]) -> str:
    """A table per kind of element, the searches side by side; of kinds without a result the names."""
    tasks = record["tasks"]
    made = made_kinds(tasks)
    texts = [_table(kind, tasks) for kind in made]
    if missing := [TITLES[name].lower() for kind, name in NAMES.items() if kind not in made]:
        texts.append(f"Not made yet: {'; '.join(missing)}.")
    return "\n\n".join(texts)


def task_name(kind: str, search: str, iterations: int) -> str:
    """Name of a task in the comparison and in its record."""
    return f"{NAMES[kind]}-{search}-{iterations}"


def made_kinds(tasks: Mapping[str, Any]) -> list[str]:
    """Kinds of elements with any finished task."""
    return [kind for kind, name in NAMES.items() if any(task.startswith(f"{name}-") for task in tasks)]


Made = Mapping[tuple[str, int], Mapping[str, Any]]


def _table(kind: str, tasks: Mapping[str, Mapping[str, Any]]) -> str:
    """One row per arm and judge; a column per search and budget."""
    figure, sign = next(iter(SHOWN[NAMES[kind]].items()))
    columns = [(search, iterations) for iterations in SEEDS_OF for search in SEARCHES]
    heads = [
        f"{search}, {iterations:,} iterations, {seeds} seed{'s' * (seeds > 1)}"
        for search, iterations in columns
        for seeds in (SEEDS_OF[iterations],)
    ]
    names = {column: task_name(kind, *column) for column in columns}
    made = {column: tasks[name] for column, name in names.items() if name in tasks}
    repeated = {column: task for column, task in made.items() if task["seeds"] > 1}
    judges = [
        judge for judge in (FAB, *MEASURED) if any(_by_arm(task, judge, figure) for task in made.values())
    ]
    rows = [
        (arm, judge, *(_cell(made.get(column, {}), arm, judge, figure) for column in columns))
        for judge in judges
        for arm in ARMS
    ]
    better = "more" if sign > 0 else "less"
    return f"### {TITLES[NAMES[kind]]}: {LABELS[figure]}, {better} is better\n\n" + markdown_table(
        ("designed with", "printed by", *heads),
        rows,
        _minutes_text(made),
        *([_layouts_text(repeated)] if repeated else []),
        *_leads(repeated, judges, figure, sign),
    )


def _by_arm(task: Mapping[str, Any], judge: str, figure: str) -> dict[str, Mapping[str, Any]]:
    """What one printer made of one figure, by the arm that it was designed with."""
    rows = task.get("summary", ())
    return {row["arm"]: row for row in rows if (row["judge"], row["figure"]) == (judge, figure)}


def _cell(task: Mapping[str, Any], arm: str, judge: str, figure: str) -> str:
    row = _by_arm(task, judge, figure).get(arm)
    if row is None:
        return "not made yet"
    digits, interval = figure_digits(figure), row["judged_ci95"]
    spread = f" ± {(interval[1] - interval[0]) / 2:.{digits}f}" if interval else ""
    return f"{row['designed_mean']:.{digits}f} → {row['judged_mean']:.{digits}f}{spread}"


def _minutes_text(made: Made) -> str:
    """What the searches took."""
    told = [
        f"{search} {iterations:,}: "
        + ", ".join(f"{arm} {minutes:.0f}" for arm, minutes in task["minutes"].items())
        for (search, iterations), task in made.items()
    ]
    return (
        "In design → as printed, means over seeds. Minutes of search, all seeds, one thread each: "
        f"{'; '.join(told)}."
    )


def _layouts_text(made: Made) -> str:
    """How rough the layouts are, and how far their prints are from what was expected."""
    told = [
        f"{search} {iterations:,}: "
        + ", ".join(
            f"{arm} {100 * share:.1f} % and {task['height_gap_nm'][FAB][arm]:.0f} nm"
            for arm, share in task["large_jump_share"].items()
        )
        for (search, iterations), task in made.items()
    ]
    return (
        "Neighbouring pixels of the layouts that differ by 8 levels or more, and the fab's prints against "
        f"those expected, rms: {'; '.join(told)}."
    )


def _leads(made: Made, judges: Sequence[str], figure: str, sign: int) -> Iterator[str]:
    """The best arm of every search, by each printer: by the fab its leads, else that over the next."""
    for (search, iterations), task in made.items():
        for judge in judges:
            means = {arm: row["judged_mean"] for arm, row in _by_arm(task, judge, figure).items()}
            if judge != FAB:
                means = dict(sorted(means.items(), key=lambda item: -sign * item[1])[:2])
            if means:
                yield f"{search}, {iterations:,}: {lead_text(task['paired'], means, figure, sign, judge)}"
