"""List the printed fields of a card: find the card's files, pair layouts with scans by id, and read the
card's table.
"""

import glob
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from litho_data.cards.card import Card, Use, load_card
from litho_data.cards.fetch import known_folders
from litho_data.cards.tables import READ_COLUMNS, SAFE_ID, SAFE_ID_RULE, read_full_scales, read_table
from litho_data.foundation import Facts, InputError
from litho_data.foundation.names import is_plain_name
from litho_data.readers.exported import sidecar_of
from litho_data.store.schema import OPTIONAL_COLUMNS, TEXT_COLUMNS

# Time limit for the separate process that matches a card's regular expression against the ids.
_LONGEST_S = 10.0
_MATCH = """
import json, re, sys
pattern, ids = json.load(sys.stdin)
json.dump([found and found["print"] for found in (re.fullmatch(pattern, one) for one in ids)], sys.stdout)
"""


@dataclass(frozen=True)
class PrintedField:
    """One printed field to build: its layout file, its scan files, and what the card says about it.

    ``columns`` contains the optional numbers and words that the card's table states for this field, such as
    its dose. ``read`` contains the reading options that the table states for this scan; they take precedence
    over the options in the card's ``[scan]`` table. If the scan is an integer image, ``full_scale_um`` is the
    height that the largest possible pixel value stands for. ``layout`` may be None only for a reference scan,
    i.e. a scan whose ``use`` is not ``dataset``.
    """

    id: str
    print_id: str
    order: int
    use: Use
    scan: Path
    layout: Path | None
    full_scale_um: float | None = None
    columns: Mapping[str, float | str] = field(default_factory=dict)
    read: Facts = field(default_factory=dict)


@dataclass(frozen=True)
class Listing:
    """A dataset card, the folder that contains its files, the fields to build, and the files found for each
    id.

    Each id that is not built is a key of ``unpaired`` if its layout or its scan is missing, and a key of
    ``refused`` if its files are present but cannot be used. The value is the reason.
    """

    card: Card
    card_path: Path
    data_dir: Path
    fields: tuple[PrintedField, ...]
    files: Mapping[str, tuple[Path, ...]]
    unpaired: Mapping[str, str]
    refused: Mapping[str, str]
    assumptions: tuple[str, ...]

    def relative(self, path: Path) -> str:
        """Return the path in the form in which records of a build state it: relative to the data folder, with
        forward slashes.
        """
        return path.relative_to(self.data_dir).as_posix()


