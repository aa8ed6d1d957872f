"""Compare the joint fit of parameters and of strengths by group with plain least squares."""

from __future__ import annotations

import numpy as np
import pytest

from litho_models.loop.joint_fit import JointFit

GROUPS, PIXELS, OWN, COLUMNS = 3, 400, 2, 2
# The ridge on the strengths is 1e-5 of the squared norm of their columns.
CLOSE = {"rtol": 1e-3, "atol": 1e-4}


def maps(seed: int = 0) -> np.ndarray:
    """Return the residual, the derivatives and the columns of the effect in each group, of shape (groups,
    1 + own + columns, pixels). The first column resembles the first derivative.
    """
    rng = np.random.default_rng(seed)
    found = rng.normal(size=(GROUPS, 1 + OWN + COLUMNS, PIXELS))
    found[:, 1 + OWN] += 2 * found[:, 1]
    found[:, 0] += found[:, 1] + np.array([1.0, -2.0, 0.5])[:, None] * found[:, 1 + OWN]
    return found


def joint(found: np.ndarray) -> JointFit:
    return JointFit(found @ found.transpose(0, 2, 1), OWN)


def plain(found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fit the parameters, and the strengths of each group, by plain least squares. Return both."""
    whole = np.zeros((GROUPS * PIXELS, OWN + GROUPS * COLUMNS))
    for group in range(GROUPS):
        own = slice(group * PIXELS, (group + 1) * PIXELS)
        whole[own, :OWN] = found[group, 1 : 1 + OWN].T
        at = OWN + group * COLUMNS
        whole[own, at : at + COLUMNS] = found[group, 1 + OWN :].T
    solved = np.linalg.lstsq(whole, found[:, 0].reshape(-1), rcond=None)[0]
    return solved[:OWN], solved[OWN:].reshape(GROUPS, COLUMNS)


def test_strengths_and_parameters_are_those_of_least_squares() -> None:
    parameters, strengths = plain(maps())
    fit = joint(maps())
    np.testing.assert_allclose(fit.strengths(), strengths, **CLOSE)
    for rest, own in zip(fit.rest(strengths), strengths, strict=True):
        np.testing.assert_allclose(rest, [1, *-parameters, *-own], **CLOSE)


def test_parameters_beside_given_strengths_leave_nothing_along_their_columns() -> None:
    found, strengths = maps(), np.random.default_rng(1).normal(size=(GROUPS, COLUMNS))
    left = np.einsum("gi,gin->gn", joint(found).rest(strengths), found)
    along = np.einsum("gn,gpn->p", left, found[:, 1 : 1 + OWN])
    assert np.abs(along).max() < 1e-9 * np.abs(found).sum()


def test_a_strength_that_differs_by_group_is_found_though_a_parameter_has_the_same_column() -> None:
    """Check a column that equals a derivative. Only the differences between groups are then known."""
    found = maps()
    found[:, 1 + OWN] = found[:, 1]
    wanted = np.array([0.0, 0.0, 1.0])
    found[:, 0] = wanted[:, None] * found[:, 1]
    fitted = joint(found).strengths()[:, 0]
    np.testing.assert_allclose(fitted - fitted[0], wanted, **CLOSE)
    # The ridge chooses the smallest strengths.
    assert abs(fitted.mean()) < 0.05


def test_what_parameters_can_imitate_is_projected_out() -> None:
    found = maps()
    found[:, 1 + OWN] = found[:, 1]
    beside = joint(found).beside_parameters()
    alone = joint(found).of_columns
    for group in range(GROUPS):
        share = found[group, 1] @ found[group, 1] / np.square(found[:, 1]).sum()
        assert beside[group, 0, 0] / alone[group, 0, 0] == pytest.approx(1 - share, abs=0.05)
    whole = JointFit(joint(found).grams.sum(axis=0, keepdims=True), OWN).beside_parameters()
    assert abs(whole[0, 0, 0]) < 1e-9 * alone[:, 0, 0].sum()
