"""A stack of 3 x 3 convolutions with fixed weights, in float32 on a CPU, with fewer multiplications.

Winograd's minimal filtering F(4 x 4, 3 x 3) (Lavin and Gray 2016, arXiv:1509.09308). A patch of 4 x 4 results
depends on 6 x 6 pixels; these and the kernel are transformed to 36 numbers each, here called frequencies,
which are multiplied one by one, for all channels: 36 products where sums over neighbours take 144. What
lies between the products of two layers (transforms, bias, leaky ReLU) is compiled, in ``winograd_passes``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from litho_models.fast import winograd_passes as passes
from litho_models.fast.one_channel import adjoint_kernel, onto_one_channel
from litho_models.fast.winograd_passes import FRAME_PX, LANES, PATCH_PX, SPAN

# Patches that are transformed, multiplied and transformed back together: 64 channels of them and of their
# products take 1.8 MB, about the second cache of a core. An odd number, for frequencies that lie a multiple
# of 4096 bytes apart compete for the same lines of the first.
_BLOCK = 97
# Pixels by which the last patches of a row or a column reach beyond the field.
_SPARE_PX = PATCH_PX - 1
_LARGE_PAGE_BYTES = 2**21

# G of the paper: a kernel, as a polynomial, at 0, 1, -1, 2, -2 and infinity, scaled.
_WEIGHT_TRANSFORM = (
    (1 / 4, 0, 0),
    (-1 / 6, -1 / 6, -1 / 6),
    (-1 / 6, 1 / 6, -1 / 6),
    (1 / 24, 1 / 12, 1 / 6),
    (1 / 24, -1 / 12, 1 / 6),
    (0, 0, 1),
)

_Floats = NDArray[np.float32]
_Signs = NDArray[np.int8]


class FixedStack:
    """The stack of ``convolution_stack``, 1 -> channels -> 1, for weights that do not learn.

    Several threads may use it at a time.

    Args:
        weights: (outputs, inputs, 3, 3) per layer, float32 on the CPU, two layers at least; the channels
            are multiples of 16.
        biases: (outputs,) per layer.
        leaky_slope: slope below zero.
        tile_px: longest side of a result.

    Raises:
        ValueError: weights or biases of another dtype, or of sizes that do not fit.
    """

    def __init__(self, weights: Sequence[Tensor], biases: Sequence[Tensor], leaky_slope: float, tile_px: int):
        # The passes check nothing.
        _check_layers(weights, biases)
        self._first, *self._hidden, self._last = (weight.detach() for weight in weights)
        self._biases = [bias.detach().contiguous().numpy() for bias in biases[:-1]]
        self._slope = np.float32(leaky_slope)
        self._forwards = [_in_frequencies(weight) for weight in self._hidden]
        self._side_px = tile_px + 2 * len(weights) + 2 * FRAME_PX + _SPARE_PX
        self._idle_rooms: list[_Room] = []

    def heights(self, tile: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Result for (y, x) but for the last bias, smaller by 2 per layer, and signs of the hidden values.

        The signs are int8, 1 above zero and -1 elsewhere, one (1, channels, y', x') per hidden layer; they
        have ``_SPARE_PX`` rows and columns at the end that mean nothing.
        """
        ny, nx = (length - 2 for length in tile.shape)
        with self._room() as room:
            field, signs = room.field(ny, nx, len(self._first)), _signs(ny, nx, len(self._first))
            image = tile.contiguous().numpy()
            passes.lift(image, _taps(self._first), self._biases[0], self._slope, field, signs)
            kept = [signs]
            for weight, bias in zip(self._forwards, self._biases[1:], strict=True):
                ny, nx = ny - 2, nx - 2
                made, signs = room.field(ny, nx, len(bias)), _signs(ny, nx, len(bias))
                for block, product in room.products(field, weight, ny, nx):
                    passes.activate(product, *block, bias, self._slope, made, signs)
                field = made
                kept.append(signs)
            heights = onto_one_channel(_as_image(field), self._last)[: ny - 2, : nx - 2]
        return heights, [_as_image(signs) for signs in kept]

    def adjoint(self, slopes: Tensor, kept: Sequence[Tensor]) -> Tensor:
        """Gradient to a tile for that to its result, (y, x): larger by 2 per layer.

        ``kept`` are the signs that ``heights`` returned.
        """
        *hidden, signs = (sign[0].permute(1, 2, 0).numpy() for sign in kept)
        ny, nx = (length + 2 for length in slopes.shape)
        with self._room() as room:
            framed = room.framed(ny, nx, signs.shape[-1])
            image = functional.pad(slopes, (FRAME_PX,) * 4).numpy()
            passes.lift_back(image, _taps(adjoint_kernel(self._last)), self._slope, signs, framed)
            _close_frame(framed, ny, nx)
            for weight, signs in zip(reversed(self._backwards), reversed(hidden), strict=True):
                ny, nx = ny + 2, nx + 2
                made = room.framed(ny, nx, signs.shape[-1])
                for block, product in room.products(framed, weight, ny, nx):
                    passes.restrain(product, *block, self._slope, signs, made)
                _close_frame(made, ny, nx)
                framed = made
            return onto_one_channel(_as_image(framed), adjoint_kernel(self._first))[: ny + 2, : nx + 2]

    def free_rooms(self) -> None:
        """Give the memory back that tiles have left for the next ones."""
        self._idle_rooms.clear()

    @cached_property
    def _backwards(self) -> list[Tensor]:
        return [_in_frequencies(adjoint_kernel(weight)) for weight in self._hidden]

    @contextmanager
    def _room(self) -> Iterator[_Room]:
        """Room for one thread, left by an earlier tile if there is one."""
        try:
            room = self._idle_rooms.pop()
        except IndexError:
            room = _Room(self._side_px, max(len(bias) for bias in self._biases))
        try:
            yield room
        finally:
            self._idle_rooms.append(room)


