"""Compare tensors as ``torch.testing`` does, whose import of ``torch.distributed`` takes four seconds."""

from __future__ import annotations

import numpy as np
import torch


def assert_close(found: torch.Tensor, wanted: torch.Tensor, rtol: float = 1e-6, atol: float = 1e-6) -> None:
    """Check that two tensors have the same type and shape, and that their values differ by no more than
    ``atol`` plus ``rtol`` times the wanted value.
    """
    assert (found.dtype, found.shape) == (wanted.dtype, wanted.shape)
    values = found.detach().numpy(), wanted.detach().numpy()
    np.testing.assert_allclose(*values, rtol=rtol, atol=atol, equal_nan=False)
