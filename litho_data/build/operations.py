"""The operations that turn raw files into a dataset, as pure functions of recorded parameters and inputs.

``build`` runs them, ``replay`` runs them again from the record; there is no other way to make a stored array.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import array_sha256, file_sha256, source_sha256
from litho_data.provenance.steps import Step
from litho_data.store.schema import VARIABLES

if TYPE_CHECKING:
    from litho_data.register import Registration

PACKAGE = Path(__file__).parents[1]
Arrays = dict[str, np.ndarray]
Facts = dict[str, Any]
# Beyond it a failed registration asks whether rows are missing.
_OBLONG = 0.01


@dataclass(frozen=True)
class Operation:
    """``run(params, files, arrays) -> (arrays, facts)``; ``code`` is what its result depends on."""

    version: str
    run: Callable[[Mapping[str, Any], Sequence[Path], Mapping[str, np.ndarray]], tuple[Arrays, Facts]]
    code: tuple[str, ...]

    @property
    def code_sha256(self) -> str:
        """Hash of the source that the operation's result depends on."""
        return _code_sha256(self.code)


@dataclass(frozen=True)
class Done:
    """A finished step with its arrays and with what it found out."""

    step: Step
    arrays: Arrays
    facts: Facts


def perform(
    op: str, params: Mapping[str, Any], files: Mapping[str, Path], arrays: Mapping[str, np.ndarray]
) -> Done:
    """Run one operation and record it.

    Args:
        op: key of ``OPERATIONS``.
        params: explicit parameters, plain data.
        files: raw files by their recorded name, in the order that the operation expects.
        arrays: input arrays by their name in the store.

    Raises:
        InputError: whatever is wrong with the input; a missing or unreadable file included.
    """
    operation = OPERATIONS[op]
    try:
        inputs = [{"name": name, "sha256": file_sha256(path)} for name, path in files.items()]
        inputs += [
            {"name": name, "sha256": VARIABLES[name].sample_sha256(array)} for name, array in arrays.items()
        ]
        with _one_thread():
            made, facts = operation.run(params, list(files.values()), arrays)
    except OSError as error:
        raise InputError(f"cannot read {', '.join(map(str, files.values()))}", got=str(error)) from error
    outputs = [_described(name, array) for name, array in made.items()]
    step = Step(op, operation.version, dict(params), tuple(inputs), tuple(outputs), operation.code_sha256)
    return Done(step, made, facts)


def load_recipe(path: Path | None) -> dict[str, Any]:
    """A levelling recipe in canonical form; without a file, the one that does nothing."""
    from litho_data.level import Recipe

    return (Recipe() if path is None else Recipe.from_toml(path)).canonical()


@contextmanager
def _one_thread() -> Iterator[None]:
    """One thread for numerical libraries: sums do not depend on the cores, workers do not compete."""
    import cv2
    import scipy.linalg  # noqa: F401 - brings a BLAS of its own, which must be there to be limited
    from threadpoolctl import threadpool_limits

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(limits=1):
            yield
    finally:
        cv2.setNumThreads(threads)


def _described(name: str, array: np.ndarray) -> dict[str, Any]:
    variable = VARIABLES[name]
    dims, unit = variable.sample_dims, variable.unit
    sha256 = array_sha256(array, unit, dims)
    return {
        "name": name,
        "sha256": sha256,
        "dtype": str(array.dtype),
        "shape": list(array.shape),
        "unit": unit,
        "dims": list(dims),
    }


def _read_layout(
    params: Mapping[str, Any], files: Sequence[Path], _: Mapping[str, np.ndarray]
) -> tuple[Arrays, Facts]:
    from litho_data.readers import read_layout

    level = read_layout(files[0])
    if level.max() >= params["levels"]:
        wanted = f"at most {params['levels'] - 1}, since the card says levels = {params['levels']}"
        raise InputError(f"layout {files[0]}: highest level", got=int(level.max()), wanted=wanted)
    return {"mask_level": level}, {}


def _read_scan(
    params: Mapping[str, Any], files: Sequence[Path], _: Mapping[str, np.ndarray]
) -> tuple[Arrays, Facts]:
    from litho_data.readers import read_scan

    size = params["size_um"]
    scan = read_scan(files[0], **{**params, "size_um": tuple(size) if size else None})
    arrays = {"raw_height_um": scan.height_um.astype(np.float32)}
    if scan.mask is not None:
        arrays["vendor_mask"] = scan.mask
    facts = {
        "pitch_um": list(scan.require_pitch()),
        "reader": scan.format,
        "unit": scan.unit,
        "channel": scan.channel,
        "fast_axis": scan.fast_axis,
        "header": scan.header,
    }
    return arrays, facts


