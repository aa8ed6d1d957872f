"""The page of a frozen model for people, rendered from its card."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from litho_data.reports.page import filled

if TYPE_CHECKING:
    from litho_models.frozen.card import ModelCard


def model_readme(card: ModelCard) -> str:
    """Markdown with a Hugging Face front matter: what the model is, where it may be used, what it scored."""
    return filled(
        Path(__file__).with_name("readme.md.jinja"),
        card=card,
        dataset=card.dataset.name if card.dataset else "unknown",
        revision=card.dataset.sha256 if card.dataset else "unknown",
        bounds=bounds_text(card.at_bounds) if card.at_bounds else "",
    )


def bounds_text(at_bounds: Mapping[str, float]) -> str:
    """What it means that fitted values stand on their bounds."""
    named = ", ".join(f"{name} ({bound:g})" for name, bound in at_bounds.items())
    return f"On a bound of its range, so that the fit may want more than the model allows: {named}."
