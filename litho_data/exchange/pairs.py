"""Import and export pairs of an 8-bit layout file and an 8-bit height file. The paper's authors published
their data in this format. ``litho_data.readers.pairs`` describes the limits of this format.

``mask/<id><q>.tif`` contains level numbers, ``afm/<id><q>.tif`` contains heights, and ``src_max_dict.txt``
contains the full scale of each height file (the height of grey value 255) in metres. The digit q names a
quadrant of the field: 1 (top left), 2 (top right), 3 (bottom left) or 4 (bottom right).

This project adds ``valid/<id><q>.tif``, which is black where no height was measured. The authors' files have
no such masks.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from litho_data.cards.card import Card, check_card
from litho_data.cards.listing import prints_of
from litho_data.cards.tables import SAFE_ID, SAFE_ID_RULE, read_full_scales
from litho_data.commands.progress import progress
from litho_data.foundation import Array, InputError, file_sha256, record_sha256
from litho_data.foundation.begun import whole_folder
from litho_data.making.assemble import Source
from litho_data.making.build import make_store
from litho_data.making.chain import Chain
from litho_data.making.operations import OPERATIONS
from litho_data.making.result import BuildResult
from litho_data.readers.pairs import GREY_MAX, quadrant_slices
from litho_data.sharing.workers import Workers
from litho_data.store.partial import Piece
from litho_data.store.read import open_store

_QUADRANTS = (1, 2, 3, 4)
_MASKS = "valid"
SCALES_FILE = "src_max_dict.txt"
_AUTHORS_IDS = r"FOV(?P<print>\d)(?P<field>\d)\d?"
_FRAME = f"all heights along a side are exactly 0: were they measured? {_MASKS}/ marks pixels that were not"


def import_pairs(
    folder: str | Path,
    out: str | Path,
    *,
    pitch_um: float = 0.1,
    level_height_um: float = 0.1,
    levels: int = 13,
    name: str | None = None,
    workers: int = 1,
    dask: str | None = None,
    strict: bool = False,
) -> BuildResult:
    """Build a store from a folder in the pair format. Four pairs of files whose names differ only in the
    digit of the quadrant are joined to one field.

    The height of a pixel is grey value / 255 · full scale. In the authors' own files, heights were rounded
    down to a grey value, so they are too low by half a grey value (about 2 nm) on average.

    If the folder contains ``valid/``, the files in it are masks, and heights at the black pixels of a mask
    are not valid. Otherwise, all pixels are valid, and a field is reported if its heights are 0 along a whole
    side, because this side was probably not measured.

    Args:
        folder: folder that contains ``mask/``, ``afm/``, ``src_max_dict.txt`` and possibly ``valid/``.
        out: path of the store.
        pitch_um, level_height_um, levels: pixel pitch and nominal height of a level, in µm, and number of
            levels. The files do not state these values; the defaults are those of the paper.
        name: name of the dataset; by default the name of the folder.
        workers, dask: as for ``build_dataset``.
        strict: if true, nothing is built if any field cannot be used; if false, such fields are skipped.

    Raises:
        InputError: the folder has no ``src_max_dict.txt`` or no complete pair, the name of a file contains
            unprintable characters, or the pitch or the level height is not positive.
    """
    root = Path(folder).resolve()
    scales = read_full_scales(root / SCALES_FILE)
    kinds = ("mask", "afm", *[_MASKS] * (root / _MASKS).is_dir())
    fields, unpaired = _fields(root, kinds, scales)
    if not fields:
        raise InputError(
            f"complete pairs in {folder}",
            got=next((f"none; {name}: {reason}" for name, reason in unpaired.items()), "none"),
            wanted=f"files with the same name in {'/, '.join(kinds)}/, and this name in {SCALES_FILE}",
        )
    card = _card(
        name or re.sub(r"[^A-Za-z0-9._-]", "-", root.name), pitch_um, level_height_um, levels, list(fields)
    )
    ids = sorted(fields)
    jobs = [
        PairsJob(field_id, print_id or field_id, order, root, kinds, fields[field_id], scales, card)
        for order, (field_id, print_id) in enumerate(zip(ids, prints_of(ids, card.ids.print), strict=True))
    ]
    source = Source(
        card=card,
        jobs=jobs,
        data_dir=root,
        files={job.id: job.files for job in jobs} | {key: {key: root / key} for key in unpaired},
        assumptions=(
            "each scan shows exactly one write field, whose centre is that of the scan",
            "the fields were written in the order of their sorted ids",
        ),
        unpaired=unpaired,
    )
    return make_store(source, Path(out), workers=Workers(workers, dask), strict=strict)


@dataclass(frozen=True)
class PairsJob:
    """A job that joins the quadrants of one field. ``quadrants`` maps the number of each quadrant to the name
    that its files share. ``kinds`` are the folders of these files: ``mask``, ``afm`` and, if there are masks,
    ``valid``.

    A field that is not divided has only the quadrant 0.
    """

    id: str
    print_id: str
    order: int
    root: Path
    kinds: Sequence[str]
    quadrants: Mapping[int, str]
    scales_um: Mapping[str, float]
    card: Card

    @property
    def files(self) -> dict[str, Path]:
        """Return the files of the field: first the layout files, then the height files, then the masks, each
        in the order of the quadrants.
        """
        names = [f"{kind}/{name}" for kind in self.kinds for name in self.quadrants.values()]
        return {name: self.root / name for name in names}

    def key(self) -> str:
        """Return a hash of everything that determines the finished field. By this hash, a resumed build
        recognises fields that are already finished.
        """
        operation = OPERATIONS["stitch-pairs"]
        card = self.card.model_dump(mode="json")
        plan = [self.print_id, self.order, card, operation.version, operation.code_sha256, self._params]
        return record_sha256([plan, {name: file_sha256(path) for name, path in self.files.items()}])

    def run(self) -> Piece:
        """Join the quadrants of the field, and return the field as a ``Piece``, which a build can add to the
        store.
        """
        chain = Chain()
        chain.run("stitch-pairs", self._params, self.files)
        height = chain.arrays["height_um"]
        sides = () if _MASKS in self.kinds else (height[0], height[-1], height[:, 0], height[:, -1])
        return chain.piece(
            id=self.id,
            key=self.key(),
            use="dataset",
            print=self.print_id,
            order=self.order,
            columns={},
            quality={"valid_fraction": float(chain.arrays["valid"].mean())},
            notes=[_FRAME] * any(not side.any() for side in sides),
            read={"pitch_um": [self.card.layout.pitch_um] * 2},
        )

    @property
    def _params(self) -> dict[str, Any]:
        return {
            "quadrants": list(self.quadrants),
            "full_scale_um": [self.scales_um[name] for name in self.quadrants.values()],
            "levels": self.card.layout.levels,
        }


def _fields(
    root: Path, kinds: Sequence[str], scales: Mapping[str, float]
) -> tuple[dict[str, dict[int, str]], dict[str, str]]:
    """Return the file names, keyed by field and then by quadrant, and a dict that maps each unusable file to
    the reason why it cannot be used.
    """
    masks, heights, *seen = ({path.name for path in (root / kind).glob("*.tif")} for kind in kinds)
    if unprintable := [name for name in sorted(masks.union(heights, *seen)) if not name.isprintable()]:
        raise InputError(
            f"file name in {root}", got=ascii(unprintable[0]), wanted="a name of printable characters"
        )
    unpaired = {f"mask/{name}": "no height file of this name" for name in sorted(masks - heights)}
    unpaired |= {f"afm/{name}": "no layout file of this name" for name in sorted(heights - masks)}
    unpaired |= {f"afm/{name}": f"not in {SCALES_FILE}" for name in sorted((masks & heights) - set(scales))}
    paired = masks & heights & set(scales)
    for own in seen:
        unpaired |= {f"afm/{name}": f"not in {_MASKS}/" for name in sorted(paired - own)}
        paired &= own
    complete = sorted(name for name in paired if SAFE_ID.fullmatch(name))
    unpaired |= {f"afm/{name}": f"a name {SAFE_ID_RULE}" for name in sorted(paired.difference(complete))}
    cut: dict[str, dict[int, str]] = {}
    for name in complete:
        stem = Path(name).stem
        if stem[-1:] in "1234":
            cut.setdefault(stem[:-1], {})[int(stem[-1])] = name
    whole = {field: dict(sorted(names.items())) for field, names in cut.items() if field and len(names) == 4}
    stitched = {name for names in whole.values() for name in names.values()}
    return whole | {Path(name).stem: {0: name} for name in complete if name not in stitched}, unpaired


def _card(name: str, pitch_um: float, level_height_um: float, levels: int, ids: Sequence[str]) -> Card:
    matches = all(re.fullmatch(_AUTHORS_IDS, field_id) for field_id in ids)
    content = {
        "name": name,
        "title": "Imported from 8-bit pairs",
        "layout": {
            "files": "mask/{id}.tif",
            "pitch_um": pitch_um,
            "level_height_um": level_height_um,
            "levels": levels,
        },
        "scan": {"files": "afm/{id}.tif", "full_scale_file": SCALES_FILE},
        "ids": {"print": _AUTHORS_IDS} if matches else {},
    }
    return check_card(content, "import-pairs")


def export_pairs(store_path: str | Path, out: str | Path) -> list[str]:
    """Write a store in the pair format. Return notes about the scans that have negative heights or unmeasured
    pixels, because the format can represent neither.

    If a scan has negative heights, all its heights are raised so that the lowest is 0. Heights are rounded to
    the nearest grey value; pixels that were not measured become 0, and are black in the masks
    ``valid/<id><q>.tif``.

    Raises:
        InputError: a field cannot be cut into four quadrants, or the output folder contains files of another
            kind.
    """
    store = open_store(store_path)
    notes: list[str] = []
    scales: dict[str, float] = {}
    with whole_folder(out, "mask/*.tif", "afm/*.tif", f"{_MASKS}/*.tif", SCALES_FILE) as folder:
        for name in ("mask", "afm", _MASKS):
            (folder / name).mkdir()
        for scan_id in progress(store.ids, "exporting pairs"):
            scan = store.scan(scan_id)
            if scan.shape[0] % 2 or scan.shape[1] % 2:
                raise InputError(
                    f"size of field {scan_id}", got=scan.shape, wanted="even numbers of rows and columns"
                )
            valid = scan.valid & np.isfinite(scan.height_um)
            measured_um = np.where(valid, scan.height_um, np.nan)
            lift_um = -float(np.nanmin(measured_um, initial=0))
            height_um = measured_um + lift_um
            if lift_um:
                notes.append(
                    f"{scan_id}: heights were raised by {lift_um * 1e3:.1f} nm, because the format has no "
                    "negative heights"
                )
            if unmeasured := int((~valid).sum()):
                notes.append(
                    f"{scan_id}: {unmeasured} unmeasured pixels became 0, and are marked only in {_MASKS}/"
                )
            full_scale_um = max(float(np.nanmax(height_um, initial=0)), 1e-6)
            grey = np.rint(np.nan_to_num(height_um) / full_scale_um * GREY_MAX).astype(np.uint8)
            seen = np.where(valid, GREY_MAX, 0).astype(np.uint8)
            for quadrant in _QUADRANTS:
                name = f"{scan_id}{quadrant}.tif"
                _write_tiff(
                    folder / "mask" / name, np.repeat(_cut(scan.mask_level, quadrant)[..., None], 3, axis=2)
                )
                _write_tiff(folder / "afm" / name, _cut(grey, quadrant))
                _write_tiff(folder / _MASKS / name, _cut(seen, quadrant))
                scales[name] = full_scale_um * 1e-6
        (folder / SCALES_FILE).write_text(json.dumps(scales), encoding="utf-8")
    return notes


def _cut(image: Array, quadrant: int) -> Array:
    return image[quadrant_slices(quadrant, image.shape)]


def _write_tiff(path: Path, image: Array) -> None:
    import tifffile

    photometric = "rgb" if image.ndim == 3 else "minisblack"
    tifffile.imwrite(path, np.ascontiguousarray(image), compression="lzw", photometric=photometric)