def _locate(
    params: Mapping[str, Any], _: Sequence[Path], arrays: Mapping[str, np.ndarray]
) -> tuple[Arrays, Facts]:
    """Where the layout lies in the unlevelled scan, for levelling that has to know it."""
    from litho_data.level import layout_in_scan_frame

    raw, layout = arrays["raw_height_um"], arrays["mask_level"]
    found = _registration(raw, layout, params)
    if not found.quality.passed:
        raise InputError(f"registration before levelling failed: {found.quality.reason}")
    shape, pitch_um = (raw.shape[0], raw.shape[1]), tuple(params["scan_pitch_um"])
    level = layout_in_scan_frame(
        layout, found.scan_to_layout, shape, pitch_um, params["layout_pitch_um"], found.bend_um
    )
    return {"layout_in_scan": level.astype(np.float32)}, {}


def _level(
    params: Mapping[str, Any], _: Sequence[Path], arrays: Mapping[str, np.ndarray]
) -> tuple[Arrays, Facts]:
    from litho_data.level import Recipe

    levelled = Recipe.from_dict(params["recipe"]).apply(
        arrays["raw_height_um"].astype(np.float64),
        pitch_um=tuple(params["scan_pitch_um"]),
        mask=arrays.get("vendor_mask"),
        layout_level=arrays.get("layout_in_scan"),
    )
    named = {"levelled_height_um": levelled.height, "removed_um": levelled.removed}
    return {name: array.astype(np.float32) for name, array in named.items()}, {}


def _register(
    params: Mapping[str, Any], _: Sequence[Path], arrays: Mapping[str, np.ndarray]
) -> tuple[Arrays, Facts]:
    found = _registration(arrays["levelled_height_um"], arrays["mask_level"], params)
    if not found.quality.passed:
        pitch_y_um, pitch_x_um = params["scan_pitch_um"]
        oblong = abs(pitch_y_um / pitch_x_um - 1) > _OBLONG
        pixels = f"pixels of {pitch_y_um:.4g} × {pitch_x_um:.4g} µm (y × x): are rows missing?"
        raise InputError(f"registration failed: {found.quality.reason}", hint=pixels if oblong else "")
    if found.bend_um is None:
        return {"scan_to_layout": found.scan_to_layout}, asdict(found.quality)
    arrays_found = {"scan_to_layout": found.scan_to_layout, "bend_um": found.bend_um.amount}
    return arrays_found, asdict(found.quality) | found.bend_um.figures


def _registration(height_um: np.ndarray, layout_level: np.ndarray, params: Mapping[str, Any]) -> Registration:
    from litho_data.register import register_scan

    return register_scan(
        height_um.astype(np.float64),
        layout_level,
        scan_pitch_um=tuple(params["scan_pitch_um"]),
        layout_pitch_um=params["layout_pitch_um"],
        model=params["model"],
        seed=params["seed"],
    )


def _resample(
    params: Mapping[str, Any], _: Sequence[Path], arrays: Mapping[str, np.ndarray]
) -> tuple[Arrays, Facts]:
    from litho_data.register import Bend, resample_to_layout

    levelled, pitch_um = arrays["levelled_height_um"], tuple(params["scan_pitch_um"])
    bent = "bend_um" in arrays
    height, valid = resample_to_layout(
        levelled.astype(np.float64),
        arrays["scan_to_layout"],
        tuple(params["layout_shape"]),
        scan_pitch_um=pitch_um,
        layout_pitch_um=params["layout_pitch_um"],
        bend_um=Bend.of_scan(arrays["bend_um"], levelled.shape, pitch_um) if bent else None,
    )
    return {"height_um": height, "valid": valid}, {}


def _stitch_pairs(
    params: Mapping[str, Any], files: Sequence[Path], _: Mapping[str, np.ndarray]
) -> tuple[Arrays, Facts]:
    from litho_data.exchange.pairs import stitch_field

    return stitch_field(files, params["quadrants"], params["full_scale_um"], params["levels"]), {}


OPERATIONS: dict[str, Operation] = {
    "read-layout": Operation("1", _read_layout, ("readers", "build/operations.py")),
    "read-scan": Operation(
        "1", _read_scan, ("readers", "scan.py", "foundation/units.py", "build/operations.py")
    ),
    "locate": Operation("1", _locate, ("register", "level", "build/operations.py")),
    "level": Operation("1", _level, ("level", "build/operations.py")),
    "register": Operation("1", _register, ("register", "build/operations.py")),
    "resample": Operation("1", _resample, ("register", "build/operations.py")),
    "stitch-pairs": Operation("1", _stitch_pairs, ("exchange/pairs.py", "readers", "build/operations.py")),
}


@cache
def _code_sha256(names: tuple[str, ...]) -> str:
    return source_sha256(*(PACKAGE / name for name in names))
