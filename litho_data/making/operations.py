"""Define the operations that make a dataset from raw files. An operation is a pure function of its recorded
parameters and inputs.

A build runs these operations, and ``replay`` repeats them from the records in the store. No other code makes
the arrays of a store.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from litho_data.foundation import Array, Facts, InputError
from litho_data.making.step import Files, Function, Inputs, Made, Operation, Params

if TYPE_CHECKING:
    from litho_data.register import Registration

UNREGISTERED = "registration failed"
_PLANE = {"step": [{"op": "layout-aware"}]}
# Pixels whose aspect ratio differs from 1 by more than this count as oblong. Micrographs with such pixels are
# refused. If the registration of a scan with such pixels fails, the message asks whether rows are missing.
_OBLONG = 0.01


OPERATIONS: dict[str, Operation] = {}
READERS = ("read-scan", "read-micrograph")
"""The names of the operations that read the microscope's files."""
READER_SHA256 = "reader_sha256"
"""The name of the parameter that contains the source hash of a user's own reader. The operation ignores the
hash. It only gives steps with different readers different ids.
"""


def _operation(name: str, takes: str, *code: str) -> Callable[[Function], Function]:
    """Return a decorator that adds a function to ``OPERATIONS``.

    Args:
        name: name of the operation.
        takes: names of the arrays that the operation takes, separated by blanks.
        code: the source files and folders, apart from this file, on which the result depends.
    """

    def made(function: Function) -> Function:
        OPERATIONS[name] = Operation(
            name, "1", function, tuple(takes.split()), (*code, "making/operations.py")
        )
        return function

    return made


def load_recipe(path: Path | None) -> dict[str, Any]:
    """Read a levelling recipe from a file, and return it in canonical form.

    Without a file, return a recipe that subtracts a plane. The plane is fitted together with the layout, so
    that the slope of the print is kept.
    """
    from litho_data.level import Recipe

    return (Recipe.from_dict(_PLANE) if path is None else Recipe.from_toml(path)).canonical()


def no_recipe() -> dict[str, Any]:
    """Return a levelling recipe without steps, which leaves the heights unchanged."""
    from litho_data.level import Recipe

    return Recipe().canonical()


@_operation("read-layout", "", "readers")
def _read_layout(params: Params, files: Files, _: Inputs) -> Made:
    from litho_data.readers import read_layout

    stated = {name: params[name] for name in ("grey_per_level", "average_px") if name in params}
    level = read_layout(files[0], levels=params["levels"], **stated)
    if level.max() >= params["levels"]:
        wanted = f"at most {params['levels'] - 1}, because the card says levels = {params['levels']}"
        raise InputError(f"layout {files[0]}: highest level", got=int(level.max()), wanted=wanted)
    return {"mask_level": np.pad(level, params.get("bare_px", 0))}, {}


@_operation("read-scan", "", "readers", "scan.py", "foundation/units.py")
def _read_scan(params: Params, files: Files, _: Inputs) -> Made:
    from litho_data.readers import read_scan

    size = params["size_um"]
    stated = {name: value for name, value in params.items() if name != READER_SHA256}
    scan = read_scan(files[0], **{**stated, "size_um": tuple(size) if size else None})
    arrays = {"raw_height_um": scan.height_um.astype(np.float32)}
    if scan.mask is not None:
        arrays["vendor_mask"] = scan.mask
    notes = {"notes": list(scan.notes)} if scan.notes else {}
    return arrays, {
        **notes,
        "pitch_um": list(scan.require_pitch()),
        "sized_by_file": scan.sized_by_file,
        "reader": scan.format,
        "unit": scan.unit,
        "channel": scan.channel,
        "fast_axis": scan.fast_axis,
        "header": scan.header,
    }


