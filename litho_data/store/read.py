"""Read a dataset store. It is checked once, when it is opened. Its scans are then read one at a time."""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from litho_data.foundation import YX, Array, Facts, damaged, unknown_name
from litho_data.register.bend import Bend
from litho_data.store.access import (
    decoded,
    group_of,
    groups_in,
    has_child,
    open_root,
    read_table,
    values_if_any,
    values_of,
)
from litho_data.store.contract import (
    checked_arrays,
    checked_attributes,
    checked_columns,
    require_complete,
    require_manifest,
    require_own_pixels,
    require_possible,
    true_shapes,
)
from litho_data.store.lock_box import FIELD_COLUMNS, field_sha256, lock_box
from litho_data.store.printed_scan import PrintedScan as PrintedScan
from litho_data.store.schema import (
    OPTIONAL_COLUMNS,
    SAMPLE_VARIABLES,
    SIGMA,
    TEXT_COLUMNS,
    VARIABLES,
    DatasetId,
    Instrument,
    dataset_facts,
    dataset_sha256,
)

if TYPE_CHECKING:
    import pandas as pd
    import zarr


_SHOWN_SCANS = 12


def open_store(path: str | Path) -> Store:
    """Open a dataset store, which is a folder or a ``.zarr.zip`` file, and check it by reading all data once.

    Raises:
        InputError: the path does not exist or is not a Zarr v3 group, a declared file is missing or damaged,
            or arrays or attributes violate the store's contract.
    """
    root = open_root(path)
    require_complete(Path(path))
    store = Store(root, Path(path))
    # Reading these properties checks the hash and the manifest. Their values are not used here.
    _ = store.sha256, store.manifest
    return store


