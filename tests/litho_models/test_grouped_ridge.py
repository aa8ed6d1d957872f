"""Compare the grouped ridge with plain least squares with one column for each strength of each group."""

from __future__ import annotations

import numpy as np
import pytest

from litho_models.scan_terms.grouped import Block, Products

SCANS, PIXELS, COLUMNS = 12, 60, 5
GROUPS = {"all": ("",) * SCANS, "field": tuple("aabbccaabbcc"), "print": tuple("112233445566")}
EVERY = np.arange(SCANS)
FOLD_OF = np.arange(SCANS) % 4
BLOCKS = {
    "one for all": [Block((1, 2))],
    "by group": [Block((1, 3), "field")],
    "both of the same columns": [Block((1, 2)), Block((1, 2), "field", 2.0)],
    "two groupings": [Block((2,)), Block((3, 4), "print", 0.5), Block((5,), "field")],
}
BY_BLOCKS = pytest.mark.parametrize("blocks", BLOCKS.values(), ids=BLOCKS.keys())
# Unlike plain least squares, the ridge regularises equal columns by 1e-7 of their size.
CLOSE = {"rtol": 2e-5, "atol": 2e-6}


def rows(seed: int = 0) -> np.ndarray:
    """Return an array (scans, 1 + m, n) with a residual and m columns for each scan. Some columns are
    correlated.
    """
    rng = np.random.default_rng(seed)
    found = rng.normal(size=(SCANS, 1 + COLUMNS, PIXELS))
    found[:, 2] += 0.5 * found[:, 1]
    found[:, 0] += found[:, 1] - 0.4 * found[:, 3]
    return found


def products(maps: np.ndarray) -> Products:
    return Products(maps @ maps.transpose(0, 2, 1) / PIXELS, GROUPS)


def written_out(maps: np.ndarray, blocks: list[Block], scans: np.ndarray) -> tuple[np.ndarray, list[tuple]]:
    """Return a column (scans, n) for each strength of each label. Also return the names of the strengths."""
    found, names = [], []
    for number, block in enumerate(blocks):
        labels = np.array(GROUPS[block.by])
        for label in sorted({str(one) for one in labels[scans]}):
            for column in block.columns:
                found.append(maps[scans, column] * (labels[scans] == label)[:, None])
                names.append((number, label, column))
    return np.array(found), names


def solved(maps: np.ndarray, blocks: list[Block], scans: np.ndarray) -> np.ndarray:
    """Solve the least-squares problem, to which a penalty row is added for each strength."""
    columns, names = written_out(maps, blocks, scans)
    usual = np.mean(maps[scans] ** 2, axis=(0, 2))
    penalty = [blocks[number].shrinking * usual[column] for number, _, column in names]
    design = columns.reshape(len(names), -1).T / np.sqrt(PIXELS)
    stacked = np.vstack([design, np.diag(np.sqrt(penalty))])
    aim = np.concatenate([maps[scans, 0].reshape(-1) / np.sqrt(PIXELS), np.zeros(len(names))])
    return np.linalg.lstsq(stacked, aim, rcond=1e-10)[0]


@BY_BLOCKS
@pytest.mark.parametrize("scans", [EVERY, np.array([0, 2, 3, 7, 11])], ids=["all scans", "some"])
def test_strengths_are_those_of_plain_least_squares(blocks: list[Block], scans: np.ndarray) -> None:
    maps = rows()
    found = products(maps).strengths(blocks, scans)
    _, names = written_out(maps, blocks, scans)
    own = [found[number][label][blocks[number].columns.index(column)] for number, label, column in names]
    np.testing.assert_allclose(own, solved(maps, blocks, scans), **CLOSE)
    assert [set(one) for one in found] == [{GROUPS[b.by][scan] for scan in scans} for b in blocks]


@BY_BLOCKS
def test_the_squared_errors_are_those_of_the_residual(blocks: list[Block]) -> None:
    maps = rows()
    strengths = products(maps).strengths(blocks, EVERY)
    left = maps[:, 0].copy()
    for block, known in zip(blocks, strengths, strict=True):
        for scan in EVERY:
            left[scan] -= known[GROUPS[block.by][scan]] @ maps[scan, list(block.columns)]
    found = products(maps).squares(blocks, strengths, EVERY)
    np.testing.assert_allclose(found, (left**2).mean(axis=1), rtol=1e-12)


@BY_BLOCKS
def test_held_out_is_a_fit_without_the_fold(blocks: list[Block]) -> None:
    maps, wanted = rows(), np.empty(SCANS)
    for fold in range(4):
        own, rest = np.flatnonzero(fold == FOLD_OF), np.flatnonzero(fold != FOLD_OF)
        _, names = written_out(maps, blocks, rest)
        strengths = dict(zip(names, solved(maps, blocks, rest), strict=True))
        for scan in own:
            left = maps[scan, 0].copy()
            for number, block in enumerate(blocks):
                for column in block.columns:
                    label = GROUPS[block.by][scan]
                    left -= strengths.get((number, label, column), 0.0) * maps[scan, column]
            wanted[scan] = np.mean(left**2)
    np.testing.assert_allclose(products(maps).held_out(blocks, FOLD_OF), wanted, **CLOSE)


def test_a_scan_does_not_help_to_predict_itself() -> None:
    """Check that the residual of a scan does not change its strengths. The squared error of the scan is then
    a quadratic function of the residual.
    """
    maps, blocks = rows(), BLOCKS["two groupings"]
    change = np.random.default_rng(5).normal(size=PIXELS)
    errors = []
    for size in (-1.0, 0.0, 1.0, 2.0):
        moved = maps.copy()
        moved[FOLD_OF == 1, 0] += size * change
        errors.append(products(moved).held_out(blocks, FOLD_OF)[FOLD_OF == 1])
    second = np.array([errors[0] - 2 * errors[1] + errors[2], errors[1] - 2 * errors[2] + errors[3]])
    np.testing.assert_allclose(second, 2 * np.mean(change**2), rtol=1e-9)


def test_a_group_that_was_never_fitted_is_left_as_it_is() -> None:
    maps, blocks = rows(), [Block((1,), "print")]
    without = np.flatnonzero(np.array(GROUPS["print"]) != "1")
    known = products(maps).strengths(blocks, without)
    found = products(maps).squares(blocks, known, np.array([0, 1]))
    np.testing.assert_allclose(found, (maps[:2, 0] ** 2).mean(axis=1), rtol=1e-12)


def test_nothing_fitted_leaves_the_residual() -> None:
    maps = rows()
    np.testing.assert_allclose(products(maps).held_out([], FOLD_OF), (maps[:, 0] ** 2).mean(axis=1))
    assert products(maps).strengths([], EVERY) == []


@pytest.mark.parametrize("shrinking", [0.3, 1.0, 3.0])
def test_shrinking_counts_in_scans(shrinking: float) -> None:
    """Check that the fit finds k / (k + shrinking) times a strength that k scans share."""
    column = np.random.default_rng(1).normal(size=PIXELS)
    maps = np.zeros((SCANS, 2, PIXELS))
    maps[:, 1] = column
    sizes = {"a": 2.0, "b": -1.0, "c": 0.5}
    maps[:, 0] = np.array([sizes[label] for label in GROUPS["field"]])[:, None] * column
    found = products(maps).strengths([Block((1,), "field", shrinking)], EVERY)[0]
    for label, size in sizes.items():
        assert found[label][0] == pytest.approx(size * 4 / (4 + shrinking), rel=1e-6)
