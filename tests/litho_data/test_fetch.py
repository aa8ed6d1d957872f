"""Check that a fetch from a server keeps correct files, and that it reports wrong files and does not use
them.
"""

from __future__ import annotations

import functools
import hashlib
import http.server
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

import litho_data
from litho_data.cards.fetch import CARDS, fetch
from litho_data.foundation.errors import InputError

CONTENT = {"scans/P11.txt": b"1\t2\n3\t4\n", "layouts/P11.tif": b"levels", "elsewhere.bmp": b"picture"}


class _CountingHandler(http.server.SimpleHTTPRequestHandler):
    def do_GET(self) -> None:
        self.server.asked.append(self.path)  # type: ignore[attr-defined]
        super().do_GET()

    def log_message(self, *_: object) -> None:
        pass


class Served:
    """Describe a local server with a dataset: its card, and the paths that were requested."""

    def __init__(self, folder: Path, url: str, asked: list[str]):
        self.files, self.url, self.asked = folder / "served", url, asked
        self.card = folder / "card.toml"
        self.card.write_text(
            'name = "served-prints"\n'
            '[layout]\nfiles = "layouts/{id}.tif"\npitch_um = 0.1\nlevel_height_um = 0.1\nlevels = 13\n'
            '[scan]\nfiles = "scans/{id}.gsf"\n'
            f'[source]\nurl = "{url}/base"\nregistry = "files.sha256"\n',
            encoding="utf-8",
        )
        lines = []
        for name, content in CONTENT.items():
            own = name == "elsewhere.bmp"
            path = self.files / ("other/picture.bmp" if own else f"base/{name}")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            extra = f" {url}/other/picture.bmp" if own else ""
            lines.append(f"{name} {hashlib.sha256(content).hexdigest()}{extra}")
        (folder / "files.sha256").write_text("# a comment\n" + "\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    monkeypatch.delenv("LITHO_DATA_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    # Before it tries again, pooch would wait for a second.
    monkeypatch.setattr("pooch.core.time", SimpleNamespace(sleep=lambda _: None))
    handler = functools.partial(_CountingHandler, directory=str(tmp_path / "served"))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.asked = []  # type: ignore[attr-defined]
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    yield Served(tmp_path, f"http://127.0.0.1:{server.server_port}", server.asked)  # type: ignore[attr-defined]
    server.shutdown()
    thread.join()
    server.server_close()


def test_all_files_arrive_and_are_not_asked_for_twice(served: Served, tmp_path: Path) -> None:
    folder = fetch(served.card, tmp_path / "into")
    assert {name: (folder / name).read_bytes() for name in CONTENT} == CONTENT
    assert len(served.asked) == 3
    assert fetch(served.card, tmp_path / "into") == folder
    assert len(served.asked) == 3


def test_an_interrupted_fetch_goes_on(served: Served, tmp_path: Path) -> None:
    into = tmp_path / "into"
    (into / "scans").mkdir(parents=True)
    (into / "scans" / "P11.txt").write_bytes(CONTENT["scans/P11.txt"])
    (into / "elsewhere.bmp").write_bytes(b"pict")  # half of the file
    fetch(served.card, into)
    assert sorted(served.asked) == ["/base/layouts/P11.tif", "/other/picture.bmp"]
    assert (into / "elsewhere.bmp").read_bytes() == CONTENT["elsewhere.bmp"]


def test_a_corrupted_file_is_named_and_not_kept(served: Served, tmp_path: Path) -> None:
    (served.files / "base" / "scans" / "P11.txt").write_bytes(b"1\t2\n3\t5\n")
    with pytest.raises(InputError, match=r"scans/P11\.txt from http.*another SHA-256"):
        fetch(served.card, tmp_path / "into")
    assert not (tmp_path / "into" / "scans" / "P11.txt").exists()


def test_a_missing_file_and_a_dead_server_are_named(served: Served, tmp_path: Path) -> None:
    (served.files / "base" / "layouts" / "P11.tif").unlink()
    with pytest.raises(InputError, match=r"cannot fetch layouts/P11\.tif.*404"):
        fetch(served.card, tmp_path / "into")
    text = served.card.read_text(encoding="utf-8").replace(served.url, "http://127.0.0.1:9")
    served.card.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="cannot fetch"):
        fetch(served.card, tmp_path / "other")


def test_complete_folders_are_taken_before_the_server(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cached = fetch(served.card)
    assert str(cached).startswith(str(tmp_path / "cache"))
    asked = len(served.asked)
    monkeypatch.setenv("LITHO_DATA_DIR", str(tmp_path / "shelf"))
    fetch(served.card, tmp_path / "shelf" / "served-prints")
    assert fetch(served.card) == tmp_path / "shelf" / "served-prints"
    (tmp_path / "shelf" / "served-prints" / "elsewhere.bmp").write_bytes(b"damaged")
    assert fetch(served.card) == cached
    assert len(served.asked) == asked + 3


def test_unknown_names_and_bad_registries(served: Served, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="neural-lithography"):
        fetch("no-such-dataset")
    registry = tmp_path / "files.sha256"
    registry.write_text("../outside.txt " + "0" * 64 + "\n", encoding="utf-8")
    with pytest.raises(InputError, match="inside the data folder"):
        fetch(served.card, tmp_path / "into")
    registry.write_text("# nothing\n", encoding="utf-8")
    with pytest.raises(InputError, match="no files"):
        fetch(served.card, tmp_path / "into")
    registry.unlink()
    with pytest.raises(InputError, match="cannot read registry"):
        fetch(served.card, tmp_path / "into")
    served.card.write_text(served.card.read_text(encoding="utf-8").split("[source]")[0], encoding="utf-8")
    with pytest.raises(InputError, match="no \\[source\\]"):
        fetch(served.card, tmp_path / "into")


def test_the_cards_are_part_of_an_installed_package() -> None:
    package = Path(litho_data.__file__).parent
    settings = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))
    shipped = settings["tool"]["setuptools"]["package-data"]["*"]
    assert CARDS.parent == package
    files = list(CARDS.iterdir())
    assert {file.suffix for file in files} >= {".toml", ".sha256"}
    assert all(any(file.match(pattern) for pattern in shipped) for file in files)


@pytest.mark.measured
def test_the_registry_of_the_measured_prints_is_right(measured_prints: Path) -> None:
    # Every file in the folder LITHO_DATA_DIR must have its registered hash.
    assert fetch("neural-lithography").resolve() == measured_prints
    lines = (CARDS / "neural-lithography.sha256").read_text(encoding="utf-8").splitlines()
    names = {line.split()[0] for line in lines if line and not line.startswith("#")}
    there = {
        path.relative_to(measured_prints).as_posix() for path in measured_prints.rglob("*") if path.is_file()
    }
    assert there - names == {"LICENSE", "README.md"}
    assert len(names) == 250
