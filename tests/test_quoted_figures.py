"""Check that numbers quoted in the text of pages equal those in the committed records."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import coverage
from benchmarks.record import published

DOCS = Path(__file__).parents[1] / "docs"


def mixed_up(record: dict[str, Any]) -> list[str]:
    cases = record["cases"]
    named = sum(set(case["touched"]) <= set(case["named"]) for case in cases)
    assert not any(case["false"] or case["false_before"] for case in cases)
    return [f"{named} of {len(cases)} mistakes were named"]


def alarms(record: dict[str, Any]) -> list[str]:
    boards = [one for board in record["virtual"].values() for one in board["references"].items()]
    false = [one["false_alarms"] for _, one in boards]
    noticed = {n: [one["noticed"] / 10 for count, one in boards if count == n] for n in ("12", "24", "48")}
    # At most 1 % of the unchanged sets may raise an alarm, which is 10 of the 1,000 sets of a board.
    assert max(false) <= 10
    return [
        f"raised {min(false)} to {max(false)} false alarms",
        f"in {min(noticed['48']):.0f} to {max(noticed['48']):.0f} % of the sets with 48",
        f"{np.mean(noticed['24']):.0f} % of those with 24, and {min(noticed['12']):.0f} to "
        f"{max(noticed['12']):.0f} % of those with 12",
    ]


def warps(record: dict[str, Any]) -> list[str]:
    defects = [case["error_px"] for case in record["defects"] if case["what"] != "clean"]
    creep = [case["error_px"] for case in record["creep"]]
    return [
        f"{min(defects):.3f} to {max(defects):.3f} px",
        f"0.4–1.2 px to {min(creep):.2f}–{max(creep):.2f} px",
    ]


def tips(record: dict[str, Any]) -> list[str]:
    reaching = [case for case in record["cases"] if case["radius_um"] > 0.1]
    estimates = [ratio for case in reaching for ratio in case["estimates"]]
    bounds = [ratio for case in reaching for ratio in case["bounds"]]
    assert all(abs(ratio - 1) <= 0.1 for ratio in estimates)
    assert all(ratio >= 1 for ratio in bounds)
    lowest = min(share for case in reaching for share in case["untouched_uncertain"])
    return [
        f"all {len(estimates)} estimates are right to 10 %, and all {len(bounds)} bounds hold",
        f"at least {100 * lowest:.0f} % of untouched pixels",
    ]


def uncertainties(record: dict[str, Any]) -> list[str]:
    large = [one for one in record["conditions"] if not one["what"].startswith("256")]
    worst = next(one for one in record["conditions"] if one["what"].startswith("256 px, tilt and bow"))
    ratios, shares = [one["sd"] for one in large], [100 * one["within_68"] for one in large]
    return [
        f"deviation of {min(ratios):.2f} to {max(ratios):.2f}",
        f"the error of {min(shares):.0f} to {max(shares):.0f} % of the pixels is below 1 σ",
        f"this standard deviation is {worst['sd']:.2f}; in one of {worst['scans']} scans, it is "
        f"{max(worst['sd_of_scans']):.1f}",
    ]


def readers(record: dict[str, Any]) -> list[str]:
    files, bodies = record["files"], record["bodies"]["signatures"]
    assert sum(one.get("refused", 0) for one in bodies) == 50_000
    slowest = max(one["longest_s"] for one in bodies)
    return [
        f"Of {len(files)} files from other programs {sum(not one['refused'] for one in files)} were read",
        f"50,000 files, each with one of {len(bodies)} signatures and then random bytes, were all refused; "
        f"the slowest took {slowest:.1f} s",
    ]


def weights(record: dict[str, Any]) -> list[str]:
    assert all(abs(one["difference_nm"]) < 0.01 for one in record["models"])
    return ["differ by less than 0.01 nm"]


def workers(record: dict[str, Any]) -> list[str]:
    one, two = (next(run for run in record["runs"] if run["workers"] == n) for n in (1, 2))
    minutes = [10 * run["wall_s"] / 60 for run in (one, two)]
    return [
        f"took {one['wall_s']:.0f} s with one worker and {two['wall_s']:.0f} s with two, "
        f"{one['wall_s'] / two['wall_s']:.2f} × as fast",
        f"10,000 scans take {minutes[0]:.0f} and {minutes[1]:.0f} min",
        f"from {one['worker_mib']['0.1']:.0f} to {one['worker_mib']['1.0']:.0f} MiB",
    ]


def large(record: dict[str, Any]) -> list[str]:
    small, middle, last = record["measured"]
    return [
        f"an iteration takes {small['iteration_s']:.1f} s at 1,024 px, {middle['iteration_s']:.1f} s at "
        f"2,048 and {last['iteration_s']:.1f} s at 4,096 ({last['peak_memory_gib']:.2f} GiB)",
        f"{-100 * record['error']['iteration_s']:.0f} % (PBL) too short",
    ]


def papers_search(record: dict[str, Any]) -> list[str]:
    digits = {
        "hoe": ("si_psnr_db", 2),
        "lens-direct": ("cbr", 0),
        "lens-computational": ("mae_calibrated", 4),
    }
    rows = []
    for arm, title in (("none", "none"), ("physics", "Physics"), ("fno", "FNO")):
        cells = []
        for task, (figure, places) in digits.items():
            for search in ("paper", "ours"):
                summary = record["tasks"][f"{task}-{search}-333"]["summary"]
                (found,) = [
                    one
                    for one in summary
                    if (one["arm"], one["judge"], one["figure"]) == (arm, "fab", figure)
                ]
                cells.append(f"{found['judged_mean']:.{places}f}")
        rows.append(f"| {title} | {' | '.join(cells)} |")
    return rows


def quadrants(record: dict[str, Any]) -> list[str]:
    affine, _, seven = record["bounds"][:3]
    prints = np.array(list(affine["datum_of_prints_nm"].values()))
    return [
        f"this bound averages {affine['datum_size']['mean_nm']:.0f} nm",
        f"{prints[:4].mean():.0f} nm too high in the four prints",
        f"{-prints[4:].mean():.0f} nm too low in the two",
        f"the bound is {seven['datum_size']['mean_nm']:.0f} nm and the mean absolute error "
        f"{seven['mae']['mean_nm']:.0f} nm",
    ]


def papers_pbl(record: dict[str, Any]) -> list[str]:
    names = {"none": "none", "physics": "Physics", "pbl": "our PBL", "paper": "paper's PBL"}

    def line(judge: str) -> str:
        rows = [row for row in record["rows"] if row["printed_by"] == judge != row["designed_with"]]
        rows.sort(key=lambda row: row["si_psnr_db"])
        return ", ".join(f"{names[row['designed_with']]} {row['si_psnr_db']:.1f}" for row in rows)

    return [f"printed by the FNO: {line('fno')}; printed by Physics: {line('physics')} |"]


QUOTED: dict[str, tuple[str, Callable[[dict[str, Any]], list[str]]]] = {
    "mixed-up/mixed_up.json": ("own_data.md", mixed_up),
    "drift-alarm/drift_alarm.json": ("checking.md", alarms),
    "registration/registration.json": ("registration.md", warps),
    "tip/tip.json": ("roughness.md", tips),
    "height-sigma/height_sigma.json": ("dataset_store.md", uncertainties),
    "readers/readers.json": ("readers.md", readers),
    "neural-lithography/weights.json": ("evaluation.md", weights),
    "build/cluster.json": ("cluster.md", workers),
    "large/pbl.json": ("large.md", large),
    "gap/paper_search.json": ("gap.md", papers_search),
    "paper/pairs.json": ("paper.md", quadrants),
    "paper/paper_pbl.json": ("paper.md", papers_pbl),
}


@pytest.mark.parametrize("file", QUOTED)
def test_a_page_quotes_its_record(file):
    page, said = QUOTED[file]
    text = " ".join((DOCS / page).read_text("utf-8").split())
    assert f"](results/{file})" in text
    assert [
        one for one in said(json.loads((DOCS / "results" / file).read_text("utf-8"))) if one not in text
    ] == []


def test_the_table_of_coverage_is_its_record():
    record = json.loads(coverage.RESULT.read_text("utf-8"))
    assert published(coverage.PAGE, "coverage") == coverage.text_of(record)


def test_the_results_page_quotes_the_draws_of_the_papers_split_and_the_seeds():
    folder = DOCS / "results" / "neural-lithography"
    text = " ".join((folder / "README.md").read_text("utf-8").split())

    def errors_nm(file: str) -> dict[str, float]:
        scores = json.loads((folder / file).read_text("utf-8"))["scores"]
        return {score["model"]: score["mae_datum_free_nm"] for score in scores}

    draws = [errors_nm(f"benchmark_paper_{draw}.json") for draw in range(4)]
    low, high = ({name: end(draw[name] for draw in draws) for name in draws[0]} for end in (min, max))
    assert (
        f"FNO has {low['fno']:.2f} to {high['fno']:.2f} nm, PBL {low['pbl']:.2f} to {high['pbl']:.2f}" in text
    )
    assert f"Physics {low['physics']:.2f} to {high['physics']:.2f} nm" in text
    ahead = [draw["pbl"] - draw["fno"] for draw in draws]
    assert f"better than PBL by {min(ahead):.2f} to {max(ahead):.2f} nm in all four draws" in text
    prints = errors_nm("benchmark_prints.json") | errors_nm("benchmark_prints_pbl.json")
    shown = {"PBL": "pbl", "`features`": "features", "`linear`": "linear", "Physics": "physics"}
    for name, model in shown.items():
        assert f"{name} {prints[model]:.2f}" in text


def test_the_page_on_training_quotes_the_recipes():
    text = " ".join((DOCS / "evaluation.md").read_text("utf-8").split())
    folder = DOCS / "results" / "recipes"

    def error_nm(file: Path, model: str) -> float:
        scores = json.loads(file.read_text("utf-8"))["scores"]
        return next(score["mae_datum_free_nm"] for score in scores if score["model"] == model)

    pbl, fno, physics = (
        error_nm(folder / f"paper-{one}" / "benchmark.json", one) for one in ("pbl", "fno", "physics")
    )
    assert f"PBL {pbl:.2f} nm, FNO {fno:.2f} nm and Physics {physics:.2f} nm" in text
    fast = DOCS / "results" / "neural-lithography" / "benchmark_paper_0.json"
    pbl, fno, physics = (error_nm(fast, one) for one in ("pbl", "fno", "physics"))
    assert f"{pbl:.2f}, {fno:.2f} and {physics:.2f} nm" in text


def test_the_page_on_blind_boards_has_the_entries_as_they_were_judged():
    boards = [
        json.loads((DOCS / "results" / "blind-board" / f"{name}.json").read_text("utf-8"))
        for name in ("plain_loop", "close_loop")
    ]

    def cell(trial: dict[str, Any] | None) -> str:
        if trial is None:
            return "not run yet"
        false = ["false name `{}`".format("` or `".join(name.split(" | "))) for name in trial["false_names"]]
        ratio = trial["errors"]["after_nm"] / trial["errors"]["floor_nm"]
        return ", ".join([*(one["verdict"] for one in trial["outcomes"]), *false, f"{ratio:.2f} ×"])

    rows = []
    for trial in boards[0]["trials"]:
        number = trial["draw"]["number"]
        cells = [next((t for t in one["trials"] if t["draw"]["number"] == number), None) for one in boards]
        hidden = ", ".join(f"`{one['name']}`" for one in trial["draw"]["causes"]) or "nothing"
        rows.append(f"| {hidden} ({trial['draw']['kind']}) | {' | '.join(map(cell, cells))} |")
    page = (DOCS / "blind_board.md").read_text("utf-8")
    assert "\n".join(["| hidden | plain_loop.py | close-loop |", "|---|---|---|", *rows]) in page
