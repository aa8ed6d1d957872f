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
"""Spot size (standard deviation, µm) of the printer that made the first measured prints. The default lengths
of all models are multiples of it.
"""
_RESOLVED_PX = (0.5, 10.0)
_SPOT_PX = 2.0


def spot_um(pitch_um: float) -> float:
    """Return the spot size (standard deviation, µm) from which a model derives its default lengths. It
    depends on the pixel pitch of the layouts.

    The result is ``FIRST_SPOT_UM`` if this length is between half a pixel and ten pixels. Otherwise, the
    layouts are assumed to belong to another printer with a spot of two pixels.
    """
    low, high = _RESOLVED_PX
    return FIRST_SPOT_UM if low <= FIRST_SPOT_UM / pitch_um <= high else _SPOT_PX * pitch_um


def scaled_lengths(config: type[BaseModel], set_: dict[str, Any], pitch_um: float) -> dict[str, Any]:
    """Scale the length settings of a model (such as blur widths) to the spot size for the given pitch, and
    return the scaled values. A length that ``set_`` contains is scaled from its value there, and any other
    length from its default. If the scale is 1, the returned dict is empty.
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
    """Configuration of a model: its geometry and its variant. Subclasses add their hyper-parameters.

    ``VARIANT_FIELDS`` lists the fields whose values depend on the variant. The configuration stores these
    values, not only the name of the variant. A saved model therefore stays the same if the definition of a
    variant changes later.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
    VARIANT_FIELDS: ClassVar[dict[str, dict[str, Any]]] = {}
    # Names of the fields whose defaults are multiples of FIRST_SPOT_UM.
    LENGTHS: ClassVar[tuple[str, ...]] = ()

    variant: Variant = "default"
    pitch_um: float = Field(0.1, gt=0, description="pixel pitch of layouts and heights, µm")
    level_height_um: float = Field(0.1, gt=0, description="nominal height of one layout level, µm")
    levels: int = Field(13, ge=2, le=65536, description="number of layout levels, level 0 included")
    fixed: tuple[str, ...] = Field((), description="names of parameters that no fit changes")

    @classmethod
    def of_variant(cls, variant: Variant = "default", **fields: Any) -> Self:
        """Make the configuration of a named variant. Values in ``fields`` (geometry or hyper-parameters)
        replace the values that the variant sets.

        Raises:
            InputError: the variant is unknown.
        """
        require_known("variant", variant, VARIANTS)
        own = cls.VARIANT_FIELDS.get(variant, {})
        lengths = scaled_lengths(cls, own, fields.get("pitch_um", cls.model_fields["pitch_um"].default))
        return cls(**{"variant": variant, **own, **lengths, **fields})

    @property
    def full_height_um(self) -> float:
        """Return the nominal height of the highest layout level, µm."""
        return (self.levels - 1) * self.level_height_um


class Tile(NamedTuple):
    """Size of the square tiles on which a model is trained and evaluated. Neighbouring tiles overlap by
    ``overlap_px`` pixels, and predictions are blended in the overlap.
    """

    size_px: int
    overlap_px: int


