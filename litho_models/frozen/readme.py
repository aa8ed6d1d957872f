"""The page of a frozen model for people, rendered from its card."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from litho_models.frozen.card import CardMetric, ModelCard

_HEADER = """---
license: apache-2.0
library_name: litholoop
pipeline_tag: image-to-image
tags: [lithography, AFM, {model}]
datasets: [{dataset}]
metrics: [mae]
model-index:
- name: {name}
  results:{results}
---
"""

_RESULT = """
  - task: {{type: image-to-image, name: layout to printed height}}
    dataset: {{name: {dataset}, type: {dataset}, split: "{of.split}", revision: {revision}}}
    metrics:
    - {{type: {of.name}, value: {of.value:.4f}, \
config: "nuisance policy {of.policy}, background {of.background}"}}"""

_INSIDE = (
    "Inside, beside them: `scan-axis`, what the height along x adds to a measured map. `litho-models freeze` "
    "leaves it out unless it is attributed to the printer."
)


def model_readme(card: ModelCard) -> str:
    """Markdown with a Hugging Face front matter: what the model is, where it may be used, what it scored."""
    dataset = card.dataset.name if card.dataset else "unknown"
    revision = card.dataset.sha256 if card.dataset else "unknown"
    results = "".join(
        _RESULT.format(dataset=dataset, revision=revision, of=metric) for metric in card.metrics
    )
    header = _HEADER.format(model=card.model, dataset=dataset, name=card.name, results=results or " []")
    low, high = card.calibrated_range_um
    sections = [
        header,
        f"# {card.name}\n",
        f"A frozen simulator of a lithography machine (`{card.model}`, variant `{card.variant}`, "
        f"{card.parameters} parameters): layout in, printed height out, both in µm.\n",
        *([_leading(card.held_out)] if card.held_out else []),
        "## Use\n",
        "```python\nfrom litho_models import load_frozen\n\n"
        'model = load_frozen("this/folder")\n'
        f"height_um = model(layout_um, pitch_um={card.pitch_um:g})\n```\n",
        f"Layouts are sampled at {card.pitch_um:g} µm with {card.levels} levels of "
        f"{card.level_height_um:g} µm; heights from {low:g} to {high:g} µm are calibrated, others are "
        "refused unless `extrapolate=True`.\n",
        "## What it is not\n",
        "It describes one machine, one resist and one batch of prints, and not the microscope: datum, "
        "tilt, bow and line offsets of a scan are not part of it"
        + (
            "; the smooth background that its training scans share is in the card, for comparison with "
            "measured maps only.\n"
            if card.background
            else ".\n"
        ),
        "## Training\n",
        _training(card),
        *([f"{bounds_text(card.at_bounds)}\n"] if card.at_bounds else []),
        "## Errors\n",
        _metrics(card),
        "## Effects\n",
        f"Process effects inside the model: {_names(card.process_effects)}. Measurement effects, left out: "
        f"{_names(card.measurement_effects)}. Undetermined, left out: {_names(card.undetermined_effects)}.\n",
        *([f"{_INSIDE}\n"] if card.hyper_parameters.get("scan_axis") else []),
        *([f"{_attribution(card)}\n"] if card.attributed else []),
        "## Limitations\n",
        "\n".join(f"- {line}" for line in card.limitations) or "- none stated",
        "",
    ]
    return "\n".join(sections)


def bounds_text(at_bounds: Mapping[str, float]) -> str:
    """What it means that fitted values stand on their bounds."""
    named = ", ".join(f"{name} ({bound:g})" for name, bound in at_bounds.items())
    return f"On a bound of its range, so that the fit may want more than the model allows: {named}."


def _training(card: ModelCard) -> str:
    rows = [
        ("dataset", f"{card.dataset.name} ({card.dataset.sha256[:12]}…)" if card.dataset else "not stated")
    ]
    rows += [("command", f"`{card.command}`")] if card.command else []
    rows += [(key, str(value)) for key, value in card.training.items()]
    return "| what | value |\n|---|---|\n" + "\n".join(f"| {key} | {value} |" for key, value in rows) + "\n"


def _leading(held_out: CardMetric) -> str:
    return (
        f"**Mean absolute error {error_text(held_out)}** on scans that a fit has not seen "
        "(95 % interval over scans; the zero of each scan is free).\n"
    )


def error_text(metric: CardMetric) -> str:
    """A figure and its interval."""
    between = f" ({metric.ci95[0]:.2f} … {metric.ci95[1]:.2f})" if metric.ci95 else ""
    return f"{metric.value:.2f} {metric.unit}{between}"


def _metrics(card: ModelCard) -> str:
    if not card.metrics:
        return "Not evaluated.\n"
    head = "| metric | value | split | nuisance policy | background |\n|---|---|---|---|---|\n"
    lines = [
        f"| {m.name} | {error_text(m)} | {m.split} | {m.policy} | {m.background} |" for m in card.metrics
    ]
    return head + "\n".join(lines) + "\n"


def _attribution(card: ModelCard) -> str:
    given = ", ".join(f"{name} to the {side}" for name, side in card.attributed.items())
    return (
        f"Attributed when it was frozen, because the prints cannot tell: {given}. The other attribution is "
        "another model; a design that holds under both does not depend on it."
    )


def _names(effects: dict[str, dict[str, float]]) -> str:
    return ", ".join(effects) or "none"