@_operation("read-micrograph", "", "readers")
def _read_micrograph(params: Params, files: Files, _: Inputs) -> Made:
    from litho_data.readers.picture import read_picture

    grey = read_picture(files[0], "micrograph")
    if grey.dtype.kind != "u" or grey.dtype.itemsize > 2:
        raise InputError(f"micrograph {files[0]}", got=str(grey.dtype), wanted="grey values of 8 or 16 bits")
    pitch_um = [size / length for size, length in zip(params["size_um"], grey.shape, strict=True)]
    if abs(pitch_um[0] / pitch_um[1] - 1) > _OBLONG:
        # Distances from edges are measured in pixels.
        raise InputError(
            f"micrograph {files[0]}",
            got=f"pixels of {pitch_um[0]:.4g} × {pitch_um[1]:.4g} µm (y × x)",
            wanted=f"square pixels, so a size_um in the ratio of {grey.shape[0]} to {grey.shape[1]} pixels",
        )
    facts = {"pitch_um": pitch_um, "sized_by_file": False, "reader": "picture", "unit": "", "channel": ""}
    return {"micrograph": grey.astype(np.uint16)}, {**facts, "fast_axis": None, "header": {}}


@_operation("find-edges", "micrograph", "making/contour.py")
def _find_edges(params: Params, _: Files, arrays: Inputs) -> Made:
    """Find the edges of the film, and make a height map from them. Another operation registers this map."""
    from litho_data.making.contour import REACH_PX, coverage, find_edges

    edges = find_edges(arrays["micrograph"], params.get("reach_px", REACH_PX))
    pitch_um = float(np.mean(params["scan_pitch_um"]))
    height = params["film_um"] * coverage(edges.distance_px, 1.0)
    found = {"edge_distance_um": edges.distance_px * pitch_um, "levelled_height_um": height}
    facts = {"edge_sigma_nm": 1e3 * edges.sigma_px * pitch_um, "speck_px": int(edges.specks.sum())}
    return {name: array.astype(np.float32) for name, array in found.items()}, facts


@_operation(
    "cover", "mask_level edge_distance_um scan_to_layout bend_um defect", "register", "making/contour.py"
)
def _cover(params: Params, _: Files, arrays: Inputs) -> Made:
    """Compute the height map of the film on the layout's grid, and its uncertainty.

    The height of a pixel is the thickness of the film times the share of the pixel's area that is covered by
    film. Pixels with dirt or pits are invalid.
    """
    from litho_data.making.contour import coverage, edge_shift_px, foreign, with_moved_edges
    from litho_data.register.refine import interior_of

    distance, valid = _on_layout(arrays["edge_distance_um"], params, arrays)
    level, pitch_um, film_um = arrays["mask_level"], params["layout_pitch_um"], params["film_um"]
    valid &= interior_of(valid.shape, params["edge_px"])
    if "defect" in arrays:
        valid &= ~arrays["defect"]
    covered = coverage(np.where(valid, distance, np.nan), pitch_um)
    dirt = foreign(covered, level / params["full_level"], params["dirt_px"])
    if shift_px := edge_shift_px(level, np.where(valid, distance / pitch_um, np.nan)):
        # If the edges of the film are shifted by more than `dirt_px`, a comparison with the layout marks
        # whole edges as dirt. Pixels therefore count as dirt only if a comparison with the shifted layout
        # marks them too.
        moved = with_moved_edges(level, shift_px) / params["full_level"]
        dirt &= foreign(covered, moved, params["dirt_px"])
    valid &= ~dirt
    sigma_um = params["edge_sigma_um"]
    above, below = (coverage(distance + shift, pitch_um) for shift in (sigma_um, -sigma_um))
    maps = {"height_um": film_um * covered, "height_sigma_um": film_um * (above - below) / 2}
    made = {name: np.where(valid, one, np.nan).astype(np.float32) for name, one in maps.items()}
    return {**made, "valid": valid}, {"dirt_share": float(dirt.mean())}


@_operation("calibrate", "", "readers", "roughness", "making/calibration.py")
def _calibrate(params: Params, files: Files, _: Inputs) -> Made:
    """Measure the scales of the microscope in scans of standards of known size."""
    from litho_data.making.calibration import SCALES, measure_scales

    found = measure_scales(params["standards"], files)
    return {"calibration": found}, {
        f"scale_{scale}{ending}": value
        for scale, pair in zip(SCALES, found.tolist(), strict=True)
        for ending, value in zip(("", "_uncertainty"), pair, strict=True)
    }


