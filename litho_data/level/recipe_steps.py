"""The steps that a recipe can hold: one frozen model per operation, with its defaults."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from litho_data.foundation.errors import InputError
from litho_data.foundation.kinds import YX, Array
from litho_data.level.facet import level_facet
from litho_data.level.features import Side, mark_features, mask_and_relevel
from litho_data.level.layout_aware import level_layout_aware
from litho_data.level.plane import fix_zero, level_plane, level_rotate, level_three_point, zero_max, zero_mean
from litho_data.level.polynomial import MAX_DEGREE, level_polynomial
from litho_data.level.robust import Loss, level_robust
from litho_data.level.row_statistics import MEDIAN_TRIM
from litho_data.level.rows import MAX_ROW_DEGREE, Direction, RowMethod, align_rows, print_taken_for_offsets
from litho_data.level.scars import ScarSign, mark_scars, remove_scars
from litho_data.level.selection import Masking


class LevellingWarning(UserWarning):
    """A step may have removed part of the print."""


@dataclass(frozen=True, eq=False)
class State:
    """What passes from step to step: heights (µm), the current mask, pitch and layout."""

    height_um: Array
    mask: Array | None
    pitch_um: YX | None
    layout_level: Array | None

    def need(self, name: str) -> Any:
        """The pitch or the layout; raises InputError where it is unknown."""
        if (value := getattr(self, name)) is None:
            wanted = "the pixel pitch" if name == "pitch_um" else "the layout in the scan's frame"
            raise InputError(f"{wanted} is unknown", wanted=name)
        return value


class Step(BaseModel):
    """Base of all steps: its fields are the arguments of ``function``.

    ``masking`` says how the current mask is used: the mask of the scan at first, then that of the
    latest step that marks something.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    function: ClassVar[Callable[..., Any]]
    needs: ClassVar[tuple[str, ...]] = ()

    op: str
    masking: Masking = "exclude"

    def run(self, state: State) -> State:
        """The state with the levelled map."""
        return replace(state, height_um=self.call(state).height)

    def call(self, state: State) -> Any:
        """What ``function`` returns for the state."""
        arguments = {name: getattr(self, name) for name in type(self).model_fields if name != "op"}
        arguments |= {name: state.need(name) for name in self.needs}
        return type(self).function(state.height_um, mask=state.mask, **arguments)


Degree = Annotated[int, Field(ge=0, le=MAX_DEGREE)]
Point = tuple[float, float]


class FixZero(Step):
    """Lowest selected pixel to zero."""

    op: Literal["fix-zero"] = "fix-zero"
    function = staticmethod(fix_zero)


class ZeroMean(Step):
    """Mean of the selected pixels to zero."""

    op: Literal["zero-mean"] = "zero-mean"
    function = staticmethod(zero_mean)


class ZeroMax(Step):
    """Highest selected pixel to zero."""

    op: Literal["zero-max"] = "zero-max"
    function = staticmethod(zero_max)


class Plane(Step):
    """Least-squares plane, height at the pivot kept."""

    op: Literal["plane"] = "plane"
    function = staticmethod(level_plane)


class ThreePoint(Step):
    """Plane through three disc means."""

    op: Literal["three-point"] = "three-point"
    function = staticmethod(level_three_point)
    points_px: tuple[Point, Point, Point]
    radius_px: float = Field(default=0.0, ge=0)
    set_zero: bool = False


class Facet(Step):
    """Prevailing facet made horizontal."""

    op: Literal["facet"] = "facet"
    function = staticmethod(level_facet)
    needs = ("pitch_um",)


class Rotate(Step):
    """Rotation by the angles of the plane."""

    op: Literal["rotate"] = "rotate"
    function = staticmethod(level_rotate)
    needs = ("pitch_um",)


class Polynomial(Step):
    """Polynomial background with its constant."""

    op: Literal["polynomial"] = "polynomial"
    function = staticmethod(level_polynomial)
    x_degree: Degree = 3
    y_degree: Degree = 3
    total_degree: Degree | None = None


