"""Define the interface of every model of the printer, which maps a layout to a printed height."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple, Self, get_args

from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor, nn

from litho_data.foundation.errors import require_known
from litho_models.layers.gaussian import pad_field
from litho_models.layers.ranges import Range

Variant = Literal["default", "paper", "authors"]
VARIANTS: tuple[str, ...] = get_args(Variant)
SMALL_PARAMETERS = 64
FIRST_SPOT_UM = 0.2
"""Spot of the first printer (standard deviation, µm). Default lengths of models are multiples of it."""
_RESOLVED_PX = (0.5, 10.0)
_SPOT_PX = 2.0


def spot_um(pitch_um: float) -> float:
    """Return the spot (standard deviation, µm) from which the default lengths for layouts with this pitch are
    derived.

    This is the spot of the first printer if it is between half a pixel and ten pixels wide. Otherwise the
    layouts belong to another printer, whose spot is assumed to be two pixels wide.
    """
    low, high = _RESOLVED_PX
    return FIRST_SPOT_UM if low <= FIRST_SPOT_UM / pitch_um <= high else _SPOT_PX * pitch_um


def scaled_lengths(config: type[BaseModel], set_: dict[str, Any], pitch_um: float) -> dict[str, Any]:
    """Scale the lengths of a config to a pitch. Lengths that are missing in ``set_`` take their default
    values. Return an empty dict if the scale is 1.
    """
    scale = spot_um(pitch_um) / FIRST_SPOT_UM
    if scale == 1:
        return {}
    lengths = getattr(config, "LENGTHS", ())
    values = {name: set_.get(name, config.model_fields[name].default) for name in lengths}
    return {
        name: tuple(scale * one for one in value) if isinstance(value, tuple) else scale * value
        for name, value in values.items()
    }


class SimulatorConfig(BaseModel):
    """Geometry and variant of a model; subclasses add their hyper-parameters.

    ``VARIANT_FIELDS`` lists the fields that a variant sets. The config stores the values of these fields, so
    a saved model does not depend on later definitions of a variant.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    VARIANT_FIELDS: ClassVar[dict[str, dict[str, Any]]] = {}
    # Fields whose defaults are multiples of the first printer's spot.
    LENGTHS: ClassVar[tuple[str, ...]] = ()

    variant: Variant = "default"
    pitch_um: float = Field(0.1, gt=0, description="lateral sampling, µm")
    level_height_um: float = Field(0.1, gt=0, description="nominal height of one level, µm")
    levels: int = Field(13, ge=2, le=65536, description="number of layout levels, 0 included")
    fixed: tuple[str, ...] = Field((), description="names, as in ranges, of parameters that no fit changes")

    @classmethod
    def of_variant(cls, variant: Variant = "default", **fields: Any) -> Self:
        """Make the config of a named variant; ``fields`` (geometry or hyper-parameters) override the variant.

        Raises:
            InputError: unknown variant.
        """
        require_known("variant", variant, VARIANTS)
        own = cls.VARIANT_FIELDS.get(variant, {})
        lengths = scaled_lengths(cls, own, fields.get("pitch_um", cls.model_fields["pitch_um"].default))
        return cls(**{"variant": variant, **own, **lengths, **fields})

    @property
    def full_height_um(self) -> float:
        """Return the nominal height of the highest level, µm."""
        return (self.levels - 1) * self.level_height_um


class Tile(NamedTuple):
    """A square on which a model is trained and evaluated; neighbouring tiles overlap by ``overlap_px`` and
    are blended.
    """

    size_px: int
    overlap_px: int


class Simulator(nn.Module, ABC):
    """A process model: ``model(layout_um) -> height_um``, both (batch, 1, y, x) float32 in µm.

    A subclass implements ``interior``. A pixel of the interior may depend only on the layout within
    ``reach_px``, so a crop with this margin gives the same height as the whole field.
    """

    name: ClassVar[str]
    Config: ClassVar[type[SimulatorConfig]] = SimulatorConfig
    # Whether the height is linear in the parameters; if so, one Jacobian serves the whole fit.
    is_linear: ClassVar[bool] = False

    def __init__(self, config: SimulatorConfig):
        super().__init__()
        self.config = config

    def register_parameter(self, name: str, param: nn.Parameter | None) -> None:
        """Register a parameter. A parameter that the config fixes is not trained."""
        known = self.ranges[name].name if name in self.ranges else name
        if param is not None and known in self.config.fixed:
            param.requires_grad_(False)
        super().register_parameter(name, param)

    @property
    @abstractmethod
    def reach_px(self) -> int | None:
        """Return the receptive radius in pixels; None if a pixel depends on the whole image."""

    @property
    def tile(self) -> Tile | None:
        """Return the tile of a model whose result depends on the size of the image; None for other models."""
        return None

    @abstractmethod
    def interior(self, layout_um: Tensor) -> Tensor:
        """Return the height in µm of the pixels that are farther than ``reach_px`` from the edge. The result
        is (b, 1, y - 2r, x - 2r), where r is ``reach_px``.

        A model without a receptive radius receives a whole image or one tile, and returns heights of the same
        size.
        """

    def forward(self, layout_um: Tensor) -> Tensor:
        """Return the height of the whole field. Beyond the edge of the layout, its outermost pixels are
        repeated.
        """
        reach = self.reach_px or 0
        return self.interior(pad_field(layout_um, reach, reach))

    def inside(self, layout_um: Tensor, border_px: int) -> Tensor:
        """Return the result of ``forward`` with ``border_px`` cropped on each side, µm.

        A model without a receptive radius overrides this method if it need not compute the border. For other
        models, ``predict_inside`` computes only the pixels that are needed.
        """
        return crop_border(self(layout_um), border_px)

    def printer(self) -> Simulator:
        """Return the model without its part for the microscope, or the model itself if it has no such
        part.
        """
        return self

    @property
    def ranges(self) -> dict[str, Range]:
        """Return the ranges of the values that are limited. Each key is the name of the parameter that holds
        the value as one raw number. Other parameters are not limited.
        """
        return {}

    @property
    def at_bounds(self) -> dict[str, float]:
        """Return the values that lie on a bound of their range, as a dict from the name of the value to this
        bound.
        """
        parameters = dict(self.named_parameters())
        bounds = {own.name: own.bound_at(parameters[key].item()) for key, own in self.ranges.items()}
        return {name: bound for name, bound in bounds.items() if bound is not None}

    @property
    def pitch_um(self) -> float:
        """Return the pixel pitch of the model, µm."""
        return self.config.pitch_um

    @property
    def reach_um(self) -> float | None:
        """Return the receptive radius in µm; None if a pixel depends on the whole image."""
        return None if self.reach_px is None else round(self.reach_px * self.pitch_um, 9)

    @property
    def parameter_count(self) -> int:
        """Return the number of trained values."""
        return sum(parameter.numel() for parameter in self.parameters())


def is_small(model: nn.Module) -> bool:
    """Return whether the model has at most ``SMALL_PARAMETERS`` trainable parameters.

    Small models are fitted by least squares, unless the paper's recipe is used. The loop fits a small model
    together with the effects. Other models are trained by stochastic gradient descent, and the loop does not
    refit them.
    """
    return sum(p.numel() for p in model.parameters() if p.requires_grad) <= SMALL_PARAMETERS


def crop_border(field: Tensor, border_px: int) -> Tensor:
    """Crop ``border_px`` from all four sides of a field (..., y, x)."""
    if border_px == 0:
        return field
    return field[..., border_px:-border_px, border_px:-border_px]
