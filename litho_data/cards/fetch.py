"""Fetch a known dataset. Each file is downloaded once, and is used only if it has the registered SHA-256."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from litho_data.cards.card import load_card
from litho_data.commands.progress import progress
from litho_data.foundation import InputError, file_sha256, unknown_name

if TYPE_CHECKING:
    import pooch

CARDS = Path(__file__).parents[1] / "datasets"
"""Folder of the cards that come with the package. In a source checkout, it is a link to the folder
``datasets`` beside the packages.
"""


def fetch(dataset: str | Path, into: str | Path | None = None) -> Path:
    """Make sure that all files of a dataset are present and undamaged, and return their folder.

    Without ``into``, the first complete folder among ``$LITHO_DATA_DIR/<name>`` and the user cache is used.
    If neither is complete, the missing files are downloaded into the user cache. Files with the right hash
    are not downloaded again, so an interrupted fetch resumes.

    Args:
        dataset: name of a card of this project, for example ``neural-lithography``, or the path of a card.
        into: folder to fill; by default the user cache.

    Raises:
        InputError: the name is unknown, the card does not say where its files can be downloaded, a file
            cannot be downloaded, or the hash of a downloaded file is wrong.
    """
    card_path = find_card(dataset)
    name, registry = _registry(card_path)
    if into is None:
        for folder in known_folders(name):
            if not _missing(folder, registry):
                return folder
    target = Path(into) if into is not None else cache_folder(name)
    registry.path = target
    for file in progress(_missing(target, registry), f"fetching {name}"):
        _download(registry, file)
    return target


def known_folders(name: str) -> list[Path]:
    """Return the folders searched for the files of a dataset: ``$LITHO_DATA_DIR/<name>``, then the user
    cache.
    """
    root = os.environ.get("LITHO_DATA_DIR")
    return [*([Path(root) / name] if root else []), cache_folder(name)]


def cache_folder(name: str) -> Path:
    """Return the folder of a dataset in the user cache."""
    import pooch

    return Path(pooch.os_cache("litholoop")) / name


def find_card(dataset: str | Path) -> Path:
    """Return the path of a dataset card. ``dataset`` is the name of one of the project's cards, or the path
    of a ``.toml`` file, which is returned unchanged.

    Raises:
        InputError: the project has no card with this name.
    """
    if Path(dataset).suffix == ".toml":
        return Path(dataset)
    known = known_cards()
    if str(dataset) not in known:
        raise unknown_name("dataset", dataset, known, also="the path of a card")
    return known[str(dataset)]


def known_cards() -> dict[str, Path]:
    """Return the paths of the project's cards, keyed by card name. Files like ``<name>.split.toml`` are not
    cards and are left out.
    """
    return {path.stem: path for path in sorted(CARDS.glob("*.toml")) if "." not in path.stem}


def _registry(card_path: Path) -> tuple[str, pooch.Pooch]:
    import pooch

    card = load_card(card_path)
    if card.source is None:
        raise InputError(
            f"card {card_path} has no [source]", wanted="url and registry", hint="fetch needs both"
        )
    registry = pooch.create(path=Path(), base_url=card.source.url.rstrip("/") + "/", retry_if_failed=1)
    path = card_path.parent / card.source.registry
    try:
        registry.load_registry(path)
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read registry {path}", got=error) from error
    if not registry.registry:
        raise InputError(f"registry {path}", got="no files", wanted="lines with a file name and its SHA-256")
    for file in registry.registry:
        if ".." in Path(file).parts or Path(file).is_absolute():
            raise InputError(f"registry {path}: file", got=file, wanted="a path inside the data folder")
    return card.name, registry


def _missing(folder: Path, registry: pooch.Pooch) -> list[str]:
    """Return the names of the registered files that are missing in the folder or have another hash than
    registered.
    """
    hashes = registry.registry.items()
    return [
        file
        for file, sha256 in hashes
        if not (folder / file).is_file() or file_sha256(folder / file) != sha256
    ]


def _download(registry: pooch.Pooch, file: str) -> None:
    import pooch
    import requests

    downloader = pooch.HTTPDownloader(progressbar=False, timeout=60)
    logger = pooch.get_logger()
    level = logger.level
    logger.setLevel("ERROR")  # the progress bar makes pooch's log messages superfluous
    try:
        registry.fetch(file, downloader=downloader)
    except (requests.RequestException, OSError) as error:
        url = registry.get_url(file)
        raise InputError(
            f"cannot fetch {file}", got=error, wanted=url, hint="run fetch again to resume"
        ) from error
    except ValueError as error:  # pooch has already removed a file whose hash is wrong
        url, wanted = registry.get_url(file), registry.registry[file]
        hint = "the source has changed or the download was damaged; the file was not kept"
        raise InputError(f"{file} from {url}", got="another SHA-256", wanted=wanted, hint=hint) from error
    finally:
        logger.setLevel(level)