def list_fields(card_path: str | Path, data_dir: str | Path | None = None) -> Listing:
    """Find the layout and scan files of a card, and pair them by id.

    Args:
        card_path: path of the card.
        data_dir: folder to which the card's file patterns are relative. By default, it is the first folder
            that has files: the card's own folder, ``$LITHO_DATA_DIR/<name>``, or the user cache.

    Raises:
        InputError: the card or its table is invalid, no folder has the files, or no id has both a layout and
            a scan.
    """
    file = Path(card_path)
    card = load_card(file)
    folder = _data_folder(card, file, data_dir)
    layouts, sidecars = _without_sidecars(files_by_id(folder, card.layout.files))
    scans = files_by_id(folder, card.scan.files)
    table = _table(card, folder, file.parent)
    scales = read_full_scales(folder / name) if (name := card.scan.full_scale_file) else None

    fields: list[PrintedField] = []
    every: dict[str, tuple[Path, ...]] = {}
    unpaired: dict[str, str] = {}
    refused: dict[str, str] = {}
    ids = sorted({*layouts, *scans, *table})
    print_ids = dict(zip(ids, prints_of(ids, card.ids.print), strict=True))
    for scan_id in ids:
        row = table.get(scan_id, {})
        use: Use = row.get("use", "dataset")
        files = [found[scan_id] for found in (layouts, scans) if scan_id in found]
        every[scan_id] = (*layouts.get(scan_id, ()), *sidecars.get(scan_id, ()), *scans.get(scan_id, ()))
        if scan_id not in scans or (scan_id not in layouts and use == "dataset"):
            wanted = patterns_of(card.scan.files if scan_id not in scans else card.layout.files)
            shown = " or ".join(pattern.replace("{id}", scan_id) for pattern in wanted)
            unpaired[scan_id] = f"no file {shown}"
            continue
        print_id = print_ids[scan_id]
        scale = None if scales is None else scales.get(scan_id, scales.get(scans[scan_id][0].name))
        reason = _refusal(scan_id, print_id, use, table, card) or leads_out(every[scan_id], folder)
        if not reason and (several := [found for found in files if len(found) > 1]):
            names = ", ".join(one.name for one in several[0])
            reason = f"several files: {names}; the pattern must match only one"
        if not reason and scales is not None and scale is None:
            reason = f"no full scale in {card.scan.full_scale_file}"
        if reason:
            refused[scan_id] = reason
            continue
        fields.append(
            PrintedField(
                id=scan_id,
                print_id=print_id or scan_id,
                order=row.get("order", len(fields)),
                use=use,
                scan=scans[scan_id][0],
                layout=layouts[scan_id][0] if scan_id in layouts else None,
                full_scale_um=scale,
                columns={name: row[name] for name in (*OPTIONAL_COLUMNS, *TEXT_COLUMNS) if name in row},
                read={name: row[name] for name in READ_COLUMNS if name in row},
            )
        )
    if card.grating is None and (unknown := [one.id for one in fields if one.use == "grating"]):
        raise InputError(
            f"card {file}: period of the grating in scan {unknown[0]}",
            got="no [grating]",
            wanted="a table [grating] with period_um, from the certificate of the grating",
        )
    if not any(one.use == "dataset" for one in fields):
        shown = "; ".join(f"{key}: {why}" for key, why in [*{**unpaired, **refused}.items()][:3]) or "no ids"
        raise InputError(
            f"card {file}: no field to build", got=shown, wanted="a layout and a scan with the same id"
        )
    assumed = _assumptions(card, table)
    return Listing(card, file, folder, tuple(fields), every, unpaired, refused, assumed)


def _data_folder(card: Card, card_path: Path, data_dir: str | Path | None) -> Path:
    folders = [Path(data_dir)] if data_dir is not None else [card_path.parent, *known_folders(card.name)]
    for folder in folders:
        if all(files_by_id(folder, files) for files in (card.layout.files, card.scan.files)):
            return folder.resolve()
    raise InputError(
        f"files of card {card_path}",
        got=f"none in {', '.join(str(folder) for folder in folders)}",
        wanted=" and ".join((*patterns_of(card.layout.files), *patterns_of(card.scan.files))),
        hint=f"try litho-data fetch {card.name}, or set LITHO_DATA_DIR" if card.source else "",
    )


def patterns_of(files: str | Sequence[str]) -> tuple[str, ...]:
    """Return the file patterns of a card's entry ``files``, which is either one pattern or a sequence of
    patterns.
    """
    return (files,) if isinstance(files, str) else tuple(files)


def files_by_id(folder: Path, files: str | Sequence[str]) -> dict[str, list[Path]]:
    """Find the files that match one or several patterns, and return lists of their paths keyed by id. In a
    pattern, ``{id}`` stands for the id, and ``*`` for any part of a name.

    Raises:
        InputError: the name of a file is not UTF-8, so no record could state it.
    """
    found: dict[str, list[Path]] = {}
    for pattern in patterns_of(files):
        before, *rest = (
            "[^/]*".join(re.escape(piece) for piece in part.split("*")) for part in pattern.split("{id}")
        )
        # The first {id} of a pattern captures the id, and every other {id} must match the same text.
        match = re.compile(before + "(?P<id>[^/]+)" + "(?P=id)".join(rest))
        parts = pattern.replace("{id}", "*").split("*")
        for name in sorted(glob.glob("*".join(glob.escape(part) for part in parts), root_dir=folder)):
            hit, path = match.fullmatch(name.replace("\\", "/")), folder / name
            if hit and path.is_file() and path not in found.setdefault(hit["id"], []):
                found[hit["id"]].append(path)
                _require_decoded(name)
    return {scan_id: paths for scan_id, paths in found.items() if paths}


def _require_decoded(name: str) -> None:
    try:
        name.encode()
    except UnicodeEncodeError as error:
        got = repr(os.fsencode(name))
        raise InputError("name of a file", got=got, wanted="UTF-8", hint="rename the file") from error


