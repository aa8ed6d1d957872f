"""What design may use, and what belongs to the microscope: the two models that come out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from litho_data.foundation.files import atomic_file
from litho_models.effects import get_effect
from litho_models.effects.chain import EffectChain
from litho_models.loop.findings import LoopFindings
from litho_models.loop.result.record import AddedEffect, CloseLoop, EffectVerdict, Part
from litho_models.loop.single_scans.nested_tests import scan_parameters
from litho_models.scan_terms import parameter_names

EffectValues = dict[str, dict[str, float]]

# No design uses these: a part of what is missing, and, in older results, a filter near the cause.
_NO_CAUSE: tuple[EffectVerdict, ...] = ("partial", "traced-to-covariate")


def exported_effects(chain: EffectChain, result: CloseLoop) -> dict[str, EffectValues]:
    """The chain's effects as ``process``, ``measurement`` and ``undetermined`` (kept out of design).

    A process effect that these data cannot tell from one of the microscope is undetermined, and so is
    one that only comes near the cause, or is a part of what is missing.
    """
    added = {effect.name: effect for effect in result.effects}
    groups: dict[str, EffectValues] = {"process": {}, "measurement": {}, "undetermined": {}}
    for name, values in chain.values().items():
        groups[part_of(added[name])][name] = values
    return groups


def part_of(effect: AddedEffect) -> Part:
    """Whose an added effect is: the printer's or the microscope's only if all that look like it are."""
    if effect.verdict in _NO_CAUSE:
        return "undetermined"
    if get_effect(effect.name).per_scan:
        return "per-scan"
    # Its own as the result has it: new prints may have decided it.
    roles = {effect.role, *(get_effect(name).role for name in effect.confusable_with)}
    if roles == {"process"}:
        return "process"
    return "measurement" if roles == {"measurement"} else "undetermined"


def write_measurement_model(findings: LoopFindings, result: CloseLoop, path: Path) -> None:
    """Shared measurement effects and the terms of each scan, as JSON beside the process model."""
    names = parameter_names(findings.terms)
    coefficients = scan_parameters(findings.development, findings.final.predictions, findings.terms)
    scale = np.array([1e3 if name.endswith("(nm)") else 1.0 for name in names])
    content = {
        "schema": "litho-models/measurement-model/1",
        "coordinates": "x and y run from -1 to 1 over the scan",
        "shared": {
            e.name: {key: p.value for key, p in e.parameters.items()}
            for e in result.effects
            if e.role == "measurement" and not get_effect(e.name).per_scan
        },
        "accepted": findings.accepted,
        "scans": {
            scan.id: dict(zip(names, (row * scale).tolist(), strict=True))
            for scan, row in zip(findings.development, coefficients, strict=True)
        },
    }
    with atomic_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
