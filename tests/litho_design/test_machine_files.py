"""Check a lens and a hologram in every format with parsers that share no code with the package."""

from __future__ import annotations

import json

import gdstk
import numpy as np
import pytest
import tifffile
from PIL import Image

from litho_design import design_hologram, design_lens, export, hologram_settings, lens_settings

PITCH_UM, PEDESTAL_UM = 0.1, 0.3


def png16(file, sidecar):
    grey = np.asarray(Image.open(file), float)
    return grey / (2**16 - 1) * sidecar["white_height_um"]


def bmp(file, sidecar):
    grey, height_um = np.loadtxt(file.with_suffix(".csv"), delimiter=",", skiprows=1, unpack=True)
    return height_um[np.searchsorted(grey, np.asarray(Image.open(file)))]


def tiff(file, sidecar):
    return tifffile.imread(file, key=1)


def gds(file, sidecar):
    (top,) = gdstk.read_gds(file).top_level()
    found = np.zeros(sidecar["shape_px"])
    for polygon in top.get_polygons():
        (x0, y0), (x1, y1) = np.rint(np.array(polygon.bounding_box()) / PITCH_UM).astype(int)
        # Layers are cumulative, so each raises what it covers by one level.
        found[len(found) - y1 : len(found) - y0, x0:x1] += sidecar["level_height_um"]
    return found


def dxf(file, sidecar):
    words = file.read_text().split()
    height_um = dict(zip(sidecar["greys"], sidecar["nominal_height_um"], strict=True))
    found = np.zeros(sidecar["shape_px"])
    corners = {"10": [], "20": []}
    for code, word in zip(words[::2], words[1::2], strict=True):
        if (code, word) == ("0", "POLYLINE"):
            corners = {"10": [], "20": []}
        elif code in corners:
            corners[code].append(round(float(word) / PITCH_UM))
        elif code == "8":
            layer = int(word)
        elif (code, word) == ("0", "SEQEND"):
            # The polyline entity itself has a point at (0, 0).
            x, y = corners["10"][1:], corners["20"][1:]
            found[len(found) - max(y) : len(found) - min(y), min(x) : max(x)] = height_um[layer]
    return found


def stl(file, sidecar):
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    triangles = np.frombuffer(file.read_bytes()[84:], record)
    tops = triangles["corners"][triangles["normal"][:, 2] > 0.99]
    cell = sidecar["cell_px"]
    found = np.zeros(np.array(sidecar["shape_px"]) // cell)
    x, y, z = tops.mean(1).T
    row, column = ((one / (cell * PITCH_UM)).astype(int) for one in (y, x))
    found[len(found) - 1 - row, column] = z - PEDESTAL_UM
    return found.repeat(cell, 0).repeat(cell, 1)


def gwl(file, sidecar):
    stage, points = {"X": 0.0, "Y": 0.0}, []
    height_um = np.zeros(sidecar["shape_px"])
    for line in file.read_text().splitlines():
        if line.startswith("MoveStage"):
            stage[line[9]] += float(line.split()[1])
        elif line == "Write":
            (x0, y, _), (x1, _, _) = points
            begin, end = (round((x + stage["X"]) / PITCH_UM) for x in (x0, x1))
            row = len(height_um) - 1 - int((y + stage["Y"]) / PITCH_UM)
            height_um[row, begin:end] += sidecar["slicing_um"]
            points = []
        elif line[0] in "-0123456789":
            points.append(tuple(map(float, line.split())))
    return height_um - PEDESTAL_UM


@pytest.fixture(scope="module", params=["hologram", "lens"])
def design(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    small = {"search.iterations": 2, "search.polish_rounds": 0, "window.yield_draws": 2}
    if request.param == "hologram":
        changes = small | {"layout.size_px": 64, "optics.distance_um": 20.0}
        design_hologram("ring", "none", folder, settings=hologram_settings(changes=changes), announce=False)
    else:
        changes = small | {"layout.size_px": 64, "optics.distance_um": 25.0, "view.window_px": 32}
        design_lens("none", folder, settings=lens_settings(changes=changes), announce=False)
    return folder


@pytest.mark.parametrize("read", [png16, bmp, tiff, gds, dxf, stl, gwl], ids=lambda read: read.__name__)
def test_other_parsers_find_the_heights_of_the_layout(tmp_path, design, read):
    file = export(design, read.__name__, tmp_path, pedestal_um=PEDESTAL_UM)
    sidecar = json.loads(file.with_name(f"{file.name}.json").read_text())
    wanted = 0.1 * np.load(design / "layout_level.npy")
    assert wanted.max() > 1
    # Heights in STL and TIFF are float32.
    assert np.abs(read(file, sidecar) - wanted).max() < 1e-6