def _without_sidecars(
    layouts: Mapping[str, list[Path]],
) -> tuple[dict[str, list[Path]], dict[str, list[Path]]]:
    """Separate the layouts from the sidecars of exported layouts, because a pattern such as ``{id}.*`` finds
    both. Return the paths of the layouts and the paths of the sidecars, each keyed by the layout's id.
    """
    sidecars = {
        scan_id: [path for path in map(sidecar_of, paths) if path] for scan_id, paths in layouts.items()
    }
    known = {path for paths in sidecars.values() for path in paths}
    left = {scan_id: [path for path in paths if path not in known] for scan_id, paths in layouts.items()}
    return {scan_id: paths for scan_id, paths in left.items() if paths}, sidecars


def _refusal(scan_id: str, print_id: str | None, use: str, table: Mapping[str, Facts], card: Card) -> str:
    """Return the reason why an id that has all its files cannot be used, or an empty string if it can be
    used.
    """
    if not SAFE_ID.fullmatch(scan_id):
        return f"an id {SAFE_ID_RULE}"
    for what, name in (("id", scan_id), ("name of the print", print_id or scan_id)):
        if not is_plain_name(name):
            return f"the first or last character of the {what} {name[:80]!r}, or its length, is not allowed"
    if print_id is None and use == "dataset":
        return f"id does not match [ids] print = {card.ids.print!r}"
    if use != "dataset" and card.scan.instrument == "sem":
        return f"use = {use}, but a reference is a scan of heights, and a micrograph has none"
    if scan_id not in table and any("order" in row for row in table.values()):
        return f"not in {card.ids.table}, which sets the order"
    return ""


def leads_out(files: tuple[Path, ...], folder: Path) -> str:
    """Return a message if one of the files is a link to a place outside the data folder, otherwise an empty
    string. Such a link is refused because the card describes only files in this folder.
    """
    outside = [path for path in files if not path.resolve().is_relative_to(folder)]
    return f"{outside[0].name} is a link that leads out of the data folder" if outside else ""


def _table(card: Card, *folders: Path) -> dict[str, dict[str, Any]]:
    if card.ids.table is None:
        return {}
    path = next((folder / card.ids.table for folder in folders if (folder / card.ids.table).is_file()), None)
    if path is None:
        raise InputError(
            "table of the card", got=f"no file {card.ids.table}", wanted="a CSV file beside the card"
        )
    return read_table(path)


def _assumptions(card: Card, table: Mapping[str, Facts]) -> tuple[str, ...]:
    """Return one sentence for each assumption that is made because the card does not state a fact."""
    assumed = []
    if card.process.level is None and not card.scan.levelled:
        assumed.append("the heights are levelled by a plane fitted together with the layout (process.level)")
    if card.write is None or card.write.field_um is None:
        assumed.append("each scan shows exactly one write field, whose centre is that of the scan")
    if not any("order" in row for row in table.values()):
        assumed.append("the fields were written in the order of their sorted ids")
    if card.ids.print is None:
        assumed.append("every scan shows a separate print")
    return tuple(assumed)


def prints_of(ids: Sequence[str], pattern: str | None) -> list[str | None]:
    """Return the name of the print to which each id belongs: the text that the group ``print`` of a regular
    expression captures, or None if the expression does not match the whole id.

    If ``pattern`` is None, every id counts as a separate print. Matching an expression with nested
    repetitions can take forever and cannot be interrupted from within Python. An expression that contains any
    repetition is therefore matched in a separate process.

    Raises:
        InputError: the separate process has not finished after 10 s.
    """
    if pattern is None:
        return list(ids)
    if not set("*+{?") & set(pattern.replace("(?", "(")):
        return [found and found["print"] for found in (re.fullmatch(pattern, one) for one in ids)]
    try:
        # Python runs isolated and without site packages, because loading them would take ten times as long.
        done = subprocess.run(
            [sys.executable, "-ISc", _MATCH],
            input=json.dumps([pattern, list(ids)]),
            capture_output=True,
            text=True,
            timeout=_LONGEST_S,
            check=True,
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(
            f"[ids] print = {pattern!r}",
            got=f"no result after {_LONGEST_S:.0f} s",
            wanted="an expression without nested repetitions",
        ) from error
    return json.loads(done.stdout)
