"""Make printer models usable inside ``torch.func`` and ``torch.compile``, which cannot trace the custom
gradients that the models define.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Print = Callable[[Tensor], Tensor]


def printed_anyhow(run: Print, level: Tensor) -> Tensor:
    """Return ``run(level)``. If a transform of ``torch.func`` cannot trace this call, the call becomes a
    single operation with its own gradient, which need not be traced.
    """
    if "torch._dynamo" in sys.modules:
        run = torch.compiler.disable(run)
    if not torch._C._functorch.is_functorch_wrapped_tensor(level):
        return run(level)
    try:
        return run(level)
    except RuntimeError:
        # The model defines a custom gradient in a form that torch.func cannot transform, or it reads the
        # values of tensors, which torch.func does not allow.
        printed: Tensor = _Printed.apply(level, run)
        return printed


# ``torch.compiler.disable`` would set this attribute, but its import takes two seconds.
printed_anyhow._torchdynamo_disable = True  # type: ignore[attr-defined]


class _Printed(torch.autograd.Function):
    @staticmethod
    def forward(level: Tensor, run: Print) -> Tensor:
        return run(level)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0])
        ctx.run = inputs[1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _Slope.apply(ctx.saved_tensors[0], gradient, ctx.run), None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], level: Tensor, run: Print) -> tuple[Tensor, int]:
        return torch.stack([_Printed.apply(one, run) for one in level.unbind(in_dims[0])]), 0


class _Slope(torch.autograd.Function):
    @staticmethod
    def forward(level: Tensor, gradient: Tensor, run: Print) -> Tensor:
        with torch.enable_grad():
            again = level.detach().requires_grad_()
            (found,) = torch.autograd.grad(run(again), again, gradient)
        return found

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        """Save nothing, because second derivatives through a model are not supported."""

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], level: Tensor, gradient: Tensor, run: Print
    ) -> tuple[Tensor, int]:
        levels, slopes = (_parts(one, at, info) for one, at in zip((level, gradient), in_dims, strict=False))
        parts = zip(levels, slopes, strict=True)
        return torch.stack([_Slope.apply(one, slope, run) for one, slope in parts]), 0


def _parts(values: Tensor, at: int | None, info: Any) -> tuple[Tensor, ...]:
    return (values,) * info.batch_size if at is None else values.unbind(at)
