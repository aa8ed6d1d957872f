"""The objects that a lens images: built-in drawings, or pictures that the user provides."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
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
# Key of the array of pictures in the inputs of a lens task. The array has shape (pictures, size, size). It
# contains first the pictures used in the search, and then the held-out pictures, which are used only for
# scores.
PICTURES = "object_pictures"


def object_stack(
    objects: Sequence[ImagedObject], size_px: int, pictures: Iterable[np.ndarray] = ()
) -> Tensor:
    """Return n objects with values in [0, 1], shape (n, size, size). Each object has a dark border on every
    side, whose width is one eighth of the side of the frame.

    Args:
        objects: names of drawings, and records of pictures.
        size_px: side of the frame, in sensor pixels.
        pictures: pixels of those objects that are pictures, in the order of ``objects``. Each is a float32
            array of shape (size, size) with values in [0, 1].

    Raises:
        InputError: the pixels of a picture are missing or do not have the shape (size, size).
    """
    border, brought, frames = size_px // _BORDER_SHARE, iter(pictures), []
    for item in objects:
        if isinstance(item, str):
            frame: np.ndarray | None = np.pad(draw_target(item, size_px - 2 * border), border)
        else:
            frame = next(brought, None)
        if frame is None or frame.shape != (size_px, size_px):
            got = "no pixels" if frame is None else f"pixels of shape {frame.shape}"
            wanted = f"its picture of {size_px} x {size_px} px"
            raise InputError(f"object {object_name(item)}", got=got, wanted=wanted)
        frames.append(torch.from_numpy(frame))
    return torch.stack(frames)


def with_objects(
    settings: LensSettings, objects: Sequence[str | Path], held_out: Sequence[str | Path]
) -> tuple[LensSettings, dict[str, np.ndarray]]:
    """Return the settings of a computational lens that images the given pictures, and the pixels of these
    pictures.

    Each path names a picture, or a folder that contains only pictures and hidden files. If ``held_out`` is
    empty, the pictures are sorted by name. The last quarter of them (at least two pictures) is then held out,
    i.e. used only for scores and not in the search. If ``objects`` is empty, the search uses the built-in
    drawings.

    Returns:
        The settings and the inputs of the task. The settings contain the name, the SHA-256 and the
        conversions of each picture, and the inputs contain the pixels of all pictures. If no paths are given,
        the settings are unchanged and the inputs are empty.

    Raises:
        InputError: the task does not image objects, a file is not a picture, a picture has no light or is
            given twice, or there are too few pictures.
    """
    if not objects and not held_out:
        return settings, {}
    if settings.task != "computational":
        raise InputError(
            "objects",
            got=f"the {settings.task} task, which does not image objects",
            wanted="the computational task",
            hint="otherwise, leave out --objects and --held-out-objects",
        )
    kept, tested = (
        [read_object(file, settings.imaging.object_px) for place in paths for file in _files(Path(place))]
        for paths in (objects, held_out)
    )
    if objects and not held_out:
        kept.sort(key=lambda one: (one[1].name, one[1].sha256))
        count = max(_FEWEST_HELD_OUT, len(kept) // _HELD_OUT_SHARE)
        kept, tested = kept[:-count], kept[-count:]
    for (pixels, record), (others, _) in itertools.combinations([*kept, *tested], 2):
        if np.array_equal(pixels, others):
            got = f"{record.name}, a picture given twice"
            raise InputError("objects", got=got, wanted="each picture once")
    if len(tested) < _FEWEST_HELD_OUT or (objects and not kept):
        raise InputError(
            "objects",
            got=f"{len(kept)} for the design and {len(tested)} held out",
            wanted=f"at least one for the design and {_FEWEST_HELD_OUT} held out",
            hint="give more pictures with --objects or --held-out-objects",
        )
    update = {"test_objects": tuple(record for _, record in tested)}
    update |= {"objects": tuple(record for _, record in kept)} if kept else {}
    made = settings.model_copy(update={"imaging": settings.imaging.model_copy(update=update)})
    return made, {PICTURES: np.stack([pixels for pixels, _ in (*kept, *tested)])}


def pictures_note(objects: Sequence[ImagedObject], held_out: Sequence[ImagedObject]) -> list[str]:
    """If some objects are pictures, return a list with one sentence that names all objects; otherwise, return
    an empty list.
    """
    if all(isinstance(item, str) for item in (*objects, *held_out)):
        return []
    kept, tested = (", ".join(map(object_name, part)) for part in (objects, held_out))
    return [
        f"the objects of the design are {kept}; the held-out objects are {tested}; the record lists how "
        "pictures were converted"
    ]


def read_object(path: Path, size_px: int) -> tuple[np.ndarray, TargetRecord]:
    """Read one picture as an object of ``size_px`` sensor pixels, including its dark border.

    Returns:
        The pixels as a float32 array of shape (size, size) with values in [0, 1], and the record of the
        picture.

    Raises:
        InputError: the file is not a picture, or the picture has no light.
    """
    border = size_px // _BORDER_SHARE
    inner, notes = read_image(path, size_px - 2 * border, "object")
    notes += ["divided by its brightest value", f"dark border of {border} px"]
    return np.pad(inner, border), TargetRecord.of_file(path, notes)


def _files(place: Path) -> list[Path]:
    if not place.is_dir():
        return [place]
    found = sorted(file for file in place.iterdir() if file.is_file() and not file.name.startswith("."))
    if not found:
        raise InputError("objects", got=f"{place}, an empty folder", wanted="a folder of pictures")
    return found
