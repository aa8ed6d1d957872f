"""Check, without a network, that a pushed model can be fetched, and that a failure is one line."""

from __future__ import annotations

import shutil
import sys
from fnmatch import fnmatch
from pathlib import Path
from types import ModuleType

import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_models import build_model, load_frozen, save_frozen
from litho_models.frozen.files import push


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """Replace huggingface_hub by local functions, and return the folder with their repositories."""
    root = tmp_path / "hub"
    library = ModuleType("huggingface_hub")

    def create_repo(repo_id: str, *, private: bool, exist_ok: bool) -> None:
        (root / repo_id).mkdir(parents=True, exist_ok=exist_ok)

    def upload_folder(*, repo_id: str, folder_path: str, allow_patterns: list[str]) -> None:
        for file in Path(folder_path).iterdir():
            if any(fnmatch(file.name, pattern) for pattern in allow_patterns):
                shutil.copy(file, root / repo_id)

    def snapshot_download(repo_id: str, *, revision: str | None, allow_patterns: list[str]) -> str:
        if not (root / repo_id).is_dir() or revision:
            raise OSError(f"404 Client Error for {repo_id}\nRequest ID: 1")
        return str(root / repo_id)

    for function in (create_repo, upload_folder, snapshot_download):
        setattr(library, function.__name__, function)
    monkeypatch.setitem(sys.modules, "huggingface_hub", library)
    return root


def test_a_pushed_model_comes_back_as_it_was(hub, tmp_path):
    folder = save_frozen(build_model("blur-table"), tmp_path / "model")
    (folder / "notes.txt").write_text("not part of the model", encoding="utf-8")
    assert push(folder, "group/printer") == "hf://group/printer"
    assert {file.name for file in (hub / "group/printer").iterdir()} == {
        "card.json",
        "model.safetensors",
        "README.md",
    }
    layout = torch.full((1, 1, 8, 8), 0.6)
    assert torch.equal(load_frozen("hf://group/printer")(layout), load_frozen(folder)(layout))


def test_what_cannot_be_shared_or_fetched_is_said_in_one_line(hub, tmp_path, monkeypatch):
    folder = save_frozen(build_model("affine"), tmp_path / "model")
    for address in ("hf://printer", "hf://../..", "hf://group/printer/deep"):
        with pytest.raises(InputError, match="wanted hf://OWNER/NAME"):
            load_frozen(address)
    for address in ("hf://group/none", "hf://group/none@v1"):
        with pytest.raises(InputError, match=r"404 Client Error for group/none$"):
            load_frozen(address)
    (folder / "model.safetensors").write_bytes(b"")
    with pytest.raises(InputError, match="SHA-256"):
        push(folder, "group/printer")
    assert not hub.exists()
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(InputError, match=r"litholoop\[hub\]"):
        load_frozen("hf://group/printer")
