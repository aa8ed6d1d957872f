"""``build``: raw files and a card in, a dataset store and a report out."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from litho_data.build.jobs import field_jobs
from litho_data.build.listing import Listing, list_fields
from litho_data.build.make_store import BuildResult, Source, make_store
from litho_data.build.operations import load_recipe


def build(
    card_path: str | Path,
    out: str | Path,
    *,
    data_dir: str | Path | None = None,
    workers: int = 1,
    dask: str | None = None,
    strict: bool = False,
    seed: int = 0,
) -> BuildResult:
    """Build a dataset store from a card.

    Each scan is read, levelled by the card's recipe, registered and resampled once onto its layout's grid.
    A scan that cannot be used is skipped, with a line on stderr and a reason in the manifest. The store
    appears whole or not at all; a build that was killed goes on where it stopped. The report goes to
    ``<name>-report`` beside the store.

    Args:
        card_path: the dataset card.
        out: folder of the store; an older store there is replaced.
        data_dir: folder of the raw files; by default the card's folder, ``$LITHO_DATA_DIR/<name>`` or the
            user cache, whichever has them.
        workers: local processes; ``dask``: address of a Dask scheduler instead. The result is the same.
        strict: refuse to build if any scan has to be skipped.
        seed: of the robust registration.

    Raises:
        InputError: a bad card, no usable scan, a skipped scan under ``strict``, or ``out`` that is no store.
    """
    listing = list_fields(card_path, data_dir)
    recipe = load_recipe(_recipe_path(listing))
    return make_store(_source(listing, recipe, seed), Path(out), workers=workers, dask=dask, strict=strict)


def _recipe_path(listing: Listing) -> Path | None:
    level = listing.card.process.level
    return None if level is None else listing.card_path.parent / level


def _source(listing: Listing, recipe: Mapping[str, Any], seed: int) -> Source:
    found = {one.id: [one.layout, one.scan] for one in listing.fields}
    found |= {one.id: [*one.files] for one in listing.left_aside}
    return Source(
        card=listing.card,
        jobs=field_jobs(listing, recipe, seed),
        data_dir=listing.data_dir,
        files={key: {listing.relative(path): path for path in paths if path} for key, paths in found.items()},
        recipe=recipe,
        seed=seed,
        assumptions=listing.assumptions,
        unpaired={one.id: one.reason for one in listing.left_aside if one.unpaired},
        refused={one.id: one.reason for one in listing.left_aside if not one.unpaired},
    )
