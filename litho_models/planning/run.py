"""From a closed loop to the plan of the next prints."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from litho_data.cards.card import Use
from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_folder
from litho_data.foundation.hashes import record_sha256
from litho_data.foundation.outputs import require_replaceable_folder
from litho_data.foundation.run_facts import run_info
from litho_data.layouts.patterns import flat, framed_ladder
from litho_data.layouts.random_layout import random_layout
from litho_data.register.coarse import SEARCH_BLUR_PX
from litho_data.register.orientation import rival_alignment
from litho_data.register.topography import predicted_topography
from litho_models.frozen.card import ModelCard
from litho_models.frozen.files import load_simulator
from litho_models.loop.open_questions import OpenQuestions
from litho_models.loop.run import MODEL_FOLDER
from litho_models.planning import answers
from litho_models.planning.folder import HOLDS, write_plan
from litho_models.planning.layouts import STEPS, TILE_PX, Limits, assemble, climb, score, starts
from litho_models.planning.record import NextPrint, PlannedQuestion, PlannedScan
from litho_models.planning.report import write_report
from litho_models.planning.rivalry import Place, PlannedPrint, Printing, Rivalry, Way
from litho_models.planning.ways import WORDS, choose_ways, ways_without_rivals

_TILES = 4
# Prints on which the rivals are compared at last; the others are made of the same tiles.
_JUDGED = 2
_SMALLEST_PX = 64
# Registration refuses layouts that repeat themselves by more than 0.9; a print shows them less clearly.
_MOST_REPEATING = 0.7


def next_print(
    loop: str | Path,
    out: str | Path,
    *,
    prints: int = 4,
    field_um: float = 51.2,
    seed: int = 0,
    steps: int = STEPS,
    layouts: Literal["optimised", "random"] = "optimised",
    cache: str | Path | None = None,
    report: Callable[[str], None] = lambda message: None,
) -> NextPrint | None:
    """Plan the prints and scans that decide what a closed loop left open; None if nothing is open.

    Args:
        loop: folder of a closed loop.
        out: folder of the plan, which appears when complete.
        prints: how many at most; ``field_um``: side of each.
        seed: of random layouts; ``steps``: of the ascent of each tile.
        layouts: ``random`` for a control: the same scans of layouts that nothing was optimised in.
        cache: folder where finished tiles are kept until the plan is there; beside ``out`` by default.
        report: told what happens, a sentence at a time.

    Raises:
        InputError: no closed loop, one from before questions were kept, or prints of an impossible size.
    """
    require_replaceable_folder(out, *HOLDS)
    folder = Path(loop)
    if not (folder / OpenQuestions.FILE_NAME).is_file():
        raise InputError(
            f"no {OpenQuestions.FILE_NAME} in {loop}",
            wanted="the folder of a closed loop",
            hint="litho-models close-loop writes it; results of earlier versions have none",
        )
    open_ = OpenQuestions.read(folder)
    if not open_.questions:
        return None
    card = ModelCard.read(folder / MODEL_FOLDER)
    size_px = round(field_um / card.pitch_um)
    if size_px < _SMALLEST_PX or prints < 1:
        raise InputError(
            "size of the prints",
            got=f"{prints} of {field_um:g} µm",
            wanted=f"at least one of {_SMALLEST_PX * card.pitch_um:g} µm",
        )
    base = load_simulator(folder / MODEL_FOLDER, card)
    limits = Limits.of(open_, card.pitch_um)
    printing = Printing(card.pitch_um, card.level_height_um, card.levels - 1, open_.write_field_um)
    asked = [q for q in open_.questions if len(q.rivals) > 1]
    rivalries = [Rivalry(q, base, printing, open_.noise) for q in asked]
    designer = _Designer(rivalries, limits, size_px, seed, steps, Path(cache or f"{out}-cache"), report)
    can_move = open_.write_field_um is not None and open_.write_field_um > field_um
    designer.choose(ways_without_rivals(open_.questions), can_move)
    tiles = designer.tiles(folder, prints) if layouts == "optimised" else designer.random_tiles(prints)
    levels = [assemble(tiles, number, size_px, limits) for number in range(prints)]
    orders = np.linspace(-0.5, 0.5, prints) if prints > 1 else np.zeros(1)
    planned = [
        PlannedPrint(_tensor(level), designer.ways, designer.place(i), float(order))
        for i, (level, order) in enumerate(zip(levels, orders, strict=True))
    ]
    report("comparing the rivals on the planned prints, and on random ones")
    random = [
        PlannedPrint(_tensor(_random(limits, size_px, seed + 101 + i)), one.ways, one.place, one.order)
        for i, one in enumerate(planned[:_JUDGED])
    ]
    judged = {
        rivalry.question.name: answers.of_rivals(rivalry, planned[:_JUDGED], random, tried, prints)
        for rivalry, tried in zip(rivalries, designer.tried, strict=True)
    }
    questions = [
        judged.get(q.name) or answers.of_others(q, open_, prints, len(designer.ways), size_px)
        for q in open_.questions
    ]
    scans, maps = _scans(planned, levels, questions, limits, printing, seed)
    plan = NextPrint(
        schema=NextPrint.SCHEMA,
        run=run_info([seed], len(scans)),
        dataset=open_.dataset,
        prints=prints,
        field_um=field_um,
        levels=(limits.lowest, limits.highest),
        cutoff_per_um=limits.cutoff_per_um,
        smallest_feature_um=0.5 / limits.cutoff_per_um,
        level_distance=_level_distance(levels, open_.level_share),
        starts=designer.chosen,
        scans=scans,
        questions=questions,
    )
    with atomic_folder(out) as target:
        write_plan(
            target,
            plan,
            maps,
            pitch_um=card.pitch_um,
            level_height_um=card.level_height_um,
            levels=card.levels,
            write_field_um=open_.write_field_um,
        )
        write_report(target, plan, levels, rivalries, planned[0])
    designer.forget()
    return plan


class _Designer:
    """Ways to scan, and tiles that climbed, for the questions that have rivals."""

    def __init__(
        self,
        rivalries: Sequence[Rivalry],
        limits: Limits,
        size_px: int,
        seed: int,
        steps: int,
        cache: Path,
        report: Callable[[str], None],
    ):
        self.rivalries, self.limits, self.seed, self.steps = rivalries, limits, seed, steps
        self.size_px, self.tile_px = size_px, min(TILE_PX, size_px)
        self.cache, self.report = cache, report
        self.ways: tuple[Way, ...] = (Way(),)
        self.tried: list[dict[str, float]] = []
        self.chosen: list[str] = []
        self._edge = False

    def choose(self, asked: Sequence[Way], can_move: bool) -> None:
        """Settle how every print is scanned: what any of the questions needs."""
        ways = [Way(), *asked]
        for rivalry in self.rivalries:
            own, place, tried = choose_ways(rivalry, _random(self.limits, self.tile_px, self.seed), can_move)
            ways += own
            self._edge |= place == "edge"
            self.tried.append(tried)
        self.ways = tuple(dict.fromkeys(ways))

    def place(self, number: int) -> Place:
        """Where a print lies in the write field: in turn at edge and centre, if that shows anything."""
        return "edge" if self._edge and number % 2 == 0 else "centre"

    def tiles(self, loop: Path, prints: int) -> list[np.ndarray]:
        """The tiles of all prints, soft levels; those of an interrupted run are taken as they are."""
        count = self._count(prints)
        if not self.rivalries:
            return self.random_tiles(prints)
        questions = (loop / OpenQuestions.FILE_NAME).read_text(encoding="utf-8")
        key = record_sha256(
            {
                "questions": questions,
                "ways": [vars(way) for way in self.ways],
                "settings": [self.tile_px, self.seed, self.steps, count],
            }
        )[:16]
        kept = self.cache / key
        kept.mkdir(parents=True, exist_ok=True)
        self._announce(count, sum((kept / f"{n}.npy").is_file() for n in range(count)))
        ranked = [self._ranked(rivalry) for rivalry in self.rivalries]
        tiles = []
        for number in range(count):
            which, rank = number % len(self.rivalries), number // len(self.rivalries)
            name, start = ranked[which][rank % len(ranked[which])]
            file = kept / f"{number}.npy"
            if not file.is_file():
                self.report(
                    f"tile {number + 1} of {count}: from {name}, for {self.rivalries[which].question.name}"
                )
                place: Place = "edge" if self._edge else "centre"
                tile = climb(
                    self.rivalries[which], start, self.ways, self.limits, place=place, steps=self.steps
                )
                with open(kept / f"{number}.part", "wb") as stream:
                    np.save(stream, tile)
                (kept / f"{number}.part").replace(file)
            tiles.append(np.load(file))
            self.chosen.append(name)
        return tiles

    def random_tiles(self, prints: int) -> list[np.ndarray]:
        """As many tiles of random structure."""
        self.chosen = ["random"]
        return [
            _random(self.limits, self.tile_px, self.seed + 31 + i).astype(np.float32)
            for i in range(self._count(prints))
        ]

    def _count(self, prints: int) -> int:
        return _TILES if self.size_px > self.tile_px else prints

    def forget(self) -> None:
        """Remove the kept tiles: the plan is there."""
        import shutil

        shutil.rmtree(self.cache, ignore_errors=True)

    def _ranked(self, rivalry: Rivalry) -> list[tuple[str, np.ndarray]]:
        found = [
            (name, level)
            for name, level in starts(self.tile_px, self.limits, self.seed)
            if _repeats(level) <= _MOST_REPEATING
        ]
        scores = {name: score(rivalry, level, self.ways) for name, level in found}
        return sorted(found, key=lambda one: -scores[one[0]])

    def _announce(self, count: int, done: int) -> None:
        """Say before the work begins how long it will take, from one step of it."""
        rivalry = max(self.rivalries, key=lambda one: len(one.pairs))
        level = _random(self.limits, self.tile_px, self.seed)
        clock = time.perf_counter()
        refitted = rivalry.refitted([PlannedPrint(_tensor(level), self.ways)])
        refit_s, clock = time.perf_counter() - clock, time.perf_counter()
        soft = _tensor(level).requires_grad_()
        rivalry.separations([PlannedPrint(soft, self.ways)], refitted).sum().backward()
        step_s = time.perf_counter() - clock
        tile_s = self.steps * step_s + (1 + self.steps / 10) * refit_s
        area = (self.size_px / self.tile_px) ** 2
        rest_s = len(self.rivalries) * (9 * refit_s + 8 * area * refit_s)
        total_s = (count - done) * tile_s + rest_s
        kept = f", {done} of {count} tiles are kept from an earlier run" if done else ""
        self.report(f"this takes about {max(1, round(total_s / 60))} min on one core{kept}")


def _repeats(level: np.ndarray) -> float:
    """How well a layout repeats itself, as its registration will judge it: 1 where any shift does as well."""
    topography = predicted_topography(level, SEARCH_BLUR_PX)
    return rival_alignment(topography, topography)


def _random(limits: Limits, size_px: int, seed: int) -> np.ndarray:
    level = random_layout(
        (size_px, size_px),
        levels=limits.highest + 1,
        cutoff_per_um=limits.cutoff_per_um,
        pitch_um=limits.pitch_um,
        seed=seed,
    )
    return np.maximum(level, np.uint8(limits.lowest))


def _tensor(level: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(level.astype(np.float32))


def _level_distance(levels: Sequence[np.ndarray], known: Sequence[float]) -> float:
    counts = np.bincount(np.concatenate([one.ravel() for one in levels]), minlength=len(known))
    return float(0.5 * np.abs(counts / counts.sum() - np.array(known)).sum())


def _scans(
    planned: Sequence[PlannedPrint],
    levels: Sequence[np.ndarray],
    questions: Sequence[PlannedQuestion],
    limits: Limits,
    printing: Printing,
    seed: int,
) -> tuple[list[PlannedScan], list[np.ndarray]]:
    """The rows of the table in the order of scanning, and the layout of each."""
    size_px = levels[0].shape[0]
    ladder = (
        framed_ladder(
            _random(limits, size_px, seed + 13), highest=limits.highest, lowest=limits.lowest, tread_px=30
        )
        if size_px >= 150
        else _random(limits, size_px, seed + 13)
    )
    references: list[tuple[Use, np.ndarray, str]] = [
        ("substrate", np.zeros((size_px, size_px), np.uint8), "zero, tilt and bow without a print"),
        ("flat", flat((size_px, size_px), level=(limits.lowest + limits.highest) // 2), "the noise floor"),
        ("steps", ladder, "height against level; on a step standard of known height the microscope's gain"),
    ]
    rows: list[tuple[str, str, Use, Way, float, str, np.ndarray]] = []
    for number, (use, level, why) in enumerate(references, start=1):
        rows.append((f"N0F{number}", "0", use, Way(), 0.0, why, level))
    for number, (one, level) in enumerate(zip(planned, levels, strict=True), start=1):
        reach_um = 0.0
        if one.place == "edge" and printing.write_field_um is not None:
            reach_um = (printing.write_field_um - size_px * printing.pitch_um) / 2
        for at, way in enumerate(one.ways, start=1):
            why = WORDS.get(way, "as the prints so far").split(":")[0]
            rows.append((f"N{number}F{at}", str(number), "dataset", way, reach_um, why, level))
    if any(q.kind == "generic" and "early print" in q.why for q in questions):
        why = "the first print once more at the end: what changed in between is the microscope's"
        rows.append((f"N1F{len(planned[0].ways) + 1}", "1", "dataset", Way(), 0.0, why, levels[0]))
    scans = [
        PlannedScan(
            id=scan_id,
            print=block,
            order=order,
            use=use,
            turned_deg=way.turned_deg,
            direction=-1 if way.backward else 1,
            tip=2 if way.new_tip else 1,
            field_x_um=reach_um,
            field_y_um=reach_um,
            why=why,
        )
        for order, (scan_id, block, use, way, reach_um, why, _) in enumerate(rows)
    ]
    return scans, [row[-1] for row in rows]
