"""Modular models of printers, assembled from parts. One class implements all of these models, and subclasses
contain default settings for several machines.
"""

from __future__ import annotations

from typing import Any, Self

from pydantic import Field, model_validator
from torch import Tensor, nn

from litho_models.layers.ranges import Range
from litho_models.models.parts import Number, Part, part_of
from litho_models.simulator import Simulator, SimulatorConfig, Variant


class PrinterConfig(SimulatorConfig):
    """Configuration of a printer: its parts, in the order in which they act, and the values of their
    parameters. The configured value of a fitted parameter is its starting value; all other parameters keep
    their configured values. The name of a parameter has the form ``part.parameter``.

    A parameter can also be set under this name, such as ``spot.sigma_um``, as if it were a field of the
    configuration.
    """

    parts: tuple[str, ...] = Field(
        ("spot", "tanh"), min_length=1, description="names of the parts, in the order in which they act"
    )
    numbers: dict[str, float] = Field(
        {}, description="values of parameters that replace the defaults of the parts"
    )

    @classmethod
    def of_variant(cls, variant: Variant = "default", **fields: Any) -> Self:
        """Make the configuration of a variant, as ``SimulatorConfig.of_variant`` does. ``fields`` may also
        contain values for parameters of the parts.
        """
        own = {**cls.model_fields["numbers"].default, **fields.get("numbers", {})}
        own |= {name: value for name, value in fields.items() if "." in name}
        parts = fields.get("parts", cls.model_fields["parts"].default)
        own = {name: value for name, value in own.items() if name in fields or name.split(".")[0] in parts}
        kept = {name: value for name, value in fields.items() if "." not in name}
        return super().of_variant(variant, **{**kept, "numbers": own})

    @model_validator(mode="after")
    def _can_be_built(self) -> Self:
        known = {name: number for _, name, number in self.all_numbers()}
        if len(set(self.parts)) < len(self.parts):
            raise ValueError("each part may be named only once")
        for name, value in self.numbers.items():
            if name not in known:
                raise ValueError(f"{name} is not a parameter of these parts; they have {', '.join(known)}")
            upper = known[name].range_at(name, value).upper
            if not known[name].lower <= value <= upper:
                raise ValueError(f"{name} is {value:g}, but must be {known[name].lower:g} to {upper:g}")
        return self

    def all_numbers(self) -> list[tuple[Part, str, Number]]:
        """Return all parameters of all parts, each as a tuple of its part, its name and the parameter."""
        found = map(part_of, self.parts)
        return [(part, f"{part.name}.{key}", own) for part in found for key, own in part.numbers.items()]


class Printer(Simulator):
    """A printer that applies its parts one after the other: H = H₀ · (…part₂(part₁(M / H₀))). M is the
    layout, H the printed height, and H₀ the nominal height of the highest level.
    """

    name = "printer"
    Config = PrinterConfig
    config: PrinterConfig

    def __init__(self, config: PrinterConfig):
        super().__init__(config)
        for _, name, number in config.all_numbers():
            if number.fitted:
                key, start = _key(name), config.numbers.get(name, number.start)
                self.register_parameter(key, nn.Parameter(self.ranges[key].raw(start)))

    @property
    def ranges(self) -> dict[str, Range]:
        given = self.config.numbers
        return {
            _key(name): number.range_at(name, given.get(name, number.start))
            for _, name, number in self.config.all_numbers()
            if number.fitted
        }

    @property
    def reach_px(self) -> int:
        return sum(part.reach_px(values, self.pitch_um) for part, values in self._chain())

    def interior(self, layout_um: Tensor) -> Tensor:
        field = layout_um / self.config.full_height_um
        for part, values in self._chain():
            field = part.apply(field, values, self.pitch_um)
        return self.config.full_height_um * field

    def _chain(self) -> list[tuple[Part, dict[str, Any]]]:
        """Return the parts in order, each as a tuple of the part and the values of its parameters, keyed by
        name. Values that are not fitted are Python numbers.
        """
        known = {**self.config.numbers, **self.values}
        found: dict[str, dict[str, Any]] = {name: {} for name in self.config.parts}
        for part, name, number in self.config.all_numbers():
            found[part.name][name.partition(".")[2]] = known.get(name, number.start)
        return [(part_of(name), values) for name, values in found.items()]


def _key(name: str) -> str:
    """Convert the name of a parameter of a part to a name for a torch parameter, which must not contain a
    full stop.
    """
    return f"raw_{name.replace('.', '__').replace('-', '_')}"


class ElectronBeamConfig(PrinterConfig):
    parts: tuple[str, ...] = ("two-spots", "hill", "diffusion", "etch")
    numbers: dict[str, float] = Field(
        {
            "two-spots.sigma_um": 0.02,
            "two-spots.back_um": 0.06,
            "diffusion.sigma_um": 0.008,
        }
    )
    fixed: tuple[str, ...] = ("etch.threshold",)


class ElectronBeam(Printer):
    """An electron-beam writer with backscattering. The resist is the mask for etching a film."""

    name = "e-beam"
    Config = ElectronBeamConfig


class ProjectionConfig(PrinterConfig):
    parts: tuple[str, ...] = ("lens", "diffusion", "etch")
    numbers: dict[str, float] = Field({"diffusion.sigma_um": 0.05, "etch.threshold": 0.25})


class Projection(Printer):
    """A projection lens with a partially coherent source. The resist is the mask for etching a film."""

    name = "projection"
    Config = ProjectionConfig


class LaserWriterConfig(PrinterConfig):
    parts: tuple[str, ...] = ("spot", "contrast-curve", "transfer")
    numbers: dict[str, float] = Field({"spot.sigma_um": 0.25})


class LaserWriter(Printer):
    """A laser writer that makes multi-level reliefs. The resist is described by a contrast curve."""

    name = "laser-writer"
    Config = LaserWriterConfig


class DmdGrayscaleConfig(PrinterConfig):
    parts: tuple[str, ...] = ("spot", "tanh", "diffusion", "transfer")
    numbers: dict[str, float] = Field({"spot.sigma_um": 0.3, "diffusion.sigma_um": 0.1, "tanh.contrast": 1.0})


class DmdGrayscale(Printer):
    """A printer with a micromirror device that makes multi-level reliefs. The dose diffuses in the resist."""

    name = "dmd-grayscale"
    Config = DmdGrayscaleConfig
