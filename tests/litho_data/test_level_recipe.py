"""Check that a recipe does exactly what it states, and that anything else is refused."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from litho_data.foundation.errors import InputError
from litho_data.level import Recipe, align_rows, level_plane, level_polynomial, mask_and_relevel
from litho_data.level.operation import STEPS
from litho_data.level.rows import RowMethod
from litho_data.scan import Scan

CHAIN = """
name = "difference, plane, features, rows, zero"
[[step]]
op = "align-rows"
method = "median-of-differences"
[[step]]
op = "plane"
[[step]]
op = "mask-and-relevel"
side = "above"
[[step]]
op = "align-rows"
[[step]]
op = "polynomial"
total_degree = 2
masking = "ignore"
"""


def surface(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    z = 0.01 * rng.normal(size=(40, 50)) + 0.02 * rng.normal(size=(40, 1)) + 0.003 * np.arange(50)[None, :]
    z[10:20, 10:30] += 0.4
    return z


def chain(tmp_path: Path, text: str = CHAIN) -> Recipe:
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    return Recipe.from_toml(path)


def test_steps_run_in_order_and_hand_on_their_mask(tmp_path: Path) -> None:
    z = surface()
    levelled, removed = chain(tmp_path).apply(z)
    by_hand = align_rows(z, method="median-of-differences").height
    by_hand = level_plane(by_hand).height
    relevelled, mask = mask_and_relevel(by_hand, side="above")
    by_hand = align_rows(relevelled.height, method="median", mask=mask).height
    by_hand = level_polynomial(by_hand, total_degree=2).height
    np.testing.assert_array_equal(levelled, by_hand)
    np.testing.assert_allclose(levelled + removed, z, rtol=0, atol=1e-15)


def test_the_mask_and_pitch_of_a_scan_are_used(tmp_path: Path) -> None:
    z = surface()
    mask = z > 0.3
    recipe = chain(tmp_path, '[[step]]\nop = "plane"\n[[step]]\nop = "facet"\nmasking = "include"\n')
    scan = Scan(height_um=z, pitch_um=(0.1, 0.1), mask=mask)
    np.testing.assert_array_equal(
        recipe.apply(scan).height, recipe.apply(z, pitch_um=(0.1, 0.1), mask=mask).height
    )
    with pytest.raises(InputError, match=r"step 2 \(facet\): the pixel pitch is unknown"):
        recipe.apply(Scan(height_um=z, pitch_um=None))


def test_the_canonical_form_is_complete_and_reads_back(tmp_path: Path) -> None:
    recipe = chain(tmp_path)
    canonical = recipe.canonical()
    assert canonical["step"][1] == {"op": "plane", "masking": "exclude"}
    assert canonical["step"][4] == {
        "op": "polynomial",
        "masking": "ignore",
        "x_degree": 3,
        "y_degree": 3,
        "total_degree": 2,
    }
    again = Recipe.from_dict(canonical)
    assert again.canonical() == canonical
    np.testing.assert_array_equal(again.apply(surface()).height, recipe.apply(surface()).height)
    in_python = Recipe(
        step=(
            STEPS["plane"](op="plane"),
            STEPS["polynomial"](op="polynomial", total_degree=2, masking="ignore"),
        )
    )
    assert in_python.canonical()["step"] == [canonical["step"][1], canonical["step"][4]]


def test_every_operation_runs_with_its_defaults() -> None:
    assert len(STEPS) == 13
    layout = np.random.default_rng(1).integers(0, 5, size=(40, 50)).astype(float)
    for op, model in STEPS.items():
        levelled = Recipe(step=(model(op=op),)).apply(surface(), pitch_um=(1.0, 1.0), layout_level=layout)
        np.testing.assert_allclose(levelled.height + levelled.removed, surface(), rtol=0, atol=1e-12)


def test_a_recipe_without_steps_changes_nothing() -> None:
    levelled, removed = Recipe().apply(surface())
    np.testing.assert_array_equal(levelled, surface())
    np.testing.assert_array_equal(removed, 0.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('[[step]]\nop = "plain"', "'plain'"),
        ('[[step]]\nop = "plane"\nmaskin = "ignore"', "maskin"),
        ('[[step]]\nop = "plane"\nmasking = "use"', "masking"),
        ('[[step]]\nop = "polynomial"\nx_degree = 12', "x_degree"),
        ('[[step]]\nop = "align-rows"\nmethod = "mean"', "method"),
        ('[[step]]\nop = "align-rows"\ntrim = nan', "trim"),
        ('[[step]]\nmethod = "median"', "op"),
        ('[[steps]]\nop = "plane"', "steps"),
        ("step = 3", "step"),
        ("[[step", "cannot read recipe"),
        ('schema = "other/1"', "schema"),
        ('name = "a file that was cut"', "no step, wanted at least one"),
    ],
)
def test_a_file_that_is_not_a_recipe_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        chain(tmp_path, text)


def test_a_missing_recipe_and_a_missing_layout_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read recipe"):
        Recipe.from_toml(tmp_path / "none.toml")
    with pytest.raises(InputError, match=r"step 1 \(layout-aware\): the layout .* only a build finds"):
        chain(tmp_path, '[[step]]\nop = "layout-aware"').apply(surface())


def test_the_page_states_which_operations_were_tested_against_gwyddion() -> None:
    """Check the tables of operations on the page about levelling.

    The first column names all operations. Each operation that follows Gwyddion must also be named in one of
    two cells further down.
    """
    page = (Path(__file__).parents[2] / "docs" / "levelling.md").read_text(encoding="utf-8")
    lines = [line for line in page.splitlines() if line.startswith("|")]
    rows = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines]
    follows = {name: row[3] for row in rows if len(row) == 4 for name in re.findall("`([^`]+)`", row[0])}
    assert STEPS.keys() == follows.keys() - {"op"}
    at = next(i for i, row in enumerate(rows) if row[0] == "tested with reference fields")
    with_fields, without = (set(re.findall("`([^`]+)`", cell)) for cell in rows[at + 2])
    assert {name for name, whose in follows.items() if whose.startswith("Gwyddion")} <= with_fields | without
    assert not with_fields & without
    assert all(f"`{method}" in page for method in get_args(RowMethod))
