"""Export a frozen model as a stand-alone program for layouts of one size, in the format of ``torch.export``
or ONNX.
"""

from __future__ import annotations

import copy
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from litho_data.foundation.errors import InputError
from litho_data.foundation.files import atomic_file
from litho_data.readers.reader import quiet
from litho_models.frozen.simulator import FrozenSimulator

if TYPE_CHECKING:
    from torch.export import ExportedProgram

SUFFIXES = (".pt2", ".onnx")
# Largest allowed difference, µm, between the height that an exported program computes and the height that its
# model computes (0.01 nm).
LARGEST_DIFFERENCE_UM = 1e-5
_ITEM = torch.ops.aten._local_scalar_dense.default
_FACTS = ("name", "pitch_um", "level_height_um", "levels", "calibrated_range_um")


def export_model(model: FrozenSimulator, out: str | Path, size_px: int = 512) -> float:
    """Write a frozen model as a program for layouts of one size. Return the largest difference, µm, between
    the heights that the program and the model predict for a random layout.

    The program receives a layout in µm, float32 of shape (1, 1, size_px, size_px), and returns the printed
    height in µm with the same shape. The program checks neither the pitch nor the range of the layout's
    heights. Pitch and range are stated in the metadata of the program: the extra file ``card.json`` in a
    ``.pt2`` file, or the ``metadata_props`` of an ONNX file.

    Args:
        out: output file. Its suffix is ``.pt2`` (read by ``torch.export.load``) or ``.onnx`` (needs the extra
            ``onnx``).
        size_px: side of the layouts, in pixels.

    Raises:
        InputError: the suffix is neither ``.pt2`` nor ``.onnx``; ``onnx`` is not installed; the format does
            not support an operation of the model; or the heights of program and model differ by more than
            0.01 nm.
    """
    target = Path(out)
    if target.suffix not in SUFFIXES:
        raise InputError(f"suffix of the export {out}", got=repr(target.suffix), wanted=" or ".join(SUFFIXES))
    if size_px < 1:
        raise InputError("size_px", got=size_px, wanted="a positive number")
    generator = torch.Generator().manual_seed(0)
    lowest, highest = model.card["calibrated_range_um"]
    layouts = lowest + (highest - lowest) * torch.rand((2, 1, 1, size_px, size_px), generator=generator)
    simulator = copy.deepcopy(model.simulator).float().cpu()
    with torch.no_grad():
        wanted = simulator(layouts[1])
        program = _program(simulator, layouts)
        facts = {key: model.card[key] for key in _FACTS} | {"sha256": model.sha256}
        with atomic_file(target) as temporary:
            write = _write_pt2 if target.suffix == ".pt2" else _write_onnx
            printed = write(program, temporary, layouts[1], facts)
            difference = float((printed - wanted).abs().max())
            if not difference <= LARGEST_DIFFERENCE_UM:
                got = f"heights off by {difference:g} µm"
                raise InputError(
                    f"export of {model.name}", got=got, wanted=f"at most {LARGEST_DIFFERENCE_UM:g} µm"
                )
    return difference


class _Numbers(TorchDispatchMode):
    """A torch mode that makes a model use fixed Python numbers. In a first run, the mode records the numbers
    that the model reads from tensors with ``Tensor.item``. In a later run, ``Tensor.item`` returns these
    numbers.

    These numbers are the radii of blur kernels and the end points of tables. Radii and end points depend only
    on the weights, so the exported program may contain them as constants.
    """

    def __init__(self, told: list[Any] | None = None):
        super().__init__()
        self.noted: list[Any] = []
        self._told = None if told is None else iter(told)

    def __torch_dispatch__(
        self, operation: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        if operation is _ITEM and self._told is not None:
            return next(self._told)
        result = operation(*args, **(kwargs or {}))
        if operation is _ITEM:
            self.noted.append(result)
        return result


def _program(simulator: nn.Module, layouts: Tensor) -> ExportedProgram:
    from torch.fx.experimental.proxy_tensor import make_fx

    noted = []
    for layout in layouts:
        with _Numbers() as numbers:
            simulator(layout)
        noted.append(numbers.noted)
    if noted[0] != noted[1]:
        raise InputError(
            "model to export",
            got="operations that depend on the layout",
            wanted="the same operations for every layout",
        )

    def run(layout_um: Tensor) -> Tensor:
        with _Numbers(noted[0]):
            return simulator(layout_um)

    traced = make_fx(run, tracing_mode="real")(layouts[0])
    return torch.export.export(_Program(traced), (layouts[0],), strict=False)


class _Program(nn.Module):
    """A module that wraps a traced model so that the input of the program is called ``layout_um``."""

    def __init__(self, traced: Callable[[Tensor], Tensor]):
        super().__init__()
        self.traced = traced

    def forward(self, layout_um: Tensor) -> Tensor:
        return self.traced(layout_um)


def _write_pt2(program: ExportedProgram, file: Path, layout_um: Tensor, facts: dict[str, Any]) -> Tensor:
    torch.export.save(program, file, extra_files={"card.json": json.dumps(facts)})
    return torch.export.load(file).module()(layout_um)


def _write_onnx(program: ExportedProgram, file: Path, layout_um: Tensor, facts: dict[str, Any]) -> Tensor:
    try:
        import onnxruntime
        from onnxscript.optimizer import fold_constants, remove_unused_nodes
    except ModuleNotFoundError as error:
        raise InputError(
            "export to ONNX", got=f"no {error.name}", hint="pip install 'litholoop[onnx]'"
        ) from None
    # The exporter warns about packages that none of these models needs. Such warnings are hidden.
    with quiet("torch.onnx", "onnxscript", "onnx_ir", above=logging.WARNING):
        try:
            # The search for patterns to simplify would take most of the time, and the runtime does it anyway.
            written = torch.onnx.export(program, (layout_um,), dynamo=True, verbose=False, optimize=False)
        except torch.onnx.errors.OnnxExporterError as error:
            complex_numbers = "complex" in str(error)
            raise InputError(
                f"export of model {facts['name']} to ONNX",
                got="complex numbers, which ONNX does not support"
                if complex_numbers
                else type(error).__name__,
                hint="export to .pt2, which supports every model",
            ) from None
    assert written is not None
    fold_constants(written.model)
    remove_unused_nodes(written.model)
    written.model.metadata_props.update({key: json.dumps(value) for key, value in facts.items()})
    written.save(str(file))
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    (given,) = session.get_inputs()
    return torch.from_numpy(session.run(None, {given.name: layout_um.numpy()})[0])
