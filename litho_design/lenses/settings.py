"""The settings of a lens and their presets, including the choices that the paper leaves open."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, get_args

from pydantic import model_validator

from litho_data.commands.settings import setting
from litho_data.foundation.results import Record
from litho_design.images.targets import DrawnTarget, ImagedObject, object_name
from litho_design.optics import Optics
from litho_design.optimisation.process_window import ProcessWindow
from litho_design.optimisation.settings import (
    PAPER_SEARCH,
    DesignSettings,
    SearchSettings,
    Variant,
    preset,
)
from litho_design.printers.layout import LayoutSettings

# The smooth L1 loss is quadratic for differences in grey below this value (white is 1), as in the published
# code.
SMOOTH_BELOW = 0.1

LensTaskName = Literal["direct", "computational"]


class LensView(Record):
    """Aperture, PSF window and search path of a lens.

    The PSF window around the focus is ``window_px`` pixels wide; its pixels have the pitch of the layout.
    With ``path="radial"``, the search predicts the print of only a strip along one radius and propagates
    light from rings, instead of using the whole plane. This path needs a circular aperture and a layout of
    rings. Scores are always computed on the plane.
    """

    FORMER: ClassVar[frozenset[str]] = frozenset({"centre_um"})

    aperture: Literal["square", "circle"] = setting("circle", "Aperture of the lens")
    window_px: int = setting(254, "Side of the PSF window of a lens", unit="px", option="--window-px", ge=16)
    path: Literal["plane", "radial"] = setting(
        "plane", "Search over the whole plane, or over rings along a radius"
    )


class ImagingSettings(Record):
    """Settings of computational imaging: the sensor, its noise, the reconstruction, the objects imaged in the
    search, and the objects imaged only for the scores.

    An object is given by the name of a drawing or by the record of a picture (see ``with_objects``).
    ``read_noise`` is the standard deviation of the read noise, relative to the brightness of a white object
    behind a lens that focuses all light. The paper does not state its read noise. The image of an object is
    ``object_px * pixel_px`` layout pixels wide. The part of the PSF outside the PSF window does not
    contribute to this image.
    """

    pixel_px: int = setting(2, "Side of a sensor pixel, in pixels of the layout", unit="px", ge=1)
    objects: tuple[ImagedObject, ...] = setting(("text", "chart", "spots"), "Drawings imaged in the search")
    test_objects: tuple[ImagedObject, ...] = setting(
        ("ring", "letters"), "Drawings imaged only for the scores"
    )
    object_px: int = setting(
        128,
        "Computational lens: side of the objects, in sensor pixels",
        unit="px",
        option="--object-px",
        ge=32,
    )
    read_noise: float = setting(0.01, "Read noise, relative to a white object", ge=0)
    photon_noise: float = setting(
        0.0, "Photon noise: ratio of variance to signal, both relative to a white object", ge=0
    )
    loss: Literal["l1", "smooth-l1"] = setting(
        "l1", f"Image error in the search: l1, or smooth-l1, which is quadratic below {SMOOTH_BELOW}"
    )
    iterations: int = setting(50, "Iterations of the Richardson-Lucy deconvolution", ge=1)

    @model_validator(mode="after")
    def _held_out(self) -> ImagingSettings:
        drawn = {item for item in (*self.objects, *self.test_objects) if isinstance(item, str)}
        unknown = sorted(drawn - set(get_args(DrawnTarget)))
        if unknown:
            raise ValueError(f"object {unknown[0]!r} is not one of {', '.join(get_args(DrawnTarget))}")
        seen = sorted(object_name(item) for item in set(self.objects) & set(self.test_objects))
        if seen:
            raise ValueError(f"object {seen[0]!r} is used both in the design and in the test")
        if not self.objects or len(self.test_objects) < 2:
            raise ValueError("at least one object for the design and two for the test are needed")
        return self


# The paper images a display that is 36 mm wide at a distance of 140 mm; at 400 µm behind the lens, its image
# is 102.9 µm wide. Objects with 137 sensor pixels have this width inside a dark border, which is 1/8 of the
# 137 pixels wide on each side.
PAPER_IMAGING = ImagingSettings(pixel_px=10, object_px=137)


class LensSettings(DesignSettings):
    """All settings of one lens."""

    task: LensTaskName = setting(
        "direct", "Focus light (direct), or image and deconvolve (computational)", option="--task"
    )
    layout: LayoutSettings = setting(LayoutSettings(size_px=1200, cell_um=0.1, symmetry="radial"), "Layout")
    optics: Optics = setting(Optics(distance_um=400.0), "Optics")
    search: SearchSettings = setting(
        SearchSettings(start="fresnel", iterations=200, learning_rate=0.3), "Search"
    )
    # The yield is measured with few draws. Each draw needs the light on the whole plane and therefore takes
    # as long as ten steps of the search along a radius.
    window: ProcessWindow = setting(ProcessWindow(yield_draws=40), "Process window")
    view: LensView = setting(LensView(path="radial"), "View")
    imaging: ImagingSettings = setting(ImagingSettings(), "Computational imaging")


def lens_settings(
    task: LensTaskName = "direct", variant: Variant = "default", changes: Mapping[str, Any] | None = None
) -> LensSettings:
    """Return a preset for a lens, changed by ``changes``, such as ``{"layout.size_px": 600}``.

    All presets have layouts of rings, a width of 120 µm and a focal length of 400 µm.

    ``paper`` has 13 levels, Gumbel-Softmax at temperature 0.5, 1000 AdamW iterations at a learning rate of 3,
    and a square aperture. The paper does not mention that the layout consists of rings; this comes from the
    published code. The display of the paper is 36 mm wide at a distance of 140 mm, so its image on the sensor
    is 102.9 µm wide, which is 103 pixels of 1 µm. The PSF window has the same width. We chose pixels of 1 µm,
    because they sample the cut-off frequency at NA 0.15 (a period of 2.1 µm) without aliasing.

    ``authors`` has the settings of the published code: 12 levels, rings as wide as the diagonal of a pixel,
    temperature 1 and smooth L1. The 2000 iterations begin with a learning rate of 1, which is halved every 25
    iterations. The images have read noise and photon noise. The wavelength and the index step are also taken
    from the code. The objects are as wide as the lens. docs/from_the_authors_code.md lists the parts of that
    code that are not reproduced.

    ``default`` has a circular aperture, starts from the phase of a Fresnel lens, and searches along a radius.

    Args:
        task: ``direct`` for a lens that focuses light, or ``computational`` for a lens that images objects
            and whose images are deconvolved. A ``task`` among the changes overrides this argument.
        variant, changes: as for ``hologram_settings``.

    Raises:
        InputError: a change names an unknown setting, or gives a setting a value that it does not accept.
    """
    return preset(_preset, variant, {"task": task, **(changes or {})})


def _preset(variant: Variant) -> LensSettings:
    default = LensSettings()
    if variant == "default":
        return default
    search = PAPER_SEARCH.model_copy(update={"optimiser": "adamw", "learning_rate": 3.0})
    square = LensView(aperture="square", path="plane", window_px=1030)
    if variant == "paper":
        return LensSettings(variant="paper", search=search, view=square, imaging=PAPER_IMAGING)
    published = {"iterations": 2000, "learning_rate": 1.0, "temperature_start": 1.0, "temperature_end": 1.0}
    halving = {"rate_schedule": "step", "rate_factor": 0.5, "rate_iterations": 25}
    ring_um = math.sqrt(2) * default.layout.pitch_um
    return LensSettings(
        variant="authors",
        layout=default.layout.model_copy(update={"levels": 12, "cell_um": ring_um}),
        optics=Optics(wavelength_um=0.633, index_step=0.545, distance_um=400.0),
        search=search.model_copy(update=published | halving),
        view=square.model_copy(update={"window_px": 1200}),
        imaging=PAPER_IMAGING.model_copy(
            update={"object_px": 160, "read_noise": 0.02, "photon_noise": 0.004, "loss": "smooth-l1"}
        ),
    )
