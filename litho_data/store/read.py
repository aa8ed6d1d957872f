"""Reading a dataset store: checked once when it is opened, then read one scan at a time."""

from __future__ import annotations

import html
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation.errors import InputError, unknown_name
from litho_data.register.bend import Bend
from litho_data.store.access import (
    decoded,
    group_of,
    groups_in,
    has_child,
    open_root,
    read_table,
    values_of,
)
from litho_data.store.lock_box import lock_box, lock_box_size
from litho_data.store.schema import (
    OPTIONAL_COLUMNS,
    SAMPLE_VARIABLES,
    SIGMA,
    VARIABLES,
    DatasetId,
    checked_arrays,
    checked_attributes,
    dataset_sha256,
    true_shapes,
)

if TYPE_CHECKING:
    import pandas as pd
    import zarr


_SHOWN_SCANS = 12


@dataclass(frozen=True)
class PrintedScan:
    """One printed field: the layout sent to the printer and the height measured on the layout's grid.

    Args:
        id: name of the scan; ``print_id``: block of fields it was printed with; ``order``: writing order.
        mask_level: layout levels, uint8 (ny, nx).
        height_um: float32 (ny, nx), µm, NaN where not measured.
        valid: bool (ny, nx), measured and inside the scan.
        pitch_um: pixel pitch of all three arrays, µm; ``level_height_um``: nominal height of a level, µm.
        levels: number of levels the layout may use.
        scan_to_layout: 3 x 3 float64, maps (x_um, y_um, 1) of the scan's own frame to the layout frame.
        write: the card's ``[write]`` table; None if it has none.
        field_x_um, field_y_um: position of the scan in its write field, µm; ``dose``: relative dose;
            None if the card does not state it.
        turned_deg: by how much the scan is turned against the others, ``direction``: 1 trace, -1 retrace,
            ``tip``: number of the tip, ``pixel_size``: of the scan, relative to the others; None as above.
        bend_um: of a bent scan; ``scan_to_layout`` then acts on the straightened positions.
        tip_radius_um: of the microscope's tip, or the most that it can be; None if the store does not say.
        height_sigma_um: float32 (ny, nx), µm, standard uncertainty of ``height_um``, the scan's offset aside;
            NaN where not valid, None if the store has none.
        groups: what the card's pattern of ids says beside the print, such as the field; by name.
    """

    id: str
    print_id: str
    order: int
    mask_level: np.ndarray
    height_um: np.ndarray
    valid: np.ndarray
    pitch_um: float
    level_height_um: float
    levels: int
    scan_to_layout: np.ndarray
    write: Mapping[str, Any] | None = None
    field_x_um: float | None = None
    field_y_um: float | None = None
    dose: float | None = None
    turned_deg: float | None = None
    direction: float | None = None
    tip: float | None = None
    pixel_size: float | None = None
    bend_um: Bend | None = None
    tip_radius_um: float | None = None
    height_sigma_um: np.ndarray | None = None
    groups: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        ny, nx = self.shape
        return (
            f"<PrintedScan {self.id}: {ny} x {nx} px of {self.pitch_um:g} µm, print {self.print_id}, "
            f"{self.levels} levels of {self.level_height_um:g} µm, {self.valid.mean():.1%} valid>"
        )

    def _repr_html_(self) -> str:
        from litho_data.foundation.report_pictures import shown_html

        return shown_html(repr(self), layout_um=self.layout_um, height_um=self.height_um)

    @property
    def quarter_turns(self) -> int:
        """How often ``rot90`` turns the layout's grid into the scan's, 0 to 3, by its registration."""
        along = self.scan_to_layout[:2, 0]
        return round(math.atan2(along[1], along[0]) / (math.pi / 2)) % 4

    @property
    def usable(self) -> np.ndarray:
        """Measured pixels, bool (ny, nx)."""
        return np.asarray(self.valid, bool) & np.isfinite(self.height_um)

    @property
    def layout_um(self) -> np.ndarray:
        """Nominal height, float32 (ny, nx), µm."""
        return self.mask_level.astype(np.float32) * np.float32(self.level_height_um)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx) in pixels."""
        return self.mask_level.shape[0], self.mask_level.shape[1]


def open_store(path: str | Path) -> Store:
    """Open a dataset store, a folder or a ``.zarr.zip`` file, for reading.

    Raises:
        InputError: not there, not a Zarr v3 group, or arrays and attributes that break the store's contract.
    """
    return Store(open_root(path), Path(path))


class Store:
    """A dataset of printed scans; arrays are read when they are needed, never all at once."""

    def __init__(self, root: zarr.Group, path: Path):
        self.path = path
        self.root = root
        attributes = checked_attributes(root, path)
        self.name: str = attributes["name"]
        self.pitch_um: float = attributes["pitch_um"]
        self.level_height_um: float = attributes["level_height_um"]
        self.levels: int = attributes["levels"]
        self.write: dict[str, Any] | None = attributes["write"]
        self._arrays = checked_arrays(root, path)
        self.ids: list[str] = [str(value) for value in values_of(root, "scan")]
        if len(set(self.ids)) != len(self.ids):
            raise InputError(f"scan ids of {path}", got="duplicates", wanted="unique ids")
        self._print_ids = [str(value) for value in values_of(root, "print")]
        self._order = [int(value) for value in values_of(root, "order")]
        self._columns = {name: values_of(root, name) for name in OPTIONAL_COLUMNS if has_child(root, name)}
        self.shapes = true_shapes(root, len(self.ids), self._arrays["mask_level"].shape[1:])
        self._row = {scan_id: row for row, scan_id in enumerate(self.ids)}

    def __len__(self) -> int:
        return len(self.ids)

    def __repr__(self) -> str:
        return f"Store({self.name!r}, {len(self)} scans, pitch_um={self.pitch_um}, path={str(self.path)!r})"

    def _repr_html_(self) -> str:
        import pandas as pd

        scans = pd.DataFrame({"scan": self.ids, "print": self._print_ids, "order": self._order})
        return f"<p>{html.escape(repr(self))}</p>{scans.to_html(index=False, max_rows=_SHOWN_SCANS)}"

    def scan(self, scan_id: str) -> PrintedScan:
        """One scan, without padding.

        Raises:
            InputError: no such id, or a stored chunk that does not decode.
        """
        row = self._row.get(scan_id)
        if row is None:
            raise unknown_name(f"scan of {self.path}", scan_id, self.ids)
        return PrintedScan(
            id=scan_id,
            print_id=self._print_ids[row],
            order=self._order[row],
            mask_level=self.sample("mask_level", row),
            height_um=self.sample("height_um", row),
            valid=self.sample("valid", row),
            pitch_um=self.pitch_um,
            level_height_um=self.level_height_um,
            levels=self.levels,
            scan_to_layout=self.sample("scan_to_layout", row),
            write=self.write,
            **{name: self._column(name, row) for name in OPTIONAL_COLUMNS},
            bend_um=self._bend_um(row),
            tip_radius_um=self._tip_radius_um(row),
            height_sigma_um=self.sample(SIGMA.name, row) if SIGMA.name in self._arrays else None,
            groups=self._groups(scan_id),
        )

    def _groups(self, scan_id: str) -> dict[str, str]:
        """Named groups of the card's pattern in an id, the print aside.

        A pattern that repeats is not asked: one in a store from elsewhere might never come to an end.
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
        """All scans in stored order, in memory."""
        return [self.scan(scan_id) for scan_id in self.ids]

    def sample(self, name: str, row: int) -> np.ndarray:
        """One scan's slice of one array in its true shape.

        Raises:
            InputError: a stored chunk that does not decode.
        """
        values = decoded(self._arrays[name], row, f"{name} of scan {self.ids[row]} in {self.path}")
        if name == "scan_to_layout":
            return values
        ny, nx = self.shapes[row]
        return values[:ny, :nx]

    def scan_frame(self, scan_id: str, name: str) -> np.ndarray:
        """An array of a scan in its own frame: ``raw_height_um``, ``levelled_height_um``, ``removed_um``, …

        Raises:
            InputError: no such scan or array, or a stored chunk that does not decode.
        """
        return values_of(group_of(self.root, f"scans/{scan_id}"), name)

    @property
    def locked_ids(self) -> list[str]:
        """Ids of the lock box: a sixth of the scans, from different prints, the same in every session."""
        return lock_box(self.ids, self._print_ids, lock_box_size(len(self)))

    def files_sha256(self, ids: Sequence[str]) -> dict[str, str]:
        """Hash of the raw file of each of these scans, however they were levelled and registered.

        A scan whose file the store does not list is left out. Layouts do not count: one may be printed twice.
        """
        wanted = set(ids)
        rows = [row for row in self.manifest.get("files", []) if row["scan"] in wanted and row["sha256"]]
        # Only what was read as a scan has the facts of a reader.
        return {row["scan"]: row["sha256"] for row in rows if json.loads(row["read"] or "{}")}

    def references(self) -> dict[str, str]:
        """Scans outside the dataset: id and use, such as flat; ``scan_frame`` has the heights."""
        if not has_child(self.root, "scans"):
            return {}
        groups = groups_in(group_of(self.root, "scans"))
        uses = {name: str(group.attrs["use"]) for name, group in groups.items()}
        return {name: use for name, use in sorted(uses.items()) if use != "dataset"}

    def recorded_pitches_um(self) -> dict[str, tuple[float, float]]:
        """Pitch (y, x) of the scans, references too, as their reader recorded it."""
        pitches = {}
        for row in self.manifest.get("files", []):
            pitch = json.loads(row["read"] or "{}").get("pitch_um")
            if pitch:
                pitches[row["scan"]] = (float(pitch[0]), float(pitch[1]))
        return pitches

    @cached_property
    def manifest(self) -> dict[str, Any]:
        """Card, build record and one row per raw file; empty for a store that was not built from a card."""
        if not has_child(self.root, "manifest"):
            return {}
        group = group_of(self.root, "manifest")
        return {**dict(group.attrs), "files": read_table(group, "path").to_dict("records")}

    @cached_property
    def quality(self) -> pd.DataFrame:
        """One row per scan: registration, levelling and noise figures; only the ids if none are stored."""
        import pandas as pd

        if not has_child(self.root, "quality"):
            return pd.DataFrame({"scan": self.ids})
        return read_table(group_of(self.root, "quality"), "scan")

    @cached_property
    def sha256(self) -> str:
        """Hash of the dataset, independent of chunking: the stored one, else computed from the arrays."""
        stored = self.root.attrs.get("dataset_sha256")
        return str(stored) if stored else self.computed_sha256()

    @property
    def dataset_id(self) -> DatasetId:
        """Name and hash, for the results that are made from this dataset."""
        return DatasetId(name=self.name, sha256=self.sha256)

    def computed_sha256(self) -> str:
        """Hash of the dataset from the arrays as they are now."""
        facts = {name: getattr(self, name) for name in ("pitch_um", "level_height_um", "levels")}
        if self.write:
            facts["write"] = self.write
        return dataset_sha256(facts, [self._identity(row) for row in range(len(self))])

    def _identity(self, row: int) -> dict[str, Any]:
        identity: dict[str, Any] = {
            "id": self.ids[row],
            "print": self._print_ids[row],
            "order": self._order[row],
        }
        for name in OPTIONAL_COLUMNS:
            value = self._column(name, row)
            if value is not None:
                identity[name] = value
        hashes = {v.name: v.sample_sha256(self.sample(v.name, row)) for v in SAMPLE_VARIABLES}
        bend_um = self._bend_um(row)
        if bend_um is not None:
            hashes["bend_um"] = VARIABLES["bend_um"].sample_sha256(bend_um.amount)
        return {**identity, "arrays": hashes}

    def _bend_um(self, row: int) -> Bend | None:
        """The bend of a scan in its own frame; None if none is stored."""
        scan_id = self.ids[row]
        if not has_child(self.root, f"scans/{scan_id}/bend_um"):
            return None
        one = self.quality.iloc[row]
        shape = int(one["scan_ny"]), int(one["scan_nx"])
        pitch_um = float(one["scan_pitch_y_um"]), float(one["scan_pitch_x_um"])
        return Bend.of_scan(self.scan_frame(scan_id, "bend_um"), shape, pitch_um)

    def _tip_radius_um(self, row: int) -> float | None:
        if "tip_radius_um" not in self.quality:
            return None
        value = float(self.quality["tip_radius_um"].iloc[row])
        return None if math.isnan(value) else value

    def _column(self, name: str, row: int) -> float | None:
        value = float(self._columns[name][row]) if name in self._columns else math.nan
        return None if math.isnan(value) else value
