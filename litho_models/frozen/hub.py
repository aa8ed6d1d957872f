"""Download frozen models from the Hugging Face Hub, and upload them. Each model is a repository with three
files: the weights, the card and the README page.
"""

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
    """Return the folder of a model. If the model is not in the cache of huggingface_hub, it is downloaded
    first.

    Args:
        address: ``hf://owner/name`` or, for a certain revision, ``hf://owner/name@revision``.

    Raises:
        InputError: the address is not valid, the repository cannot be downloaded, or huggingface_hub is not
            installed.
    """
    repository, _, revision = address.removeprefix(ADDRESS).partition("@")
    with _hub(repository) as hub:
        return Path(hub.snapshot_download(repository, revision=revision or None, allow_patterns=_FILES))


def upload(folder: Path, repository: str, *, private: bool) -> str:
    """Upload the three files of a frozen model to a repository, which is created if necessary. Return the
    address of the model.

    Raises:
        InputError: the address is not valid, the repository rejects the upload, or huggingface_hub is not
            installed.
    """
    repository = repository.removeprefix(ADDRESS)
    with _hub(repository) as hub:
        hub.create_repo(repository, private=private, exist_ok=True)
        hub.upload_folder(repo_id=repository, folder_path=str(folder), allow_patterns=_FILES)
    return f"{ADDRESS}{repository}"


@contextmanager
def _hub(repository: str) -> Iterator[Any]:
    """Yield the module huggingface_hub, and convert any error in the block to a one-line InputError."""
    what = f"model {ADDRESS}{repository}"
    if not _REPOSITORY.fullmatch(repository):
        raise InputError(what, wanted=f"{ADDRESS}OWNER/NAME")
    try:
        import huggingface_hub
    except ModuleNotFoundError as error:
        raise InputError(what, got=f"no {error.name}", hint="pip install 'litholoop[hub]'") from None
    try:
        yield huggingface_hub
    # The errors may come from huggingface_hub or from the network library that it uses.
    except Exception as error:
        raise InputError(what, got=str(error).strip().partition("\n")[0]) from error
