"""Fit the strengths of an effect together with the parameters of a model. The strengths differ between groups
of scans, and the parameters of the model are the same in all scans.

The prediction is linearised. A column is its derivative with respect to one parameter or one strength, and
the fit needs only the inner products of the residual and these columns.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from litho_data.foundation import Array

# An effect can be tested only if at least this fraction of the squared norm of its column remains after the
# terms of each scan and the changes that the parameters of the model can make have been projected out.
# Strengths whose columns retain less are shrunk.
SMALLEST_RETAINED = 1e-5
_KEPT = 1 / (1 + SMALLEST_RETAINED)


@dataclass(frozen=True)
class JointFit:
    """The inner products from which parameters and strengths are fitted.

    Attributes:
        grams: inner products in each group of scans, of shape (…, groups, 1 + p + m, 1 + p + m). Index 0
            stands for the residual. The next p columns are those of the model's parameters, and the last m
            columns are those of the effect.
        own: the number p of parameters of the model.
    """

    grams: Array
    own: int

    def strengths(self) -> Array:
        """Return the strengths that fit the residual best if the parameters of the model are fitted, too, of
        shape (…, groups, m).
        """
        cut = 1 + self.own
        mixed = _inverse(self.grams[..., cut:, cut:]) @ self.grams[..., cut:, :cut]
        left = (self.grams[..., :cut, :cut] - _KEPT * self.grams[..., :cut, cut:] @ mixed).sum(axis=-3)
        parameters = _inverse(left[..., 1:, 1:]) @ left[..., 1:, :1]
        return _KEPT * (mixed[..., :1] - mixed[..., 1:] @ parameters[..., None, :, :])[..., 0]

    def only(self, present: Array) -> JointFit:
        """Return the joint fit in which the strengths of some groups are 0.

        Args:
            present: mask of the groups whose strengths are fitted, of shape (…, groups).
        """
        kept = present[..., None] | (np.arange(self.grams.shape[-1]) <= self.own)
        return JointFit(self.grams * kept[..., :, None] * kept[..., None, :], self.own)

    def rest(self, strengths: Array) -> Array:
        """Return what remains of the residual at given strengths and the best parameters, as a combination of
        the residual and the columns, of shape (…, groups, 1 + p + m).

        Args:
            strengths: strengths of the effect, of shape (…, groups, m).
        """
        cut = 1 + self.own
        rows = self.grams[..., 1:cut, :]
        right = rows[..., :1] - rows[..., cut:] @ strengths[..., None]
        parameters = self._inverse_of_parameters @ right.sum(axis=-3)
        one = np.ones((*strengths.shape[:-1], 1))
        return np.concatenate([one, -parameters[..., None, :, 0] * one, -strengths], axis=-1)

    @cached_property
    def _inverse_of_parameters(self) -> Array:
        """Return the inverse of the inner products of the parameters' columns over all groups, of shape (…,
        p, p).
        """
        own = slice(1, 1 + self.own)
        return _inverse(self.grams[..., own, own].sum(axis=-3))

    @property
    def of_columns(self) -> Array:
        """Return the inner products of the effect's columns in each group, of shape (…, groups, m, m)."""
        return self.grams[..., 1 + self.own :, 1 + self.own :]

    def beside_parameters(self) -> Array:
        """Return the inner products of the columns of the effect in each group after the changes that the
        parameters of the model can make have been projected out. The result has the shape of ``of_columns``.
        """
        cut = 1 + self.own
        rows = self.grams[..., 1:cut, :]
        fitted = self._inverse_of_parameters[..., None, :, :] @ rows[..., cut:]
        return self.of_columns - np.swapaxes(rows[..., cut:], -1, -2) @ fitted


def _inverse(matrix: Array) -> Array:
    """Return the pseudo-inverse of symmetric matrices, of shape (…, n, n)."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", matrix), 1e-300))
    scales = scale[..., :, None] * scale[..., None, :]
    return np.linalg.pinv(matrix / scales, rcond=1e-8, hermitian=True) / scales
