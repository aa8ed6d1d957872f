"""Names and folders of the frozen models that come with the package (the zoo). The zoo contains the models
that the benchmark table of the documentation compares.

``load_frozen("zoo:pbl")`` loads the model ``pbl``, and ``load_frozen("zoo:best")`` loads the model with the
smallest error on held-out scans.
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
    """Return the sorted names of the models in the zoo. The list is empty if the package has no models."""
    return sorted(card.parent.name for card in ZOO_FOLDER.glob(f"*/{_CARD_FILE}"))


def folder(name: str) -> Path:
    """Return the folder of the zoo model with this name. The name ``best`` stands for the model with the
    smallest error on held-out scans.

    Raises:
        InputError: the zoo has no model with this name.
    """
    known = list()
    if name == BEST and known:
        name = min(known, key=_held_out_nm)
    if name not in known:
        names = [*known, BEST] if known else []
        raise unknown_name("zoo model", name, names, "" if known else "run `make zoo` to train it")
    return ZOO_FOLDER / name


def model_folder(source: str | Path, other: Iterable[str] = ()) -> Path:
    """Return the folder of a frozen model that is given as a path, as ``zoo:NAME`` or as ``hf://owner/name``.

    Args:
        source: path or name that the user typed.
        other: further names that the caller accepts. They are used only in the error message.

    Raises:
        InputError: there is no such folder, the zoo has no such model, or the model cannot be downloaded.
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
    """Return the card of a zoo model as a dictionary whose keys are the fields of ``ModelCard``. The weights
    are not read.

    Raises:
        InputError: the zoo has no model with this name.
    """
    found: dict[str, Any] = json.loads((folder(name) / _CARD_FILE).read_text(encoding="utf-8"))
    return found


def _held_out_nm(name: str) -> float:
    """Return the error of a zoo model on held-out scans, nm, which is the first metric of its card."""
    metrics = card(name)["metrics"]
    return metrics[0]["value"] if metrics else float("inf")