class _PlaneByDefault(Step):
    x_degree: Degree = 1
    y_degree: Degree = 1
    total_degree: Degree | None = 1


class Robust(_PlaneByDefault):
    """Polynomial that follows the majority of the pixels."""

    op: Literal["robust"] = "robust"
    function = staticmethod(level_robust)
    loss: Loss = "tukey"


class LayoutAware(_PlaneByDefault):
    """Background fitted together with the response to the layout."""

    op: Literal["layout-aware"] = "layout-aware"
    function = staticmethod(level_layout_aware)
    needs = ("layout_level",)
    blur_px: float | None = Field(default=None, ge=0)


class AlignRows(Step):
    """What a line does not share with the others."""

    op: Literal["align-rows"] = "align-rows"
    function = staticmethod(align_rows)
    method: RowMethod = "median"
    direction: Direction = "horizontal"
    degree: Annotated[int, Field(ge=0, le=MAX_ROW_DEGREE)] = 1
    trim: float = Field(default=0.05, ge=0, le=MEDIAN_TRIM)

    def call(self, state: State) -> Any:
        """Pass the pitch to the one method that needs it; warn where the print moves with the lines."""
        pitch_um = state.need("pitch_um") if self.method == "facet-tilt" else None
        levelled = align_rows(
            state.height_um,
            method=self.method,
            direction=self.direction,
            degree=self.degree,
            trim=self.trim,
            pitch_um=pitch_um,
            mask=state.mask,
            masking=self.masking,
        )
        pair = (state.height_um, levelled.removed)
        if note := print_taken_for_offsets(*(one.T if self.direction == "vertical" else one for one in pair)):
            warnings.warn(note, LevellingWarning, stacklevel=2)
        return levelled


class _Features(Step):
    threshold: float = Field(default=3.0, gt=0)
    side: Side = "both"


class MarkFeatures(_Features):
    """Pixels off the main surface become the mask."""

    op: Literal["mark-features"] = "mark-features"
    function = staticmethod(mark_features)
    grow_px: int = Field(default=0, ge=0)

    def run(self, state: State) -> State:
        """The state with the features as its mask."""
        return replace(state, mask=self.call(state))


class MaskAndRelevel(_Features, _PlaneByDefault):
    """Background and features in turn; the features become the mask."""

    op: Literal["mask-and-relevel"] = "mask-and-relevel"
    function = staticmethod(mask_and_relevel)
    grow_px: int = Field(default=2, ge=0)

    def run(self, state: State) -> State:
        """The state with the levelled map, and the features as its mask."""
        levelled, mask = self.call(state)
        return replace(state, height_um=levelled.height, mask=mask)


class _Scars(Step):
    function = staticmethod(mark_scars)
    high: float = Field(default=0.666, gt=0)
    low: float = Field(default=0.25, gt=0)
    min_length_px: int = Field(default=16, ge=1)
    max_width_px: int = Field(default=4, ge=1)
    sign: ScarSign = "both"


class MarkScars(_Scars):
    """Strokes along the rows become the mask."""

    op: Literal["mark-scars"] = "mark-scars"

    def run(self, state: State) -> State:
        """The state with the scars as its mask."""
        return replace(state, mask=self.call(state))


class RemoveScars(_Scars):
    """Strokes along the rows are filled; the mask stays."""

    op: Literal["remove-scars"] = "remove-scars"

    def run(self, state: State) -> State:
        """The state with the scars filled; the mask stays."""
        return replace(state, height_um=remove_scars(state.height_um, scars=self.call(state)).height)


AnyStep = Annotated[
    FixZero
    | ZeroMean
    | ZeroMax
    | Plane
    | ThreePoint
    | Facet
    | Rotate
    | Polynomial
    | Robust
    | LayoutAware
    | AlignRows
    | MarkFeatures
    | MaskAndRelevel
    | MarkScars
    | RemoveScars,
    Field(discriminator="op"),
]
