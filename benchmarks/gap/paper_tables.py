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
    made = [kind for kind, name in NAMES.items() if any(task.startswith(f"{name}-") for task in tasks)]
    texts = [_table(kind, tasks) for kind in made]
    if missing := [TITLES[name].lower() for kind, name in NAMES.items() if kind not in made]:
        texts.append(f"Not made yet: {'; '.join(missing)}.")
    return "\n\n".join(texts)


def _table(kind: str, tasks: Mapping[str, Mapping[str, Any]]) -> str:
    """One row per arm and judge; a column per search and budget."""
    figure, sign = next(iter(SHOWN[NAMES[kind]].items()))
    columns = [(search, iterations) for iterations in SEEDS_OF for search in SEARCHES]
    heads = [
        f"{search}, {iterations:,} iterations, {seeds} seed{'s' * (seeds > 1)}"
        for search, iterations in columns
        for seeds in (SEEDS_OF[iterations],)
    ]
    found = [tasks.get(f"{NAMES[kind]}-{search}-{iterations}") for search, iterations in columns]
    judges = [
        judge for judge in (FAB, *MEASURED) if any(task and _by_arm(task, judge, figure) for task in found)
    ]
    rows = [(arm, judge, *_cells(found, arm, judge, figure)) for judge in judges for arm in ARMS]
    better = "more" if sign > 0 else "less"
    return f"### {TITLES[NAMES[kind]]}: {LABELS[figure]}, {better} is better\n\n" + markdown_table(
        ("designed with", "printed by", *heads),
        rows,
        _minutes_text(columns, found),
        *_layout_texts(columns, found),
        *_leads(columns, found, figure, sign, judges),
    )


def _cells(found: Sequence[Mapping[str, Any] | None], arm: str, judge: str, figure: str) -> Iterator[str]:
    for task in found:
        row = _by_arm(task, judge, figure).get(arm) if task else None
        if row is None:
            yield "not made yet"
            continue
        digits, interval = figure_digits(figure), row["judged_ci95"]
        spread = f" ± {(interval[1] - interval[0]) / 2:.{digits}f}" if interval else ""
        yield f"{row['designed_mean']:.{digits}f} → {row['judged_mean']:.{digits}f}{spread}"


def _leads(
    columns: Sequence[tuple[str, int]],
    found: Sequence[Mapping[str, Any] | None],
    figure: str,
    sign: int,
    judges: Sequence[str],
) -> Iterator[str]:
    """The best arm of every search that ran from several seeds: by the fab its leads, else over the next."""
    for (search, iterations), task in zip(columns, found, strict=True):
        if task is None or task["seeds"] == 1:
            continue
        for judge in judges:
            means = {arm: row["judged_mean"] for arm, row in _by_arm(task, judge, figure).items()}
            if judge != FAB:
                means = dict(sorted(means.items(), key=lambda item: -sign * item[1])[:2])
            yield f"{search}, {iterations:,}: {lead_text(task['paired'], means, figure, sign, judge)}"


def _by_arm(task: Mapping[str, Any], judge: str, figure: str) -> dict[str, Mapping[str, Any]]:
    """What one printer made of one figure, by the arm that it was designed with."""
    return {row["arm"]: row for row in task["summary"] if (row["judge"], row["figure"]) == (judge, figure)}


def _layout_texts(
    columns: Sequence[tuple[str, int]], found: Sequence[Mapping[str, Any] | None]
) -> Iterator[str]:
    """How rough the layouts are, and how far their prints are from what was expected."""
    for (search, iterations), task in zip(columns, found, strict=True):
        if task is not None and task["seeds"] > 1:
            gaps = task["height_gap_nm"][FAB]
            told = [
                f"{arm} {100 * share:.1f} %, {gaps[arm]:.0f} nm"
                for arm, share in task["large_jump_share"].items()
            ]
            yield (
                f"{search}, {iterations:,}: neighbouring pixels of the layouts that differ by 8 levels or "
                f"more, and the fab's prints against those expected, rms: {'; '.join(told)}."
            )


def _minutes_text(columns: Sequence[tuple[str, int]], found: Sequence[Mapping[str, Any] | None]) -> str:
    """What the searches took."""
    told = [
        f"{search} {iterations:,}: "
        + ", ".join(f"{arm} {minutes:.0f}" for arm, minutes in task["minutes"].items())
        for (search, iterations), task in zip(columns, found, strict=True)
        if task is not None
    ]
    return (
        "In design → as printed, means over seeds. Minutes of search, all seeds, one thread each: "
        f"{'; '.join(told)}."
    )
