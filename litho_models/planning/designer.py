"""Which scans every print gets, and the tiles of its layout, kept one by one: a killed run goes on."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from litho_data.foundation.hashes import record_sha256
from litho_data.layouts.random_layout import random_layout
from litho_data.register.coarse import SEARCH_BLUR_PX
from litho_data.register.orientation import rival_alignment
from litho_data.register.topography import predicted_topography
from litho_models.planning.layouts import TILE_PX, Limits, climb, score, starts
from litho_models.planning.questions import OpenQuestions, Question
from litho_models.planning.rivalry import Place, Rivalry, Way

TURNED = Way(turned_deg=90)
_EXTRAS = (TURNED, Way(backward=True), Way(new_tip=True), Way(fine=True))
_MOST_EXTRAS = 2
# A further scan is worth its time if it brings rivals apart by this factor.
_WORTH = 1.3
# Less dose keeps the exposure of every level among those that the models know; more would not.
SECOND_DOSE = 0.8
# Below this many standard deviations a layout shows nothing of the difference.
_NOTHING = 0.3
WORDS = {
    TURNED: "turned by 90°: what lies along the scan lines turns with them, what lies along the written "
    "lines does not",
    Way(backward=True): "in the other direction: what lags behind changes sides",
    Way(
        new_tip=True
    ): "with a new, sharp tip: what the tip adds is gone, what was printed stays; turning the "
    "print shows nothing of a round tip",
    Way(fine=True): "with pixels of half the size, as much time for each: what the microscope blurs or "
    "delays is half as long, what was printed stays",
}


class Chosen(NamedTuple):
    """How the prints of a question are made and scanned.

    ``ways``: scans of each; ``place``: in the write field; ``second_dose``: whether every other print gets
    less dose; ``tried``: separation in standard deviations by one scan, and by each way beside it.
    """

    ways: tuple[Way, ...]
    place: Place
    second_dose: bool
    tried: dict[str, float]


def choose(rivalry: Rivalry, level: np.ndarray, can_move: bool) -> Chosen:
    """What brings the rivals of a question apart.

    Args:
        rivalry: the rivals.
        level: a layout to try the ways on.
        can_move: whether the write field is larger than a print and known.
    """
    ways: tuple[Way, ...] = (Way(),)
    reached = score(rivalry, level, ways)
    tried = {"one plain scan": reached}
    for _ in range(_MOST_EXTRAS):
        scores = {}
        for extra in _EXTRAS:
            if extra not in ways:
                scores[extra] = score(rivalry, level, (*ways, extra))
                # What each does beside one plain scan; later ones only add to it.
                tried.setdefault(f"a scan {WORDS[extra].split(':')[0]}", scores[extra])
        best = max(scores, key=lambda way: scores[way])
        if scores[best] < max(_WORTH * reached, _NOTHING):
            break
        ways, reached = (*ways, best), scores[best]
    place: Place = "centre"
    if can_move:
        at_edge = score(rivalry, level, ways, "edge")
        tried["at the edge of the write field"] = at_edge
        if at_edge >= max(_WORTH * reached, _NOTHING):
            place = "edge"
    at_one, at_two = (score(rivalry, level, ways, place, (1.0, dose)) for dose in (1.0, SECOND_DOSE))
    tried |= {"two prints so scanned": at_one, f"the second of them at {SECOND_DOSE:g} of the dose": at_two}
    return Chosen(ways, place, at_two >= max(_WORTH * at_one, _NOTHING), tried)


def ways_without_rivals(questions: Sequence[Question]) -> tuple[Way, ...]:
    """Scans asked for by questions whose answer depends on no layout."""
    # A scan turned by 90 degrees is a repeat as well: the print was taken out and put back.
    return (TURNED,) if any(q.kind in ("lines", "per-scan") for q in questions) else ()


_TILES = 4
# Registration refuses layouts that repeat themselves by more than 0.9; a print shows them less clearly.
_MOST_REPEATING = 0.7


class Designer:
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
        self._edge = self._second_dose = False

    def choose(self, asked: Sequence[Way], can_move: bool) -> None:
        """Settle how every print is scanned: what any of the questions needs."""
        ways = [Way(), *asked]
        for rivalry in self.rivalries:
            found = choose(rivalry, random_level(self.limits, self.tile_px, self.seed), can_move)
            ways += found.ways
            self._edge |= found.place == "edge"
            self._second_dose |= found.second_dose
            self.tried.append(found.tried)
        self.ways = tuple(dict.fromkeys(ways))

    def place(self, number: int) -> Place:
        """Where a print lies in the write field: in turn at edge and centre, if that shows anything."""
        return "edge" if self._edge and number % 2 == 0 else "centre"

    def dose(self, number: int) -> float:
        """Of a print, relative: every other one gets less, if that shows anything."""
        return SECOND_DOSE if self._second_dose and number % 2 else 1.0

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
        done = sum((kept / f"{number}.npy").is_file() for number in range(count))
        self.report(f"{done} of {count} tiles are kept from an earlier run")
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
            random_level(self.limits, self.tile_px, self.seed + 31 + i).astype(np.float32)
            for i in range(self._count(prints))
        ]

    def _count(self, prints: int) -> int:
        return _TILES if self.size_px > self.tile_px else prints

    def forget(self) -> None:
        """Remove the kept tiles: the plan is there."""
        shutil.rmtree(self.cache, ignore_errors=True)

    def _ranked(self, rivalry: Rivalry) -> list[tuple[str, np.ndarray]]:
        found = [
            (name, level)
            for name, level in starts(self.tile_px, self.limits, self.seed)
            if _repeats(level) <= _MOST_REPEATING
        ]
        scores = {name: score(rivalry, level, self.ways) for name, level in found}
        return sorted(found, key=lambda one: -scores[one[0]])


def _repeats(level: np.ndarray) -> float:
    """How well a layout repeats itself, as its registration will judge it: 1 where any shift does as well."""
    topography = predicted_topography(level, SEARCH_BLUR_PX)
    return rival_alignment(topography, topography)


def random_level(limits: Limits, size_px: int, seed: int) -> np.ndarray:
    level = random_layout(
        (size_px, size_px),
        levels=limits.highest + 1,
        cutoff_per_um=limits.cutoff_per_um,
        pitch_um=limits.pitch_um,
        seed=seed,
    )
    return np.maximum(level, np.uint8(limits.lowest))


def as_tensor(level: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(level.astype(np.float32))
