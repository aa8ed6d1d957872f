"""Levelling recipes: lists of levelling steps, written in TOML or Python and stored with the levelled
data.
"""

import tomllib
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self, Union

from pydantic import BaseModel, ConfigDict, Field, ValidationError

import litho_data.level.features
import litho_data.level.layout_aware

# These modules are imported because each registers its operations when it is imported.
import litho_data.level.plane
import litho_data.level.polynomial
import litho_data.level.scars  # noqa: F401
from litho_data.foundation import YX, Array, InputError, about, parsed
from litho_data.foundation.results import first_error
from litho_data.level.operation import STEPS, State, Step
from litho_data.level.rows import LevellingWarning
from litho_data.level.selection import Levelled, as_height
from litho_data.scan import Scan

if TYPE_CHECKING:
    AnyStep = Step
else:
    AnyStep = Annotated[Union[tuple(STEPS.values())], Field(discriminator="op")]  # noqa: UP007


class Recipe(BaseModel):
    """Levelling steps in the order in which they are applied; an unknown key is an error.

    In TOML, each step is a table ``[[step]]`` whose key ``op`` names the operation. In Python, each step is
    an instance of one of ``STEPS``.
    """

    SCHEMA: ClassVar[str] = "litho-data/recipe/1"

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = ""
    step: tuple[AnyStep, ...] = ()

    @classmethod
    def from_toml(cls, path: str | Path) -> Self:
        """Read a recipe from a TOML file.

        Raises:
            InputError: the file does not exist, is not TOML, contains no step, has an unknown operation or
                key, or has a value out of range.
        """
        content = parsed(Path(path), tomllib.loads, f"cannot read recipe {path}", "a TOML file")
        recipe = cls.from_dict(content, source=str(path))
        if not recipe.step:
            raise InputError(f"recipe {path}", got="no step", wanted="at least one [[step]]")
        return recipe

    @classmethod
    def from_dict(cls, content: dict[str, Any], *, source: str = "") -> Self:
        """Make a recipe from plain data, as read from TOML or returned by ``canonical()``. Raise InputError
        if the data are invalid.
        """
        tables = dict(content)
        if tables.pop("schema", cls.SCHEMA) != cls.SCHEMA:
            raise InputError(f"recipe {source}: schema", got=repr(content["schema"]), wanted=repr(cls.SCHEMA))
        try:
            return cls.model_validate(tables)
        except ValidationError as error:
            raise InputError(f"recipe {source}".rstrip(), got=first_error(error)) from error

    def canonical(self) -> dict[str, Any]:
        """Return the recipe as plain data that ``from_dict`` accepts. The data contain every setting that
        affects the result, including the defaults.
        """
        return {"schema": self.SCHEMA, "step": [step.model_dump(mode="json") for step in self.step]}

    def apply(
        self,
        scan: Scan | Array,
        *,
        pitch_um: YX | None = None,
        mask: Array | None = None,
        layout_level: Array | None = None,
    ) -> Levelled:
        """Level a scan. In the result, ``height + removed`` is the input. Both ``height`` and ``removed`` are
        NaN where nothing was measured.

        Args:
            scan: a ``Scan``, whose pitch and mask are used, or an array of heights in µm, shape (ny, nx).
            pitch_um: pixel pitch along y and x, used only if ``scan`` is an array of heights.
            mask: bool array of shape (ny, nx) that replaces the scan's mask.
            layout_level: level of the layout under each pixel of the scan, shape (ny, nx), NaN outside the
                layout. Only ``layout-aware`` steps need it.

        Raises:
            InputError: a step needs a pitch or a layout that is not given, or a step cannot be applied to the
                data.
        """
        if isinstance(scan, Scan):
            heights, mask, pitch_um = scan.height_um, scan.mask if mask is None else mask, scan.pitch_um
        else:
            heights = scan
        state = State(as_height(heights), mask, pitch_um, layout_level)
        start = state.height_um
        for number, step in enumerate(self.step, start=1):
            with about(f"recipe step {number} ({step.op})"):
                state = step.run(state)
        return Levelled(state.height_um, start - state.height_um)

    def apply_noting(self, scan: Scan | Array, **arguments: Any) -> tuple[Levelled, list[str]]:
        """Level a scan as ``apply`` does. Return the result, and the texts of the warnings that the steps
        issued.
        """
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", LevellingWarning)
            levelled = self.apply(scan, **arguments)
        return levelled, [str(one.message) for one in said if issubclass(one.category, LevellingWarning)]