class Store:
    """A dataset of printed scans. The arrays of a scan are read when they are needed, and are not kept."""

    def __init__(self, root: zarr.Group, path: Path):
        self.path = path
        self.root = root
        attributes = checked_attributes(root, path)
        self.name: str = attributes["name"]
        self.pitch_um: float = attributes["pitch_um"]
        self.level_height_um: float = attributes["level_height_um"]
        self.levels: int = attributes["levels"]
        self.write: dict[str, Any] | None = attributes["write"]
        self.instrument: Instrument = attributes["instrument"]
        self._arrays = checked_arrays(root, path)
        require_own_pixels(root, path, self._arrays["mask_level"].shape[1:], self.pitch_um)
        self._columns = checked_columns(root, path)
        self.ids: list[str] = self._columns["scan"]
        self._print_ids: list[str] = self._columns["print"]
        self.shapes = true_shapes(root, path, len(self.ids), self._arrays["mask_level"].shape[1:])
        self._row = {scan_id: row for row, scan_id in enumerate(self.ids)}

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"Store({self.name!r}, {len(self)} scans, pitch_um={self.pitch_um}, path={str(self.path)!r})"

    def _repr_html_(self) -> str:
        import pandas as pd

        scans = pd.DataFrame({"scan": self.ids, "print": self._print_ids, "order": self._columns["order"]})
        return f"<p>{html.escape(repr(self))}</p>{scans.to_html(index=False, max_rows=_SHOWN_SCANS)}"

    def scan(self, scan_id: str) -> PrintedScan:
        """Read one scan, without its padding.

        Raises:
            InputError: there is no such id, or a stored chunk cannot be decoded.
        """
        row = self._row.get(scan_id)
        if row is None:
            raise unknown_name(f"scan of {self.path}", scan_id, self.ids)
        return PrintedScan(
            id=scan_id,
            print_id=self._print_ids[row],
            order=self._columns["order"][row],
            mask_level=self.sample("mask_level", row),
            height_um=self.sample("height_um", row),
            valid=self.sample("valid", row),
            pitch_um=self.pitch_um,
            level_height_um=self.level_height_um,
            levels=self.levels,
            scan_to_layout=self.sample("scan_to_layout", row),
            write=self.write,
            seen_by=self.instrument,
            **{name: self._columns[name][row] for name in OPTIONAL_COLUMNS},
            bend_um=self._bend_um(row),
            tip_radius_um=self._tip_radius_um(row),
            height_sigma_um=self.sample(SIGMA.name, row) if SIGMA.name in self._arrays else None,
            groups=self._groups(scan_id),
            instrument=self._columns["instrument"][row],
            surround=self._columns["surround"][row] or str((self.write or {}).get("surround", "unknown")),
        )

    def _groups(self, scan_id: str) -> dict[str, str]:
        """Match one id with the id pattern of the card, and return the values of the pattern's named groups.
        The group ``print`` is left out.

        If the pattern contains repetitions, the result is empty. Matching such a pattern may never finish,
        and a store of unknown origin may contain it on purpose.
        """
        ids = (self.manifest.get("card") or {}).get("ids") or {}
        pattern = str(ids.get("print") or "")
        if set("*+{?") & set(pattern.replace("(?", "(")):
            return {}
        try:
            match = re.fullmatch(pattern, scan_id)
        except re.error:
            return {}
        found = match.groupdict() if match else {}
        return {name: value for name, value in found.items() if name != "print" and value is not None}

    def scans(self) -> list[PrintedScan]:
        """Read all scans into memory and return them in stored order."""
        return [self.scan(scan_id) for scan_id in self.ids]

    def sample(self, name: str, row: int) -> Array:
        """Read the part of the array ``name`` that belongs to one scan, without its padding. ``row`` is the
        position of the scan in ``ids``.

        Raises:
            InputError: a stored chunk cannot be decoded.
        """
        what = f"{name} of scan {self.ids[row]} in {self.path}"
        values = decoded(self._arrays[name], row, what)
        values = values.astype(VARIABLES[name].stored_as(values), copy=False)
        if name == "scan_to_layout":
            return values
        ny, nx = self.shapes[row]
        return values[:ny, :nx]

    def scan_frame(self, scan_id: str, name: str) -> Array:
        """Read an array that lies on the scan's own pixel grid instead of the layout's, such as
        ``raw_height_um`` or ``levelled_height_um``.

        Raises:
            InputError: there is no such scan or array, or a stored chunk cannot be decoded.
        """
        return values_of(group_of(self.root, f"scans/{scan_id}"), name)

    def scan_frame_pitch_um(self, scan_id: str) -> YX:
        """Return the pitch along y and x, in µm, of the arrays that ``scan_frame`` reads. If the axes of the
        microscope were calibrated, it is the corrected pitch.

        Raises:
            InputError: there is no such scan, or its metadata are damaged.
        """
        group = group_of(self.root, f"scans/{scan_id}")
        with damaged(f"pitch of scan {scan_id} in {self.path}"):
            ome: Any = group.attrs["ome"]
            (transform,) = ome["multiscales"][0]["datasets"][0]["coordinateTransformations"]
            pitch_y_um, pitch_x_um = map(float, transform["scale"])
            return pitch_y_um, pitch_x_um

    @cached_property
    def locked_ids(self) -> list[str]:
        """Return the ids of the scans in the lock box, which are set aside for the final test. The lock box
        consists of all scans of a sixth of the printed fields. The same dataset always has the same lock box.
        """
        fields = [
            field_sha256(
                name, self.sample("mask_level", row), [self._columns[one][row] for one in FIELD_COLUMNS]
            )
            for row, name in enumerate(self._print_ids)
        ]
        return lock_box(self.ids, self._print_ids, fields)

    def files_sha256(self, ids: Sequence[str]) -> dict[str, str]:
        """Return the hashes of the scans' raw files, keyed by scan id. The hashes do not depend on levelling
        or registration.

        A scan is omitted if the store does not list its file. The hashes of layout files are left out,
        because a layout may be printed more than once.
        """
        wanted = set(ids)
        rows = [row for row in self.manifest.get("files", []) if row["scan"] in wanted and row["sha256"]]
        # Only rows of files that were read as scans contain facts from a reader.
        return {row["scan"]: row["sha256"] for row in rows if _read_facts(row)}

    def references(self) -> dict[str, str]:
        """Return a dict that maps the id of each reference scan to its use, such as ``flat``.

        Reference scans do not belong to the dataset; ``scan_frame`` reads their heights.
        """
        if not has_child(self.root, "scans"):
            return {}
        groups = groups_in(group_of(self.root, "scans"))
        with damaged(f"metadata of the scans in {self.path}"):
            uses = {name: str(group.attrs["use"]) for name, group in groups.items()}
        return {name: use for name, use in sorted(uses.items()) if use != "dataset"}

    def recorded_pitches_um(self) -> dict[str, YX]:
        """Return the pitch along y and x, in µm, that the reader recorded for each scan, including reference
        scans. Unlike the pitch that ``scan_frame_pitch_um`` returns, this pitch is not corrected by a
        calibration.
        """
        pitches = {}
        for row in self.manifest.get("files", []):
            if pitch := _read_facts(row).get("pitch_um"):
                pitches[row["scan"]] = (float(pitch[0]), float(pitch[1]))
        return pitches

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Return the manifest: the dataset card, the record of the build, and one row per raw file. Return an
        empty dict if the store has no manifest.
        """
        if not has_child(self.root, "manifest"):
            return {}
        group = group_of(self.root, "manifest")
        manifest = {**dict(group.attrs), "files": read_table(group, "path").to_dict("records")}
        require_manifest(manifest, self.path)
        return manifest

    @cached_property
    def quality(self) -> pd.DataFrame:
        """Return a table with one row per scan that states how well the scan was registered and levelled, and
        how noisy it is.

        If the store has no such table, the rows contain only the ids.
        """
        import pandas as pd

        if not has_child(self.root, "quality"):
            return pd.DataFrame({"scan": self.ids})
        return read_table(group_of(self.root, "quality"), "scan")

    @cached_property
    def sha256(self) -> str:
        """Return the hash of the dataset. The hash does not depend on how the arrays are divided into chunks,
        and is computed only once.
        """
        return self.computed_sha256()

    @property
    def dataset_id(self) -> DatasetId:
        """Return the name and the hash of the dataset. Results that are made from the dataset record both."""
        return DatasetId(name=self.name, sha256=self.sha256)

    def computed_sha256(self) -> str:
        """Compute the hash of the dataset from its current arrays."""
        facts = dataset_facts(self, self.instrument, self.write)
        return dataset_sha256(facts, [self._identity(row) for row in range(len(self))])

    def _identity(self, row: int) -> dict[str, Any]:
        stated = {name: self._columns[name][row] for name in (*OPTIONAL_COLUMNS, *TEXT_COLUMNS)}
        identity = {
            "id": self.ids[row],
            "print": self._print_ids[row],
            "order": self._columns["order"][row],
            **{name: value for name, value in stated.items() if value not in (None, "")},
        }
        samples = {v.name: self.sample(v.name, row) for v in SAMPLE_VARIABLES}
        require_possible(samples, self.levels, f"scan {self.ids[row]} of {self.path}")
        hashes = {v.name: v.sample_sha256(samples[v.name]) for v in SAMPLE_VARIABLES}
        bend_um = self._bend_um(row)
        if bend_um is not None:
            hashes["bend_um"] = VARIABLES["bend_um"].sample_sha256(bend_um.amount)
        return {**identity, "arrays": hashes}

    def _bend_um(self, row: int) -> Bend | None:
        """Return the bend of a scan, in the scan's own frame, or None if the store contains none."""
        scan_id = self.ids[row]
        if not has_child(self.root, f"scans/{scan_id}/bend_um"):
            return None
        with damaged(f"bend of scan {scan_id} in {self.path}"):
            one = self.quality.iloc[row]
            shape = int(one["scan_ny"]), int(one["scan_nx"])
            pitch_um = float(one["scan_pitch_y_um"]), float(one["scan_pitch_x_um"])
            return Bend.of_scan(self.scan_frame(scan_id, "bend_um"), shape, pitch_um)

    def _tip_radius_um(self, row: int) -> float | None:
        with damaged(f"tip_radius_um of {self.path}"):
            value = math.nan if self._tip_radii_um is None else float(self._tip_radii_um[row])
        return None if math.isnan(value) else value

    @cached_property
    def _tip_radii_um(self) -> Array | None:
        # The whole table takes a hundred times as long to read as this column.
        return values_if_any(self.root, "quality/tip_radius_um")


def _read_facts(row: Facts) -> dict[str, Any]:
    facts: dict[str, Any] = json.loads(row["read"] or "{}")
    return facts
