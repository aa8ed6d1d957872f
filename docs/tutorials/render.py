"""Run the tutorials and write their pages: `python docs/tutorials/render.py [NAME …]`.

A tutorial is a script of cells (`# %%`: code, `# %% [markdown]`: text in comments). The script runs once, in
an empty folder. Its page shows the text, the code, and what the code printed and drew. Its notebook has the
same cells after a first cell that installs the packages.
"""

from __future__ import annotations

import ast
import contextlib
import io
import json
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
NAMES = ("datasets", "models", "optics", "gallery")
_INSTALL = (
    '# Where litholoop is installed already, this changes nothing.\n%pip install --quiet "litholoop[design]"'
)
# Progress lines and paths of the run, which are of no use to the reader.
_NOISE = re.compile(r"^\s*(for comparison:|.*it/s)")


def cells(script: str) -> list[tuple[str, str]]:
    """Return the cells of a script in order: ("markdown" or "code", text)."""
    found = []
    for part in re.split(r"^# %%", script, flags=re.MULTILINE)[1:]:
        head, _, body = part.partition("\n")
        if "[markdown]" in head:
            found.append(("markdown", re.sub(r"^# ?", "", body, flags=re.MULTILINE).strip()))
        else:
            found.append(("code", body.strip()))
    return found


def notebook(script: str) -> dict[str, Any]:
    """Return the script as a notebook (format 4.5) without outputs, with an installation cell first."""

    def cell(number: int, kind: str, text: str) -> dict[str, Any]:
        own: dict[str, Any] = {"outputs": [], "execution_count": None} if kind == "code" else {}
        lines = text.splitlines(keepends=True)
        return {"cell_type": kind, "id": f"cell-{number}", "metadata": {}, "source": lines, **own}

    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    written = [("code", _INSTALL), *cells(script)]
    return {
        "cells": [cell(number, kind, text) for number, (kind, text) in enumerate(written)],
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def write_notebook(name: str) -> None:
    """Write ``NAME.ipynb`` beside the script."""
    made = notebook((HERE / f"{name}.py").read_text("utf-8"))
    text = json.dumps(made, indent=1, ensure_ascii=False)
    (HERE / f"{name}.ipynb").write_text(text + "\n", encoding="utf-8")


def run_cell(code: str, names: dict[str, Any]) -> tuple[str, Any]:
    """Return what a cell prints and the value of its last expression; ``names`` come from earlier cells."""
    tree = ast.parse(code)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(io.StringIO()):
        exec(compile(tree, "tutorial", "exec"), names)
        value = None if last is None else eval(compile(ast.Expression(last.value), "tutorial", "eval"), names)
    lines = [line.rstrip() for line in said.getvalue().splitlines() if not _NOISE.match(line)]
    return "\n".join(lines), value


def render(name: str) -> None:
    """Run one tutorial and write ``NAME.md`` and its figures ``NAME-1.jpg`` … beside the script."""
    from matplotlib.figure import Figure

    names: dict[str, Any] = {}
    page = [f"<!-- written by render.py from {name}.py -->"]
    figures = 0
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            for kind, text in cells((HERE / f"{name}.py").read_text("utf-8")):
                page.append(text if kind == "markdown" else f"```python\n{text}\n```")
                if kind == "markdown":
                    continue
                said, value = run_cell(text, names)
                if isinstance(value, Figure):
                    figures += 1
                    value.savefig(HERE / f"{name}-{figures}.jpg", dpi=100, pil_kwargs={"quality": 85})
                    page.append(f"![What the code above draws]({name}-{figures}.jpg)")
                elif value is not None:
                    said = f"{said}\n{value}".strip()
                if said:
                    page.append(f"```text\n{said}\n```")
        finally:
            os.chdir(here)
    page.append(
        f"*`render.py` made this page by running [the script]({name}.py). "
        f"The page is also a [notebook]({name}.ipynb).*"
    )
    (HERE / f"{name}.md").write_text("\n\n".join(page) + "\n", encoding="utf-8")


if __name__ == "__main__":
    for chosen in sys.argv[1:] or NAMES:
        render(chosen)
        write_notebook(chosen)