def _z_scale(arrays: Mapping[str, Array]) -> tuple[float, float]:
    """Return the calibrated scale factor of the heights and its relative uncertainty. Without a calibration,
    the factor is 1 and the uncertainty is 0.
    """
    if "calibration" not in arrays:
        return 1.0, 0.0
    factor, uncertainty = arrays["calibration"][2].tolist()
    return factor, uncertainty / factor


@_operation("locate", "mask_level raw_height_um", "register", "level")
def _locate(params: Params, _: Files, arrays: Inputs) -> Made:
    """Find the layout's levels at the pixels of the raw scan. Layout-aware levelling needs these levels.

    The levels are NaN outside the layout. They are also NaN at defects, so that no background is fitted to
    dust.
    """
    from litho_data.level import layout_in_scan_frame

    raw, layout = arrays["raw_height_um"], arrays["mask_level"]
    found = _registration(raw, layout, params)
    _require_found(found, params, " before levelling")
    if found.defects is not None:
        layout = np.where(found.defects, np.nan, layout)
    shape, pitch_um = raw.shape, tuple(params["scan_pitch_um"])
    level = layout_in_scan_frame(
        layout, found.scan_to_layout, shape, pitch_um, params["layout_pitch_um"], found.bend_um
    )
    return {"layout_in_scan": level.astype(np.float32)}, {}


@_operation("level", "raw_height_um vendor_mask calibration layout_in_scan", "register", "level")
def _level(params: Params, _: Files, arrays: Inputs) -> Made:
    from litho_data.level import Recipe

    levelled, notes = Recipe.from_dict(params["recipe"]).apply_noting(
        arrays["raw_height_um"].astype(float) * _z_scale(arrays)[0],
        pitch_um=tuple(params["scan_pitch_um"]),
        mask=arrays.get("vendor_mask"),
        layout_level=arrays.get("layout_in_scan"),
    )
    named = {"levelled_height_um": levelled.height, "removed_um": levelled.removed}
    return {name: array.astype(np.float32) for name, array in named.items()}, {
        "notes": notes
    } if notes else {}


@_operation("register", "mask_level levelled_height_um edge_distance_um", "register", "making/contour.py")
def _register(params: Params, _: Files, arrays: Inputs) -> Made:
    from litho_data.making.contour import edge_shift_px, with_moved_edges

    height, level = arrays["levelled_height_um"], arrays["mask_level"]
    found = _registration(height, level, params)
    _require_found(found, params)
    arrays_found, figures = _as_arrays(found), asdict(found.quality)
    if "edge_distance_um" in arrays:
        grid = {**params, "layout_shape": level.shape}
        distance_um, seen = _on_layout(arrays["edge_distance_um"], grid, arrays_found)
        distance_px = np.where(seen, distance_um / params["layout_pitch_um"], np.nan)
        if shift_px := edge_shift_px(level, distance_px):
            moved = _registration(height, with_moved_edges(level, shift_px), params)
            if moved.quality.passed:
                found, arrays_found, figures = moved, _as_arrays(moved), asdict(moved.quality)
                side = "outside" if shift_px > 0 else "inside"
                said = (
                    f"the edges lie {abs(shift_px):.1f} px {side} those of the layout, which were moved there"
                )
                figures["warning"] = "; ".join(filter(None, (figures["warning"], said)))
    if found.bend_um is not None:
        figures |= found.bend_um.figures
    return arrays_found, figures


def _as_arrays(found: Registration) -> dict[str, Array]:
    """Return the arrays of a registration, keyed by their names in the store. They are the matrix and, if
    present, the bend and the mask of defects.
    """
    made = {"scan_to_layout": found.scan_to_layout}
    if found.bend_um is not None:
        made["bend_um"] = found.bend_um.amount
    if found.defects is not None:
        made["defect"] = found.defects
    return made


