"""Objects that a lens images: drawings, or pictures of your own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from litho_data.foundation.errors import InputError
from litho_design.images.targets import ImagedObject, TargetRecord, draw_target, object_name, read_image
from litho_design.lenses.settings import LensSettings

_BORDER_SHARE = 8
_HELD_OUT_SHARE = 4
_FEWEST_HELD_OUT = 2
# Name among the inputs of a lens: (pictures, size, size), the design's pictures first.
_PICTURES = "object_pictures"


def object_stack(
    objects: Sequence[ImagedObject], size_px: int, pictures: Mapping[str, np.ndarray] | None = None
) -> Tensor:
    """Objects (n, size, size) in [0, 1] with a dark border of one eighth.

    Args:
        objects: names of drawings, and records of pictures.
        size_px: side of the frame, sensor pixels.
        pictures: float32 (size, size) in [0, 1] of each picture by the SHA-256 of its file.

    Raises:
        InputError: a picture whose pixels are not among ``pictures``, or have another size.
    """
    return torch.stack([torch.from_numpy(_frame(item, size_px, pictures or {})) for item in objects])


def with_objects(
    settings: LensSettings, objects: Sequence[str | Path], held_out: Sequence[str | Path]
) -> tuple[LensSettings, dict[str, np.ndarray]]:
    """``settings`` of a computational lens with your own pictures as objects.

    A path is a picture, or a folder whose files, except hidden ones, are all pictures.
    Without ``held_out``, the last quarter of the pictures in the order of their names, at least two, are held
    out of the design and only scored. Without ``objects``, the design uses the drawings.

    Returns:
        The settings, with name, SHA-256 and conversion of each picture, and the pixels as inputs of the task;
        without paths, unchanged settings and no inputs.

    Raises:
        InputError: a task that images no objects, a file that is not a picture, a picture without light or
            given twice, or too few pictures.
    """
    if not objects and not held_out:
        return settings, {}
    if settings.task != "computational":
        raise InputError(
            "objects",
            got=f"the {settings.task} task, which images no objects",
            wanted="the computational task",
            hint="or leave out --objects and --held-out-objects",
        )
    imaging = settings.imaging
    pictures: dict[str, np.ndarray] = {}
    kept, tested = (_read_all(paths, imaging.object_px, pictures) for paths in (objects, held_out))
    if objects and not held_out:
        kept.sort(key=lambda item: (item.name, item.sha256))
        count = max(_FEWEST_HELD_OUT, len(kept) // _HELD_OUT_SHARE)
        kept, tested = kept[:-count], kept[-count:]
    if len(tested) < _FEWEST_HELD_OUT or (objects and not kept):
        raise InputError(
            "objects",
            got=f"{len(kept)} for the design and {len(tested)} held out",
            wanted=f"at least one for the design and {_FEWEST_HELD_OUT} held out",
            hint="give more pictures with --objects or --held-out-objects",
        )
    update = {"test_objects": tuple(tested)} | ({"objects": tuple(kept)} if kept else {})
    made = settings.model_copy(update={"imaging": imaging.model_copy(update=update)})
    used = picture_records((*made.imaging.objects, *made.imaging.test_objects))
    return made, {_PICTURES: np.stack([pictures[one.sha256] for one in used])}


def pictures_of(objects: Sequence[ImagedObject], inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Pixels of the pictures among the objects of design and test, by the SHA-256 of their files."""
    return {
        one.sha256: pixels
        for one, pixels in zip(picture_records(objects), inputs.get(_PICTURES, ()), strict=False)
    }


def picture_records(objects: Sequence[ImagedObject]) -> list[TargetRecord]:
    """The pictures among ``objects``."""
    return [item for item in objects if isinstance(item, TargetRecord)]


def pictures_note(objects: Sequence[ImagedObject], held_out: Sequence[ImagedObject]) -> list[str]:
    """One sentence that names the objects if some are pictures; otherwise empty."""
    if not picture_records((*objects, *held_out)):
        return []
    kept, tested = (", ".join(map(object_name, part)) for part in (objects, held_out))
    return [f"objects of the design: {kept}; held out: {tested}; their conversions are in the record"]


def read_object(path: Path, size_px: int) -> tuple[np.ndarray, TargetRecord]:
    """One picture as an object of ``size_px`` sensor pixels, its dark border included.

    Returns:
        float32 (size, size) in [0, 1], and its record.

    Raises:
        InputError: not a picture, or one without light.
    """
    border = size_px // _BORDER_SHARE
    inner, notes = read_image(path, size_px - 2 * border, "object")
    notes += ["divided by its brightest value", f"dark border of {border} px"]
    return np.pad(inner, border), TargetRecord.of_file(path, notes)


def _frame(item: ImagedObject, size_px: int, pictures: Mapping[str, np.ndarray]) -> np.ndarray:
    if isinstance(item, str):
        border = size_px // _BORDER_SHARE
        return np.pad(draw_target(item, size_px - 2 * border), border)
    pixels = pictures.get(item.sha256)
    if pixels is None or pixels.shape != (size_px, size_px):
        got = "no pixels" if pixels is None else f"pixels of shape {pixels.shape}"
        raise InputError(f"object {item.name}", got=got, wanted=f"its picture of {size_px} x {size_px} px")
    return pixels


def _read_all(
    paths: Sequence[str | Path], size_px: int, pictures: dict[str, np.ndarray]
) -> list[TargetRecord]:
    """Records of all pictures under ``paths``; their pixels are added to ``pictures``."""
    records = []
    for path in (file for place in paths for file in _files(Path(place))):
        pixels, record = read_object(path, size_px)
        if any(np.array_equal(pixels, other) for other in pictures.values()):
            raise InputError(
                "objects", got=f"{path}, a picture that was given already", wanted="each picture once"
            )
        pictures[record.sha256] = pixels
        records.append(record)
    return records


def _files(place: Path) -> list[Path]:
    if not place.is_dir():
        return [place]
    found = sorted(file for file in place.iterdir() if file.is_file() and not file.name.startswith("."))
    if not found:
        raise InputError("objects", got=f"{place}, an empty folder", wanted="a folder of pictures")
    return found