class _Block(NamedTuple):
    """Some patches of a field, counted row by row."""

    first: int
    patches: int
    per_row: int


class _Room:
    """Memory for two fields, which take turns, and two spectra, used again for every layer and tile.

    It is one array so large that NumPy asks for large pages, and the spectra begin with one: a patch writes
    to 36 places, and to find as many small pages takes longer than to write.
    """

    def __init__(self, side_px: int, channels: int):
        spectrum, field = SPAN**2 * _BLOCK * channels, side_px**2 * channels
        memory = np.empty(2 * (spectrum + field) + _LARGE_PAGE_BYTES // 4, np.float32)
        start = -memory.ctypes.data % _LARGE_PAGE_BYTES // 4
        ends = np.cumsum([start, spectrum, spectrum, field, field])
        self._spectra = [memory[ends[i] : ends[i + 1]] for i in (0, 1)]
        self._fields = [memory[ends[i] : ends[i + 1]] for i in (2, 3)]

    def field(self, ny: int, nx: int, channels: int) -> _Floats:
        """Room for a field (ny, nx) and what its last patches reach, where zeros stand."""
        self._fields.reverse()
        shape = (ny + _SPARE_PX, nx + _SPARE_PX, channels)
        field = self._fields[0][: np.prod(shape)].reshape(shape)
        field[ny:] = 0
        field[:, nx:] = 0
        return field

    def framed(self, ny: int, nx: int, channels: int) -> _Floats:
        """The same in a frame ``FRAME_PX`` wide, zero where it begins; ``_close_frame`` when it is filled."""
        field = self.field(ny + 2 * FRAME_PX, nx + 2 * FRAME_PX, channels)
        field[:FRAME_PX] = 0
        field[:, :FRAME_PX] = 0
        return field

    def products(self, field: _Floats, weight: Tensor, ny: int, nx: int) -> Iterator[tuple[_Block, _Floats]]:
        """All frequencies of the convolution of ``field`` to (ny, nx), block by block in one array."""
        rows, per_row = (-(-length // PATCH_PX) for length in (ny, nx))
        transformed, product = (
            memory[: SPAN**2 * _BLOCK * channels].reshape(SPAN**2, _BLOCK, channels)
            for memory, channels in zip(self._spectra, weight.shape[1:], strict=True)
        )
        factor, result = torch.from_numpy(transformed), torch.from_numpy(product)
        for first in range(0, rows * per_row, _BLOCK):
            block = _Block(first, min(_BLOCK, rows * per_row - first), per_row)
            passes.to_frequencies(field, *block, transformed)
            # Whole arrays, also for the last block: parts of them would be multiplied one by one.
            torch.bmm(factor, weight, out=result)
            yield block, product


def _check_layers(weights: Sequence[Tensor], biases: Sequence[Tensor]) -> None:
    channels = [1, *(len(weight) for weight in weights)]
    shapes = [(outputs, inputs, 3, 3) for inputs, outputs in pairwise(channels)]
    got = [tuple(weight.shape) for weight in weights], [tuple(bias.shape) for bias in biases]
    if got != (shapes, [shape[:1] for shape in shapes]) or channels[-1] != 1:
        raise ValueError(f"channels of layers and biases do not fit: {got}")
    if any(count % LANES for count in channels[1:-1]):
        raise ValueError(f"channels are {channels[1:-1]}, not multiples of {LANES}")
    dtypes = {tensor.dtype for tensor in (*weights, *biases)}
    if dtypes != {torch.float32}:
        raise ValueError(f"weights and biases are {dtypes}, not float32")


def _in_frequencies(weight: Tensor) -> Tensor:
    """(36, inputs, outputs) of (outputs, inputs, 3, 3)."""
    transform = torch.tensor(_WEIGHT_TRANSFORM, dtype=torch.float64)
    taps = weight.double().permute(2, 3, 1, 0)
    frequencies = torch.kron(transform, transform) @ taps.reshape(9, -1)
    return frequencies.view(-1, *taps.shape[2:]).to(weight.dtype)


def _close_frame(framed: _Floats, ny: int, nx: int) -> None:
    """Zeros behind the field, where its last patches have left something."""
    framed[FRAME_PX + ny :] = 0
    framed[:, FRAME_PX + nx :] = 0


def _taps(weight: Tensor) -> _Floats:
    """(9, channels) of a kernel with one input."""
    return np.ascontiguousarray(weight.reshape(-1, 9).T.numpy())


def _signs(ny: int, nx: int, channels: int) -> _Signs:
    return np.empty((ny + _SPARE_PX, nx + _SPARE_PX, channels), np.int8)


def _as_image(field: _Floats | _Signs) -> Tensor:
    """(1, channels, y, x), channels last."""
    return torch.from_numpy(field).permute(2, 0, 1)[None]