def _require_found(found: Registration, params: Params, when: str = "") -> None:
    if not found.quality.passed:
        pitch_y_um, pitch_x_um = params["scan_pitch_um"]
        oblong = abs(pitch_y_um / pitch_x_um - 1) > _OBLONG
        pixels = f"the pixels are {pitch_y_um:.4g} × {pitch_x_um:.4g} µm (y × x): are rows missing?"
        raise InputError(f"{UNREGISTERED}{when}: {found.quality.reason}", hint=pixels if oblong else "")


def _registration(height_um: Array, layout_level: Array, params: Facts) -> Registration:
    from litho_data.register import register_scan

    return register_scan(
        height_um.astype(float),
        layout_level,
        scan_pitch_um=tuple(params["scan_pitch_um"]),
        layout_pitch_um=params["layout_pitch_um"],
        model=params["model"],
        fast_axis=params.get("fast_axis"),
        seed=params["seed"],
    )


@_operation("tip", "levelled_height_um", "tip", "register/topography.py", "roughness")
def _tip(params: Params, _: Files, arrays: Inputs) -> Made:
    from litho_data.tip import lateral_resolution_um, tip_certain

    height, pitch_um = arrays["levelled_height_um"].astype(float), tuple(params["scan_pitch_um"])
    radius_um = params["radius_um"]
    certain = tip_certain(height, pitch_um, radius_um)
    facts = {
        "tip_radius_um": radius_um,
        "tip_certain_fraction": float(certain.mean()),
        "tip_resolution_um": lateral_resolution_um(height, pitch_um, radius_um) or 0.0,
    }
    return {"tip_certain": certain}, facts


@_operation("resample", "levelled_height_um scan_to_layout bend_um defect tip_certain", "register")
def _resample(params: Params, _: Files, arrays: Inputs) -> Made:
    from litho_data.register.refine import interior_of

    height, valid = _on_layout(arrays["levelled_height_um"], params, arrays)
    if "defect" in arrays:
        valid &= ~arrays["defect"]
    if "tip_certain" in arrays:
        valid &= _on_layout(arrays["tip_certain"], params, arrays)[0] > 0.5
    valid &= interior_of(valid.shape, params.get("edge_px", 0))
    return {"height_um": np.where(valid, height, np.float32(np.nan)), "valid": valid}, {}


def _on_layout(scan_map: Array, params: Params, arrays: Inputs) -> tuple[Array, Array]:
    """Resample a map from the scan's frame onto the layout's pixels. Return the resampled map, and a bool
    mask of the pixels where it is valid.
    """
    from litho_data.register import Bend, resample_to_layout

    pitch_um = tuple(params["scan_pitch_um"])
    bend = Bend.of_scan(arrays["bend_um"], scan_map.shape, pitch_um) if "bend_um" in arrays else None
    return resample_to_layout(
        scan_map.astype(float),
        arrays["scan_to_layout"],
        tuple(params["layout_shape"]),
        scan_pitch_um=pitch_um,
        layout_pitch_um=params["layout_pitch_um"],
        bend_um=bend,
    )


@_operation(
    "uncertainty",
    "levelled_height_um height_um mask_level calibration",
    "register",
    "roughness",
    "making/height_sigma.py",
)
def _uncertainty(params: Params, _: Files, arrays: Inputs) -> Made:
    from litho_data.making.height_sigma import height_sigma

    sigma_um, budget = height_sigma(
        arrays["levelled_height_um"],
        arrays["height_um"],
        arrays["mask_level"],
        scan_pitch_um=tuple(params["scan_pitch_um"]),
        layout_pitch_um=params["layout_pitch_um"],
        blur_px=params["blur_um"] / params["layout_pitch_um"],
        model=params["model"],
        levelled=params["levelled"],
        fast_axis=params["fast_axis"],
        z_uncertainty=_z_scale(arrays)[1],
    )
    return {"height_sigma_um": sigma_um}, dict(budget)


@_operation("stitch-pairs", "", "readers")
def _stitch_pairs(params: Params, files: Files, _: Inputs) -> Made:
    from litho_data.readers.pairs import stitch_field

    return stitch_field(files, params["quadrants"], params["full_scale_um"], params["levels"]), {}
