"""A frozen model for design, with fixed weights, and checks of geometry and calibrated range."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from litho_data.foundation.errors import InputError
from litho_data.reports.pictures import shown_html
from litho_models.frozen.card import ModelCard
from litho_models.layers.precision import Precision, network_precision, warn_where_slower
from litho_models.prediction.tiles import predict_field, predict_inside
from litho_models.simulator import Simulator, Tile, crop_border

if TYPE_CHECKING:
    import xarray as xr

    from litho_models.effects.chain import EffectChain

# Rounding to float32 may put the highest level slightly out of the range; the next level exceeds it by 100
# nm.
_ROUNDING_UM = 1e-5


Field = TypeVar("Field", np.ndarray, "xr.DataArray", Tensor)


class FrozenSimulator(nn.Module):
    """A process model for design, with fixed weights and with gradients only for its input.

    ``model(layout_um, pitch_um=0.1)`` maps a layout (b, 1, y, x) in µm to its printed height.
    """

    def __init__(self, simulator: Simulator | EffectChain, card: ModelCard, sha256: str, extrapolate: bool):
        super().__init__()
        self.simulator = simulator
        self.card: Mapping[str, Any] = card.model_dump(mode="json", by_alias=True)
        self.sha256 = sha256
        self.extrapolate = extrapolate
        # Receptive radius, µm; None if a pixel depends on the whole image.
        self.reach_um = simulator.reach_um if isinstance(simulator, Simulator) else None
        self._lowest_um, self._highest_um = card.calibrated_range_um
        self._precision: Precision = "float32"
        self.eval().requires_grad_(False)

    @property
    def name(self) -> str:
        """Return the name in the card."""
        return self.card["name"]

    @property
    def pitch_um(self) -> float:
        """Return the lateral sampling for which the model is made, µm."""
        return self.card["pitch_um"]

    @property
    def tile(self) -> Tile | None:
        """Return the tile of a model whose result depends on the size of the image; None for all others."""
        return self.simulator.tile

    @contextmanager
    def at_precision(self, precision: Precision) -> Iterator[None]:
        """Predict in ``precision`` inside the block (see ``network_precision``). Outside such a block,
        float32 is used.

        A line on stderr warns if this precision is slower than float32.
        """
        warn_where_slower(precision, next(self.parameters(), torch.empty(0)).device.type)
        before, self._precision = self._precision, precision
        try:
            yield
        finally:
            self._precision = before

    def train(self, mode: bool = True) -> FrozenSimulator:
        """Return the model unchanged, because frozen models stay in eval mode."""
        return super().train(False)

    def forward(
        self, layout_um: Tensor, pitch_um: float | None = None, level_height_um: float | None = None
    ) -> Tensor:
        """Predict the print of a layout; return its height (b, 1, y, x), µm.

        Args:
            layout_um: nominal height (b, 1, y, x), µm. Its dtype must be that of the weights: float32, or
                float64 after ``double()``.
            pitch_um: sampling of the layout; it is checked if given.
            level_height_um: level height of the layout; it is checked if given.

        Raises:
            InputError: the pitch or the level height differs from that of the model; the layout is not a
                tensor, or has the wrong shape or dtype; or heights lie beyond the calibrated range and
                ``extrapolate`` is not set.
        """
        self._check_layout(layout_um, pitch_um, level_height_um)
        if isinstance(self.simulator, Simulator):
            return self._in_precision(predict_field, self.simulator, layout_um)
        return self._in_precision(self.simulator, layout_um)

    def predict(self, layout_um: Field, pitch_um: float | None = None) -> Field:
        """Predict the print of a layout given as an array or tensor of any number of dimensions. Return the
        height, µm, with the same type and shape.

        Args:
            layout_um: nominal height (..., y, x), µm, of any float type: a NumPy array, an xarray array, or a
                tensor. If an xarray array has the coordinates y_um and x_um, they are checked. Gradients flow
                through a tensor.
            pitch_um: sampling of the layout; it is checked if given.

        Raises:
            InputError: as for ``forward``; also if the layout contains integers, which would be levels, or
                has fewer than two dimensions.
        """
        self.check_geometry(pitch_um)
        if isinstance(layout_um, Tensor):
            return self._predict_tensor(layout_um)
        if isinstance(layout_um, np.ndarray):
            device = next(self.parameters(), torch.empty(0)).device
            with torch.no_grad():
                return self._predict_tensor(torch.as_tensor(layout_um, device=device)).cpu().numpy()
        import xarray as xr

        if not isinstance(layout_um, xr.DataArray):
            kinds = "a NumPy or xarray array, or a PyTorch tensor"
            raise InputError("layout", got=f"a {type(layout_um).__name__}", wanted=kinds)
        _check_sampling(layout_um, self.pitch_um)
        printed = layout_um.copy(data=self.predict(layout_um.to_numpy())).rename("height_um")
        return printed.assign_attrs(units="µm", long_name="printed height")

    def _predict_tensor(self, layout_um: Tensor) -> Tensor:
        if not layout_um.is_floating_point():
            raise InputError(
                "layout",
                got="integers",
                wanted="heights in µm",
                hint=f"multiply levels by {self.card['level_height_um']:g} to get heights",
            )
        if layout_um.ndim < 2 or not layout_um.numel():
            shape = tuple(layout_um.shape)
            raise InputError("layout", got=f"shape {shape}", wanted="(..., y, x), with no empty dimension")
        dtype = next((weight.dtype for weight in self.parameters()), layout_um.dtype)
        fields = layout_um.to(dtype).reshape(-1, 1, 1, *layout_um.shape[-2:])
        # Fields are predicted one after the other, so that a stack needs no more memory than one field.
        return torch.cat([self(field) for field in fields]).reshape(layout_um.shape)

    def __repr__(self) -> str:
        card = self.card
        return (
            f"<FrozenSimulator {self.name}: {card['parameters']:,} parameters, pitch {self.pitch_um:g} µm, "
            f"{card['levels']} levels of {card['level_height_um']:g} µm, "
            f"heights from {self._lowest_um:g} to {self._highest_um:g} µm>"
        )

    def _repr_html_(self) -> str:
        return shown_html(repr(self)) + ModelCard.model_validate(self.card)._repr_html_()

    def inside(self, layout_um: Tensor, border_px: int, pitch_um: float | None = None) -> Tensor:
        """Predict as ``forward`` does, but crop ``border_px`` on each side; return (b, 1, y - 2 border, x - 2
        border) µm.

        If the border is at least as wide as the receptive radius, only the pixels that the result needs are
        computed, and nothing is assumed about the layout beyond its edge. If the model runs on tiles, only
        the needed pixels are computed as well.

        Raises:
            InputError: as for ``forward``, or a border that leaves no pixels.
        """
        self._check_layout(layout_um, pitch_um, None)
        if not 0 <= 2 * border_px < min(layout_um.shape[-2:]):
            raise InputError(
                f"border of a print by {self.name}",
                got=f"{border_px} px of a layout of {tuple(layout_um.shape[-2:])} px",
                wanted="0 px or more, and less than half the layout",
            )
        if isinstance(self.simulator, Simulator):
            inside = partial(predict_inside, border_px=border_px)
            return self._in_precision(inside, self.simulator, layout_um)
        return crop_border(self._in_precision(self.simulator, layout_um), border_px)

    def _in_precision(self, predict: Callable[..., Tensor], *given: Any) -> Tensor:
        if self._precision == "float32":
            return predict(*given)
        with network_precision(self._precision, given[-1].device.type):
            return predict(*given).to(given[-1].dtype)

    def _check_layout(self, layout_um: Tensor, pitch_um: float | None, level_height_um: float | None) -> None:
        self.check_geometry(pitch_um, level_height_um)
        if not isinstance(layout_um, Tensor):
            raise InputError(
                "layout",
                got=f"a {type(layout_um).__name__}",
                wanted="a PyTorch tensor",
                hint="torch.from_numpy converts a NumPy array",
            )
        if layout_um.ndim != 4 or layout_um.shape[1] != 1 or not layout_um.numel():
            raise InputError(
                "layout",
                got=f"shape {tuple(layout_um.shape)}",
                wanted="(batch, 1, y, x), with no empty dimension",
            )
        # A model without weights accepts a layout of any floating-point type.
        own = layout_um.dtype if layout_um.is_floating_point() else torch.float32
        wanted = next((weight.dtype for weight in self.parameters()), own)
        if layout_um.dtype != wanted:
            raise InputError(
                "layout",
                got=layout_um.dtype,
                wanted=f"{wanted}, like the weights",
                hint=f"use layout.to({wanted})",
            )
        if not self.extrapolate:
            self._check_range(layout_um)

    def check_geometry(self, pitch_um: float | None, level_height_um: float | None = None) -> None:
        """Refuse a pitch or level height that differs from the model's; None is not checked.

        Raises:
            InputError: they differ.
        """
        for name, given in (("pitch_um", pitch_um), ("level_height_um", level_height_um)):
            wanted = self.card[name]
            if given is not None and not abs(given - wanted) <= 1e-9:
                raise InputError(
                    f"{name} for model {self.name}", got=f"{given:g} µm", wanted=f"{wanted:g} µm"
                )

    def _check_range(self, layout_um: Tensor) -> None:
        lowest, highest = (float(v) for v in torch.aminmax(layout_um.detach()))
        inside = lowest >= self._lowest_um - _ROUNDING_UM and highest <= self._highest_um + _ROUNDING_UM
        if not inside:
            raise InputError(
                f"layout for model {self.name}",
                got=f"heights from {lowest:g} to {highest:g} µm",
                wanted=f"{self._lowest_um:g} to {self._highest_um:g} µm, the calibrated range",
                hint="load the model with extrapolate=True to accept these heights; predictions are then "
                "less certain",
            )


def _check_sampling(layout_um: xr.DataArray, pitch_um: float) -> None:
    if layout_um.dims[-2:] != ("y", "x"):
        raise InputError("layout", got=f"dimensions {layout_um.dims}", wanted="(..., 'y', 'x')")
    for name in ("y_um", "x_um"):
        if name in layout_um.coords:
            steps = np.diff(layout_um[name].to_numpy())
            # A tolerance of a millionth of a pixel allows for the rounding of positions across a millimetre.
            if not np.allclose(steps, pitch_um, rtol=1e-6, atol=0):
                got = f"steps of {steps.min():g} to {steps.max():g} µm"
                raise InputError(f"{name} of the layout", got=got, wanted=f"{pitch_um:g} µm")
