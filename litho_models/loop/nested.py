"""Nested selection: everything is chosen without the scans that it is judged on.

The loop's own errors are of parameters that have not seen a scan; what was chosen has seen all of them. Here
the choice itself is made on the other scans, once for each part that is held out.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from torch import nn

from litho_data.foundation.commands import progress
from litho_data.foundation.files import atomic_folder
from litho_data.foundation.workers import run_jobs
from litho_models.effects import CATALOGUE
from litho_models.fitting.checkpoint import reading_kept
from litho_models.fitting.fit import scans_sha256
from litho_models.loop.choice import Choice, choose
from litho_models.loop.equal_terms import BeforeAfter, TermSet, predictions_elsewhere, term_sets
from litho_models.loop.prepared import PreparedScan
from litho_models.loop.study import DATUM_FREE, Score, Study, deal, names_to_terms, score
from litho_models.splits.folds import grouped_folds, leave_one_print_out

_CHOSEN, _PREDICTIONS = "chosen.json", "before_and_after_{:03d}.npy"

HeldOut = Literal["folds", "prints"]


@dataclass(frozen=True)
class Part:
    """One selection: what it chose, and the predictions (y, x), µm, of the scans that it has not seen.

    ``named``, ``generic``, ``accepted``: named effects, generic terms, effects of single scans. ``before``,
    ``after``: maps by the base model and with all that was chosen, in the order of ``scans``.
    """

    scans: list[PreparedScan]
    named: list[str]
    generic: list[str]
    accepted: list[str]
    before: list[np.ndarray]
    after: list[np.ndarray]


@dataclass(frozen=True)
class Nested:
    """All selections; ``scores``: every scan by the one that has not seen it, in the order of ``parts``."""

    held_out: HeldOut
    parts: list[Part]
    scores: dict[TermSet, BeforeAfter]

    @property
    def prints(self) -> list[str]:
        """The print of each scan, in the order of the scores."""
        return [scan.stored.print_id for part in self.parts for scan in part.scans]


def nest(study: Study, base: nn.Module, held_out: HeldOut, cache: Path | None = None) -> Nested:
    """Choose anew without each fold or print, and judge there.

    Args:
        study: the development scans; its background is that of the reported errors.
        base: a small simulator, refitted in every selection.
        held_out: what is left out of a selection: the folds of the study, by scan, or whole prints.
        cache: folder where finished selections are kept; an interrupted run resumes with the next.

    Raises:
        InputError: a single print, too few scans to select on, or a kept selection that cannot be read.
    """
    ids = [scan.id for scan in study.scans]
    groups = (
        grouped_folds(ids, study.folds, study.seed)
        if held_out == "folds"
        else leave_one_print_out(ids, [scan.stored.print_id for scan in study.scans])
    )
    jobs: list[_Job] = []
    for number, group in enumerate(groups, start=1):
        others = [scan for scan in study.scans if scan.id not in group]
        inner = replace(
            study,
            scans=others,
            fold_of=deal(others, study.folds, study.seed),
            background="none",
            report=_prefixed(study.report, f"selection {number} of {len(groups)}, on {len(others)} scans"),
        )
        scans = [scan for scan in study.scans if scan.id in group]
        jobs.append((number, inner, base, scans, study, cache))
    done = run_jobs(_select_or_load, jobs, study.workers, name=lambda job: f"selection {job[0]}")
    parts = {}
    for (number, *_), part in progress(done, "choosing anew", len(jobs)):
        parts[number] = part
        study.report(f"selection {number} is made, {len(parts)} of {len(jobs)}")
    ordered = [parts[number] for number, *_ in jobs]
    return Nested(held_out, ordered, _scores(ordered, study))


def _prefixed(report: Callable[[str], None], prefix: str) -> Callable[[str], None]:
    return lambda message: report(f"{prefix}: {message}")


_Job = tuple[int, Study, nn.Module, list[PreparedScan], Study, Path | None]


def _select_or_load(job: _Job) -> Part:
    """One selection: number, study to choose on, base, the scans left out, the whole study, the cache."""
    _, inner, base, scans, study, cache = job
    folder = None if cache is None else cache / f"selection-{_key(inner, base, scans, study)[:16]}"
    if folder is not None and folder.exists():
        inner.report("kept from an earlier run")
        return _load(folder, scans)
    choice = choose(inner, base)
    part = _judged_elsewhere(choice, scans, study)
    if folder is not None:
        _keep(folder, part)
    return part


def _judged_elsewhere(choice: Choice, scans: list[PreparedScan], study: Study) -> Part:
    choice = replace(choice, study=replace(choice.study, background=study.background))
    before, after = predictions_elsewhere(choice, scans)
    return Part(
        scans=scans,
        named=choice.search.names,
        generic=[entry.probe.name for entry in choice.probed.added],
        accepted=choice.accepted,
        before=before,
        after=after,
    )


def _scores(parts: Sequence[Part], study: Study) -> dict[TermSet, BeforeAfter]:
    found: dict[TermSet, BeforeAfter] = {}
    sets = [term_sets(DATUM_FREE | names_to_terms(part.accepted)) for part in parts]
    for name in sets[0]:
        before, after = (
            _joined(
                [
                    score(part.scans, maps, own[name], study.blocks)
                    for part, own, maps in zip(parts, sets, side, strict=True)
                ]
            )
            for side in ([part.before for part in parts], [part.after for part in parts])
        )
        found[name] = before, after
    return found


def _joined(scores: Sequence[Score]) -> Score:
    counts = [len(own.mae_nm) for own in scores]
    return Score(
        mae_nm=np.concatenate([own.mae_nm for own in scores]),
        mse_nm2=np.concatenate([own.mse_nm2 for own in scores]),
        degrees_of_freedom=float(np.average([own.degrees_of_freedom for own in scores], weights=counts)),
        residual_um=[residual for own in scores for residual in own.residual_um],
    )


def _key(inner: Study, base: nn.Module, scans: Sequence[PreparedScan], study: Study) -> str:
    """Hash of all that decides a selection and what it predicts."""
    record = {
        "base": [type(base).__name__, {name: p.tolist() for name, p in base.state_dict().items()}],
        "effects": sorted(CATALOGUE),
        "selected on": scans_sha256([scan.stored for scan in inner.scans]),
        "held out": scans_sha256([scan.stored for scan in scans]),
        "settings": [inner.fold_of.tolist(), study.seed, study.loss, study.background],
    }
    if study.weights != "uniform":
        record["weights"] = study.weights
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _keep(folder: Path, part: Part) -> None:
    chosen = {"named": part.named, "generic": part.generic, "accepted": part.accepted}
    with atomic_folder(folder) as temporary:
        (temporary / _CHOSEN).write_text(json.dumps(chosen, indent=1), encoding="utf-8")
        for at, pair in enumerate(zip(part.before, part.after, strict=True)):
            np.save(temporary / _PREDICTIONS.format(at), np.stack(pair))


def _load(folder: Path, scans: list[PreparedScan]) -> Part:
    with reading_kept(folder):
        chosen = json.loads((folder / _CHOSEN).read_text(encoding="utf-8"))
        files = [folder / _PREDICTIONS.format(at) for at in range(len(scans))]
        pairs = [np.load(file, allow_pickle=False) for file in files]
        before, after = [pair[0] for pair in pairs], [pair[1] for pair in pairs]
        return Part(scans, chosen["named"], chosen["generic"], chosen["accepted"], before, after)
