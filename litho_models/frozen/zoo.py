"""Names and folders of the frozen models in the package. These models are the ones in the benchmark table.

``load_frozen("zoo:pbl")`` opens one of them, and ``load_frozen("zoo:best")`` the one that predicts held-out
scans best.
"""

import builtins
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from litho_data.foundation.errors import unknown_name
from litho_models.frozen import hub

ZOO_FOLDER = Path(__file__).parent / "zoo_data"
PREFIX = "zoo:"
BEST = "best"
_CARD_FILE = "card.json"


def list() -> builtins.list[str]:
    """Return the sorted names of the models in the zoo; empty if the package contains none."""
    return sorted(card.parent.name for card in ZOO_FOLDER.glob(f"*/{_CARD_FILE}"))


def folder(name: str) -> Path:
    """Return the folder of the zoo model with this name, or of the best one, for commands that take a folder.

    Raises:
        InputError: no such model.
    """
    known = list()
    if name == BEST and known:
        name = min(known, key=_held_out_nm)
    if name not in known:
        names = [*known, BEST] if known else []
        raise unknown_name("zoo model", name, names, "" if known else "run `make zoo` to train it")
    return ZOO_FOLDER / name


def model_folder(source: str | Path, other: Iterable[str] = ()) -> Path:
    """Return the folder of a model, from a path, ``zoo:NAME`` or ``hf://owner/name``.

    Args:
        source: the path or name that the user typed.
        other: further names that the caller accepts, which the error message lists too.

    Raises:
        InputError: no such folder, no such model in the zoo, or one that cannot be fetched.
    """
    text = str(source)
    if text.startswith(hub.ADDRESS):
        return hub.fetched(text)
    if text.startswith(PREFIX):
        return folder(text.removeprefix(PREFIX))
    if not Path(source).is_dir():
        known = [*(f"{PREFIX}{name}" for name in list()), *other]
        raise unknown_name("model", text, known, also="the folder of a model")
    return Path(source)


def card(name: str) -> dict[str, Any]:
    """Return the card of a zoo model as a dictionary, with the keys of ``ModelCard``; the weights are not
    read.

    Raises:
        InputError: no such model.
    """
    found: dict[str, Any] = json.loads((folder(name) / _CARD_FILE).read_text(encoding="utf-8"))
    return found


def _held_out_nm(name: str) -> float:
    """Return the first metric of a card: the error on held-out scans."""
    metrics = card(name)["metrics"]
    return metrics[0]["value"] if metrics else float("inf")
