"""The class of loaded frozen models. A loaded model predicts prints with fixed weights, and checks the
geometry and the heights of every layout.
"""

from __future__ import annotations

import math
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

# Tolerance of the calibrated range. Rounding to float32 may put the highest calibrated level slightly beyond
# the range. A layout with one more level would exceed the range by a whole level height (100 nm in the first
# prints), which is far more than this tolerance.
_ROUNDING_UM = 1e-5
# Width of the border of level 0 around an element, for a model whose prints depend on the whole layout.
_WIDEST_GUARD_UM = 6.4


Field = TypeVar("Field", np.ndarray, "xr.DataArray", Tensor)


class FrozenSimulator(nn.Module):
    """A process model for design. Its weights are fixed, and gradients flow only to its input.

    ``model(layout_um, pitch_um=0.1)`` returns the printed height of a layout. Layout and height are tensors
    of shape (batch, 1, ny, nx), in µm.
    """

    def __init__(self, simulator: Simulator | EffectChain, card: ModelCard, sha256: str, extrapolate: bool):
        super().__init__()
        self.simulator = simulator
        self.card: Mapping[str, Any] = card.model_dump(mode="json", by_alias=True)
        self.sha256 = sha256
        self.extrapolate = extrapolate
        # Receptive radius, µm, or None if the height of each pixel depends on the whole layout.
        self.reach_um = simulator.reach_um if isinstance(simulator, Simulator) else None
        self._lowest_um, self._highest_um = card.calibrated_range_um
        self._precision: Precision = "float32"
        self.eval().requires_grad_(False)

    @property
    def name(self) -> str:
        """Return the name of the model, as stated in its card."""
        return self.card["name"]

    @property
    def pitch_um(self) -> float:
        """Return the pixel pitch for which the model was made, µm."""
        return self.card["pitch_um"]

    @property
    def guard_px(self) -> int:
        """Return the width, in pixels, of the border of level 0 to add around an element that stands alone on
        the substrate. Without this border, the model would assume that the outermost pixels of the element
        continue beyond its edge.
        """
        width_um = _WIDEST_GUARD_UM if self.reach_um is None else self.reach_um
        # A receptive radius is a whole number of pixels, apart from rounding errors.
        return math.ceil(width_um / self.pitch_um - 1e-6)

    @property
    def tile(self) -> Tile | None:
        """Return the tile size if the result of the model depends on the size of its input. Otherwise return
        None.
        """
        return self.simulator.tile

    @contextmanager
    def at_precision(self, precision: Precision) -> Iterator[None]:
        """Context manager for a block in which the model predicts in the given precision (see
        ``network_precision``). Outside such a block, the model predicts in float32.

        If the given precision is slower than float32 on this processor, a warning is printed on stderr.
        """
        warn_where_slower(precision, next(self.parameters(), torch.empty(0)).device.type)
        before, self._precision = self._precision, precision
        try:
            yield
        finally:
            self._precision = before

    def train(self, mode: bool = True) -> FrozenSimulator:
        """Do nothing and return the model, because frozen models always stay in eval mode."""
        return super().train(False)

    def forward(
        self, layout_um: Tensor, pitch_um: float | None = None, level_height_um: float | None = None
    ) -> Tensor:
        """Predict the print of a layout. Return its height in µm, with the shape of the layout.

        Args:
            layout_um: nominal height, µm, as a tensor of shape (batch, 1, ny, nx). Its dtype must be that of
                the weights: float32, or float64 after ``double()``.
            pitch_um: sampling of the layout; it is checked if given.
            level_height_um: height of one level of the layout, µm; it is checked if given.

        Raises:
            InputError: the pitch or the level height differs from that of the model; the layout is not a
                tensor, contains NaN, or has the wrong shape or dtype; or heights of the layout lie beyond the
                calibrated range and the model was loaded without ``extrapolate``.
        """
        self._check_layout(layout_um, pitch_um, level_height_um)
        if isinstance(self.simulator, Simulator):
            return self._in_precision(predict_field, self.simulator, layout_um)
        return self._in_precision(self.simulator, layout_um)

    def predict(self, layout_um: Field, pitch_um: float | None = None) -> Field:
        """Predict the print of one layout or of a stack of layouts. Return the height, µm, as an array of the
        same type and shape.

        Args:
            layout_um: nominal height, µm, of any float type and of shape (..., ny, nx): a NumPy array, an
                xarray array, or a tensor. The coordinates y_um and x_um of an xarray array, if present, are
                checked against the pitch. If the layout is a tensor, gradients flow to it.
            pitch_um: sampling of the layout; it is checked if given.

        Raises:
            InputError: as for ``forward``. An error is also raised if the layout has fewer than two
                dimensions, or if it contains integers, because integers would be level numbers instead of
                heights.
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
        # The layouts are predicted one after the other, so that a stack needs no more memory than one layout.
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
        """Predict as ``forward`` does, but return the height without a border of ``border_px`` pixels on each
        side. The result is in µm and has shape (batch, 1, ny - 2 border_px, nx - 2 border_px).

        If the border is at least as wide as the receptive radius, only the pixels of the result are computed,
        and nothing is assumed about the layout beyond its edge. If the model runs on tiles, only the tiles
        that the result needs are computed.

        Raises:
            InputError: as for ``forward``, or the border leaves no pixels.
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
        # A model without weights accepts layouts of any floating-point type.
        own = layout_um.dtype if layout_um.is_floating_point() else torch.float32
        wanted = next((weight.dtype for weight in self.parameters()), own)
        if layout_um.dtype != wanted:
            raise InputError(
                "layout",
                got=layout_um.dtype,
                wanted=f"{wanted}, like the weights",
                hint=f"use layout.to({wanted})",
            )
        self._check_range(layout_um)

    def check_geometry(self, pitch_um: float | None, level_height_um: float | None = None) -> None:
        """Check that a pitch and a level height, µm, are those of the model. A value of None is not checked.

        Raises:
            InputError: a given value differs from that of the model.
        """
        for name, given in (("pitch_um", pitch_um), ("level_height_um", level_height_um)):
            wanted = self.card[name]
            if given is not None and not abs(given - wanted) <= 1e-9:
                raise InputError(
                    f"{name} for model {self.name}", got=f"{given:g} µm", wanted=f"{wanted:g} µm"
                )

    def _check_range(self, layout_um: Tensor) -> None:
        lowest, highest = (float(v) for v in torch.aminmax(layout_um.detach()))
        if np.isnan(lowest):
            got = f"NaN in {int(layout_um.isnan().sum())} of {layout_um.numel()} pixels"
            raise InputError(f"layout for model {self.name}", got=got, wanted="a height for every pixel")
        inside = lowest >= self._lowest_um - _ROUNDING_UM and highest <= self._highest_um + _ROUNDING_UM
        if not (inside or self.extrapolate):
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
