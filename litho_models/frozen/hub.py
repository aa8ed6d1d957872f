"""Fetch or share frozen models on the Hugging Face Hub: each is a repository of three files."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from litho_data.foundation.errors import InputError

ADDRESS = "hf://"
_REPOSITORY = re.compile(r"\w[\w.-]*/\w[\w.-]*")
_FILES = ["model.safetensors", "card.json", "README.md"]


def fetched(address: str) -> Path:
    """Download a model, unless the cache of huggingface_hub contains it, and return its folder.

    Args:
        address: ``hf://owner/name``, or ``hf://owner/name@revision``.

    Raises:
        InputError: the address is not valid, the repository does not exist, or huggingface_hub is not
            installed.
    """
    repository, _, revision = address.removeprefix(ADDRESS).partition("@")
    with _hub(repository) as hub:
        return Path(hub.snapshot_download(repository, revision=revision or None, allow_patterns=_FILES))


def upload(folder: Path, repository: str, *, private: bool) -> str:
    """Upload the three files of a frozen model to a repository, which is created if necessary; return its
    address.

    Raises:
        InputError: the address is not valid, the repository refuses the upload, or huggingface_hub is not
            installed.
    """
    repository = repository.removeprefix(ADDRESS)
    with _hub(repository) as hub:
        hub.create_repo(repository, private=private, exist_ok=True)
        hub.upload_folder(repo_id=repository, folder_path=str(folder), allow_patterns=_FILES)
    return f"{ADDRESS}{repository}"


@contextmanager
def _hub(repository: str) -> Iterator[Any]:
    """Yield huggingface_hub, and convert each of its errors to a one-line InputError."""
    what = f"model {ADDRESS}{repository}"
    if not _REPOSITORY.fullmatch(repository):
        raise InputError(what, wanted=f"{ADDRESS}OWNER/NAME")
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise InputError(what, got=f"no {error.name}", hint="pip install 'litholoop[hub]'") from None
    try:
        yield huggingface_hub
    # These are the errors of huggingface_hub, and those of the network library that it uses.
    except Exception as error:
        raise InputError(what, got=str(error).strip().partition("\n")[0]) from error
