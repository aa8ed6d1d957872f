"""Check the files and the installation of the project. litho_data must work without torch, and the wheel must
work in an empty folder.
"""

from __future__ import annotations

import datetime
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import litho_data

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRA_MODULES = ("torch", "skimage", "safetensors")

WITHOUT_EXTRAS = f"""
import importlib.abc, sys
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {EXTRA_MODULES!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
"""


def run(code: str, folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run code in a new Python process in an empty folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "HOME": str(folder), **variables}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, timeout=300
    )


def test_litho_data_makes_and_builds_prints_without_the_extras(tmp_path: Path) -> None:
    path = """
import litho_data, pkgutil, importlib
for module in pkgutil.walk_packages(litho_data.__path__, "litho_data."):
    importlib.import_module(module.name)
card = litho_data.simulate("prints", count=2, size_px=128)
litho_data.build_dataset(card, "prints.zarr")
print(len(litho_data.open_store("prints.zarr").ids))
"""
    done = run(WITHOUT_EXTRAS + path, tmp_path)
    assert (done.returncode, done.stdout.split()[-1:]) == (0, ["2"]), done.stderr[-2000:]


@pytest.mark.parametrize("name", ["models", "design"])
def test_litho_models_and_litho_design_say_in_one_line_which_extra_they_need(
    tmp_path: Path, name: str
) -> None:
    hint = f"pip install 'litholoop[{name}]'"
    # In an environment without torch, find_spec returns None, whereas WITHOUT_EXTRAS raises an error.
    hidden = "import importlib.util; importlib.util.find_spec = lambda name: None\n"
    done = run(f"{hidden}from litho_{name}.cli import main; main()", tmp_path)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert hint in done.stderr
    face = {"models": "train", "design": "design_hologram"}[name]
    done = run(f"{WITHOUT_EXTRAS}import litho_{name}; litho_{name}.{face}", tmp_path)
    assert hint in done.stderr.strip().splitlines()[-1]


@pytest.mark.long
def test_the_wheel_designs_a_hologram_from_an_empty_folder(tmp_path: Path) -> None:
    """Check that a wheel built by pip contains the zoo, templates and cards that a hologram design needs."""
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    wheels, target, home = tmp_path / "wheels", tmp_path / "site", tmp_path / "home"
    home.mkdir()
    # Build from a copy, because setuptools creates folders beside the sources.
    source = tmp_path / "source"
    source.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE", "NOTICE"):
        shutil.copy(ROOT / name, source)
    for package in ("litho_data", "litho_models", "litho_design"):
        shutil.copytree(ROOT / package, source / package, ignore=shutil.ignore_patterns("__pycache__"))
    subprocess.run([*pip, "wheel", "--no-deps", "--wheel-dir", wheels, source], check=True, timeout=300)
    (wheel,) = wheels.glob("litholoop-*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--target", target, wheel], check=True, timeout=300)
    code = "import litho_design.cli as cli, sys; sys.argv[1:] = ['first', '--out', 'first']; cli.main()"
    done = run(code, home, PYTHONPATH=str(target))
    assert done.returncode == 0, done.stderr[-2000:]
    assert (home / "first" / "report.html").exists()
    assert str(ROOT) not in done.stdout


def test_versions_and_names_agree() -> None:
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert re.search(rf"\nversion: {PROJECT['version']}\ndate-released: \d{{4}}-\d\d-\d\d\n", citation)
    assert f"## {PROJECT['version']}" in (ROOT / "CHANGELOG.md").read_text("utf-8")
    assert litho_data.__version__ == PROJECT["version"]
    core = " ".join(PROJECT["dependencies"])
    assert not [name for name in ("torch", "safetensors") if f"{name}>" in core]


def test_on_a_package_index_the_links_of_the_page_lead_to_the_repository(tmp_path: Path) -> None:
    workflow = (ROOT / ".github/workflows/release.yml").read_text("utf-8")
    (script,) = re.findall(r"name: links\n +run: \|\n(.*?)\n +- run", workflow, re.DOTALL)
    shutil.copy(ROOT / "README.md", tmp_path)
    names = {"GITHUB_REPOSITORY": "owner/name", "GITHUB_REF_NAME": "v1"}
    subprocess.run(["bash", "-euc", script], cwd=tmp_path, env=os.environ | names, check=True)
    page = (tmp_path / "README.md").read_text("utf-8")
    assert [link for link in re.findall(r"\]\(([^)]+)\)", page) if not link.startswith("https://")] == []
    assert "](https://raw.githubusercontent.com/owner/name/v1/docs/results/first/first.jpg)" in page