class Simulator(nn.Module, ABC):
    """A process model: ``model(layout_um)`` returns the printed height. Layout and height are float32 tensors
    of shape (batch, 1, ny, nx), in µm.

    A subclass implements ``interior``. The height of a pixel may depend only on the layout within
    ``reach_px`` pixels of it. The heights of a part of the layout can therefore be predicted from this part
    with a margin of ``reach_px``; they are the same as in a prediction of the whole layout.
    """

    name: ClassVar[str]
    Config: ClassVar[type[SimulatorConfig]] = SimulatorConfig
    # True if the height is linear in the parameters. The Jacobian is then constant and is computed only once
    # per fit.
    is_linear: ClassVar[bool] = False

    def __init__(self, config: SimulatorConfig):
        super().__init__()
        self.config = config

    def register_parameter(self, name: str, param: nn.Parameter | None) -> None:
        """Register a parameter. A parameter that the configuration lists in ``fixed`` is not trained."""
        known = self.ranges[name].name if name in self.ranges else name
        if param is not None and known in self.config.fixed:
            param.requires_grad_(False)
        super().register_parameter(name, param)

    @property
    @abstractmethod
    def reach_px(self) -> int | None:
        """Return the receptive radius in pixels, or None if the height of each pixel depends on the whole
        layout.
        """

    @property
    def tile(self) -> Tile | None:
        """Return the tile size if the result of the model depends on the size of its input. Otherwise return
        None.
        """
        return None

    @abstractmethod
    def interior(self, layout_um: Tensor) -> Tensor:
        """Return the height, µm, of the pixels that are at least ``reach_px`` from the edge of the layout.
        For a layout of shape (batch, 1, ny, nx), the result has shape (batch, 1, ny - 2r, nx - 2r), where r
        is ``reach_px``.

        A model without a receptive radius receives a whole layout or one tile of it, and returns heights of
        the same shape.
        """

    def forward(self, layout_um: Tensor) -> Tensor:
        """Return the height of the whole layout, µm. Before the computation, the layout is padded by
        repeating its outermost pixels.
        """
        reach = self.reach_px or 0
        return self.interior(pad_field(layout_um, reach, reach))

    def inside(self, layout_um: Tensor, border_px: int) -> Tensor:
        """Return the same height as ``forward``, µm, but with ``border_px`` pixels cropped on each side.

        A model without a receptive radius may override this method to skip the computation of the border. For
        models with a receptive radius, ``predict_inside`` computes only the pixels that are needed.
        """
        return crop_border(self(layout_um), border_px)

    def printer(self) -> Simulator:
        """Return the model of the printer alone. If the model also describes the microscope, return a model
        without the description of the microscope. Otherwise, return the model itself.
        """
        return self

    @property
    def ranges(self) -> dict[str, Range]:
        """Return the allowed ranges of the model's physical values. Each key is the name of a parameter that
        stores the physical value as one raw number (see ``layers.ranges``). Parameters that are not among the
        keys have no range.
        """
        return {}

    @property
    def values(self) -> dict[str, Tensor]:
        """Return the values of all scalar parameters, keyed by name. If a parameter has a range, its raw
        number is converted to the physical value, and its key is the name of the range.
        """
        ranges, found = self.ranges, dict[str, Tensor]()
        for key, raw in self.named_parameters():
            if raw.numel() == 1:
                own = ranges.get(key)
                found[own.name if own else key] = own.value(raw) if own else raw
        return found

    @property
    def at_bounds(self) -> dict[str, float]:
        """Return the physical values that lie on a bound of their range, as a dict from the name of the value
        to the bound.
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
        """Return the receptive radius in µm. Return None if the height of each pixel depends on the whole
        layout.
        """
        return None if self.reach_px is None else round(self.reach_px * self.pitch_um, 9)

    @property
    def parameter_count(self) -> int:
        """Return the total number of scalar values in all parameters, including fixed parameters."""
        return sum(parameter.numel() for parameter in self.parameters())


def is_small(model: nn.Module) -> bool:
    """Return True if the model has at most ``SMALL_PARAMETERS`` trainable values.

    Small models are fitted by least squares, unless the training recipe ``paper`` is used. The closed loop
    fits a small base model together with the effects that it adds. Larger models are trained by stochastic
    gradient descent, and the closed loop leaves them unchanged.
    """
    return sum(p.numel() for p in model.parameters() if p.requires_grad) <= SMALL_PARAMETERS


def crop_border(field: Tensor, border_px: int) -> Tensor:
    """Crop ``border_px`` pixels from all four sides of a field of shape (..., ny, nx)."""
    if border_px == 0:
        return field
    return field[..., border_px:-border_px, border_px:-border_px]
