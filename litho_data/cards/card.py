"""The dataset card: a TOML file that says what the raw files are and what they mean."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, Field, ValidationError, model_validator

from litho_data.foundation import InputError, parsed, um_per, unknown_name
from litho_data.foundation.names import PlainName
from litho_data.foundation.quantities import LENGTH_UM, Levels
from litho_data.foundation.results import Record, first_error
from litho_data.readers.registry import formats
from litho_data.store.schema import Instrument, Surround

# Number of characters at which messages cut off a value.
_LONGEST = 80
Use = Literal["dataset", "flat", "substrate", "steps", "grating"]
Registration = Literal["affine", "homography", "ladder"]


def load_card(path: str | Path) -> Card:
    """Read and check a dataset card.

    Raises:
        InputError: the file does not exist or is not TOML, or a key is unknown, missing or has an impossible
            value. The message names the key, the value and what was expected.
    """
    file = Path(path)
    content = parsed(file, tomllib.loads, f"cannot read {file} as a dataset card", "a TOML file")
    return check_card(content, f"card {file}")


def check_card(content: dict[str, Any], what: str) -> Card:
    """Check the content of a card, given as a dict, and return the card. Error messages refer to the card as
    ``what``.
    """
    try:
        return Card.model_validate(content)
    except ValidationError as error:
        raise _readable(error, what) from error


def with_tip(card: Card, tip: float | str) -> Card:
    """Return a copy of the card in which ``process.tip`` has the given value.

    Raises:
        InputError: the tip is neither a positive number nor ``blind``, or the card describes micrographs,
            which are taken without a tip.
    """
    if card.scan.instrument == "sem":
        raise InputError("tip", got="micrographs", wanted="scans of an atomic force microscope")
    try:
        value = tip if tip == "blind" else float(tip)
        process = Process.model_validate({**card.process.model_dump(), "tip": value})
    except ValueError as error:  # pydantic's error is a ValueError
        raise InputError("tip", got=repr(tip), wanted="a radius in µm, or blind") from error
    return card.model_copy(update={"process": process})


def _positive(value: float) -> float:
    if not LENGTH_UM.holds(value):
        raise ValueError(f"wanted a number from {LENGTH_UM}")
    return value


def _known_unit(value: str) -> str:
    um_per(value)
    return value


def _known_format(value: str) -> str:
    if value not in ("auto", *formats()):
        raise ValueError(f"wanted one of auto, {', '.join(formats())}")
    return value


def _file_pattern(value: str) -> str:
    if "{id}" not in value:
        raise ValueError("wanted a pattern with {id}, for example 'scans/{id}.txt' or 'scans/{id}.*'")
    return _inside(value)


def _file_patterns(value: str | tuple[str, ...]) -> str | tuple[str, ...]:
    if not value:
        raise ValueError("wanted at least one pattern")
    return _file_pattern(value) if isinstance(value, str) else tuple(_file_pattern(one) for one in value)


def _inside(value: str) -> str:
    """Check that a path is relative and does not lead out of the data folder. Both slashes and backslashes
    are accepted as separators.
    """
    parts = PurePosixPath(value.replace("\\", "/")).parts
    leaves = not parts or ".." in parts or parts[0] == "/" or re.match("[A-Za-z]:", value)
    if leaves or not value.isprintable():
        raise ValueError("wanted a path inside the data folder, in printable characters")
    return value


def _id_pattern(value: str) -> str:
    try:
        groups = re.compile(value).groupindex
    except re.error as error:
        raise ValueError(f"wanted a regular expression ({error})") from error
    if "print" not in groups:
        raise ValueError("wanted a regular expression with a group named print: (?P<print>…)")
    return value


Length = Annotated[float, Field(strict=True), AfterValidator(_positive)]
Uncertainty = Annotated[float, Field(strict=True, ge=0, le=LENGTH_UM.high, allow_inf_nan=False)]
FilePatterns = Annotated[str | tuple[str, ...], AfterValidator(_file_patterns)]
KnownFormat = Annotated[str, AfterValidator(_known_format)]
KnownUnit = Annotated[str, AfterValidator(_known_unit)]
InsidePath = Annotated[str, AfterValidator(_inside)]
MissingMarks = tuple[Annotated[float, Field(strict=True)] | str, ...]


class LayoutFiles(Record):
    """The ``[layout]`` table: the layout files, and what their values mean.

    If the layouts are saved as pictures, ``grey_per_level`` is the difference in grey value between
    neighbouring levels, such as 255 / (levels - 1) if white is the highest level. If ``average_px`` is set,
    the files are black-and-white pictures. Each square of ``average_px`` x ``average_px`` pixels becomes one
    pixel of the layout. The level of this pixel is the number of white pixels in the square.
    """

    files: FilePatterns
    pitch_um: Length
    level_height_um: Length
    levels: Levels
    grey_per_level: Length | None = None
    average_px: int | None = Field(default=None, ge=2, le=15)

    @model_validator(mode="after")
    def _counted(self) -> Self:
        if self.average_px is not None and self.levels != self.average_px**2 + 1:
            raise ValueError(
                f"wanted levels = {self.average_px**2 + 1}, one for each possible number of white pixels "
                "in a square"
            )
        return self


class ScanFiles(Record):
    """The ``[scan]`` table: the scan files, and how to read them. ``size_um`` is the size of the field along
    y and x, for file formats that do not state it.

    ``instrument`` is the kind of instrument. A ``confocal`` microscope has no tip. The files of a scanning
    electron microscope (``sem``) are pictures of a film. The film has the full height of the layout
    everywhere, and the build measures where its edges lie.

    If ``levelled`` is true, the build uses the heights in the files without levelling them. ``missing`` lists
    the numbers and words that stand for unmeasured pixels in the files; an empty list says that no value has
    this meaning.
    """

    files: FilePatterns
    format: KnownFormat = "auto"
    unit: KnownUnit | None = None
    size_um: tuple[Length, Length] | None = None
    channel: str | None = None
    fast_axis: Literal["x", "y"] | None = None
    full_scale_file: InsidePath | None = None
    levelled: bool = False
    missing: MissingMarks | None = None
    instrument: Instrument = "afm"

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if self.full_scale_file is not None and self.unit is not None:
            raise ValueError("wanted either unit or full_scale_file (in metres), not both")
        given = (self.unit, self.full_scale_file, self.channel, self.missing)
        if self.instrument == "sem" and (self.size_um is None or any(one is not None for one in given)):
            raise ValueError("wanted size_um and no height settings, because a micrograph has no heights")
        return self


class Process(Record):
    """The ``[process]`` table: how raw scans are processed. It states the registration model, the radius of
    the tip, and the name of a file with a levelling recipe.

    Without ``level``, a plane is subtracted from each scan, unless the card says that the scans are levelled.
    The plane is fitted together with the layout, so that the slope of the print is kept. ``tip`` is the
    radius of the microscope's tip in µm, or ``blind`` to estimate it from the scans.
    """

    level: InsidePath | None = None
    registration: Registration = "affine"
    tip: Literal["blind"] | Length | None = None


class Ids(Record):
    """The ``[ids]`` table: what the ids of the scans mean. ``print`` is a regular expression that matches a
    whole id. Its group ``print`` captures the name of the print to which the scan belongs. ``table`` is a CSV
    file with further facts about each scan.
    """

    print: Annotated[str, AfterValidator(_id_pattern)] | None = None
    table: InsidePath | None = None


class Standard(Record):
    """A scan of a calibration standard, whose size is known. Reading options that are not given here are
    taken from the card's ``[scan]`` table. As for scans, a unit or size from the ``[scan]`` table is used
    only if the file states none.
    """

    file: InsidePath
    uncertainty_um: Uncertainty
    format: KnownFormat | None = None
    unit: KnownUnit | None = None
    size_um: tuple[Length, Length] | None = None
    channel: str | None = None
    missing: MissingMarks | None = None


class Grating(Standard):
    """A grating that calibrates the lateral scale of one axis. A square grating (periodic along both axes)
    can calibrate both.
    """

    period_um: Length


class Step(Standard):
    """A step, ridge or groove of known height, which calibrates the scale of heights. Its edges are
    perpendicular to ``axis``.
    """

    height_um: Length
    axis: Literal["x", "y"] = "x"


class Calibration(Record):
    """The ``[calibration]`` table: the calibration standards from which the scales of the microscope are
    measured. They are gratings for x and y, and a step for z.
    """

    x: Grating | None = None
    y: Grating | None = None
    z: Step | None = None

    @model_validator(mode="after")
    def _any(self) -> Self:
        if self.x is None and self.y is None and self.z is None:
            raise ValueError("wanted at least one of x, y, z")
        return self


class Write(Record):
    """The ``[write]`` table: how the printer wrote a field. If a fact is missing here, a default is assumed.

    ``surround`` says what lies around a printed field: the bare substrate, or more of the same print.
    """

    slow_axis: Literal["x", "y"] | None = None
    field_um: Length | None = None
    surround: Surround | None = None


class KnownGrating(Record):
    """The certified period of the grating in the reference scans whose use is ``grating``. The grating has
    this period along both axes.
    """

    period_um: Length
    uncertainty_um: Uncertainty = 0.0


class Planned(Record):
    """The ``[plan]`` table of prints that were planned with models. It contains the hash of the dataset from
    which the prints were planned.
    """

    dataset_sha256: str = Field(pattern=r"^[0-9a-f]{64}$")


class Source(Record):
    """Where to download the files: a base URL, and a file beside the card that lists the SHA-256 sum of each
    file.
    """

    url: str = Field(pattern=r"^https?://")
    registry: InsidePath


class Card(Record):
    """A dataset card whose content has been checked."""

    name: PlainName = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")
    title: str = ""
    license: str = ""
    citation: str = ""
    layout: LayoutFiles
    scan: ScanFiles
    process: Process = Process()
    ids: Ids = Ids()
    write: Write | None = None
    plan: Planned | None = None
    calibration: Calibration | None = None
    grating: KnownGrating | None = None
    source: Source | None = None

    @model_validator(mode="after")
    def _of_one_instrument(self) -> Self:
        heights = (self.process.level, self.process.tip, self.calibration, self.grating)
        if self.scan.instrument == "sem" and any(one is not None for one in heights):
            raise ValueError(
                "wanted no levelling, tip, calibration or grating, because they do not apply to micrographs"
            )
        if self.scan.instrument == "confocal" and self.process.tip is not None:
            raise ValueError("wanted no tip, because a confocal microscope has none")
        return self


def _readable(error: ValidationError, what: str) -> InputError:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return unknown_name(f"{what}: key", key, _model_at(first["loc"][:-1]).model_fields)
    if first["type"] == "missing":
        return InputError(f"{what}: key {key}", got="nothing", wanted="a value")
    if first["type"] == "value_error":
        # The message was raised by a validator of this module. If it concerns a whole table, it already names
        # the key.
        cause = first["ctx"]["error"]
        shown = "" if isinstance(first["input"], dict) else f" = {_shown(first['input'])}"
        return InputError(f"{what}: {key}{shown}: {cause}")
    if first["type"] == "tuple_type":
        given = first["input"]
        numbers = f"[{given}, {given}]" if isinstance(given, int | float) else "[54.0, 54.0]"
        return InputError(
            f"{what}: {key} = {_shown(given)}",
            got="one value",
            wanted=f"two values, y and x, such as {numbers}",
        )
    return InputError(f"{what}: {first_error(error)}")


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _model_at(location: tuple[int | str, ...]) -> type[BaseModel]:
    """Return the pydantic model that contains the key at the location of a validation error."""
    model: type[BaseModel] = Card
    for part in location:
        annotation = model.model_fields[str(part)].annotation
        candidates = [annotation, *getattr(annotation, "__args__", ())]
        model = next(c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel))
    return model