# These scripts replace the Python that builds the wheel (BUILDS) and the Pythons that try it (TRIES).
BUILDS = """#!/bin/sh
case "$1" in -c) echo 9.8.7;; *) mkdir -p dist; touch dist/litholoop-9.8.7-py3-none-any.whl;; esac
"""
TRIES = """#!/bin/sh
[ "$1" = --version ] && exit {known}
mkdir -p "$3/bin"
for name in pip litho-data litho-design; do
  cat >"$3/bin/$name" <<END
#!/bin/sh
echo "$name in \\$(basename "\\$PWD") of \\$(basename "\\$HOME")\\$PYTHONPATH: \\$*" >>"$LOG"
[ $name != {broken} ]
END
  chmod +x "$3/bin/$name"
done
"""


CHECKS = """#!/bin/sh
echo "make: $*" | tee -a "$LOG"
exit {code}
"""


def released(
    folder: Path,
    *,
    said: str | None = None,
    cited: str = "9.8.7",
    tag: str = "",
    change: str = "",
    checks: int = 0,
    **of_312: object,
) -> tuple[int, str]:
    """Release a small project in ``folder``, and return the exit code and the last line of the output. The
    project states the date ``said``, or that of today.
    """
    said = said or datetime.date.today().isoformat()
    files = {
        ".venv/bin/python": BUILDS,
        ".gitignore": ".venv/\nbin/\ndist/\nlog\ntmp/\n",
        "bin/make": CHECKS.format(code=checks),
        "CITATION.cff": f"version: {cited}\ndate-released: {said}\n",
        "CHANGELOG.md": f"## 9.8.7 ({said})\n",
    }
    for python in ("python3.11", "python3.12", "python3.13"):
        asked = {"known": 0, "broken": "none"} | (of_312 if python == "python3.12" else {})
        files[f"bin/{python}"] = TRIES.format(**asked)
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, "utf-8")
        (folder / name).chmod(0o755)
    (folder / ".ci").mkdir()
    (folder / "tmp").mkdir()
    shutil.copy(ROOT / ".ci" / "release", folder / ".ci")
    names = {f"GIT_{role}_{what}": "a@b" for role in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")}
    path = f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}"
    places = {"LOG": str(folder / "log"), "HOME": str(folder), "TMPDIR": str(folder / "tmp")}
    environment = os.environ | names | places | {"PATH": path, "PYTHONPATH": "/of/the/checkout"}
    tagging = [["tag", tag]] if tag else []
    for words in (["init", "--quiet"], ["add", "."], ["commit", "--quiet", "--message", "all"], *tagging):
        subprocess.run(["git", *words], cwd=folder, env=environment, check=True)
    if change:
        (folder / change).write_text("")
    done = subprocess.run([folder / ".ci" / "release"], env=environment, capture_output=True, text=True)
    return done.returncode, (done.stdout + done.stderr).strip().splitlines()[-1]


def tags(folder: Path) -> list[str]:
    asked = ["git", "tag", "--list"]
    return subprocess.run(asked, cwd=folder, capture_output=True, text=True, check=True).stdout.split()


@pytest.mark.skipif(shutil.which("bash") is None or os.name == "nt", reason="needs a Unix shell")
def test_a_release_tries_its_wheel_with_every_python_before_it_is_tagged(tmp_path: Path) -> None:
    assert released(tmp_path) == (0, "v9.8.7 is tagged; push the tag to publish it")
    assert tags(tmp_path) == ["v9.8.7"]
    checked, *tried = (tmp_path / "log").read_text("utf-8").splitlines()
    assert checked == "make: check test"
    assert [line.split(":")[0].split()[0] for line in tried] == 3 * ["pip", "litho-data", "litho-design"]
    assert all("dist/litholoop-9.8.7-py3-none-any.whl[design]" in line for line in tried[::3])
    assert tried[2::3] == 3 * ["litho-design in empty of empty: first --out first"]
    assert list((tmp_path / "tmp").iterdir()) == []
    supported = re.findall(r"Python :: (3\.\d+)", " ".join(PROJECT["classifiers"]))
    named = " ".join(f"python{one}" for one in supported)
    assert f"pythons=({named})" in (ROOT / ".ci" / "release").read_text("utf-8")


@pytest.mark.skipif(shutil.which("bash") is None or os.name == "nt", reason="needs a Unix shell")
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ({"change": "new.py"}, "not committed"),
        ({"tag": "v9.8.7"}, "tagged already"),
        ({"said": "2020-02-02"}, "into CITATION.cff"),
        ({"cited": "9.8.6"}, "into CITATION.cff"),
        ({"known": 127}, "python3.12 does not run"),
        ({"checks": 1}, ""),
        ({"broken": "litho-design"}, ""),
        ({"broken": "pip"}, ""),
    ],
    ids=lambda one: str(one),
)
def test_a_release_that_is_not_ready_is_not_tagged(tmp_path: Path, fault: dict, said: str) -> None:
    code, line = released(tmp_path, **fault)
    assert code != 0
    assert said in line
    assert tags(tmp_path) == ([fault["tag"]] if "tag" in fault else [])
    # Where possible, a release is refused before the tests, which take minutes. No temporary folder is left.
    assert (tmp_path / "log").exists() == (not said)
    assert list((tmp_path / "tmp").iterdir()) == []
