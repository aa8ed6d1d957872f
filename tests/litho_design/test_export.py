"""Check that files of every format can be read back with the same levels, size and orientation."""

from __future__ import annotations

import json
import struct
import tracemalloc

import cv2
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from litho_data.foundation.errors import InputError
from litho_data.readers import read_layout
from litho_data.readers.exported import TiffRows, read_stl_levels, read_stl_triangles
from litho_data.readers.gds_rows import GdsRows
from litho_design.elements.element import Element
from litho_design.exports import marks
from litho_design.exports.files import export as export_design
from litho_design.exports.files import import_levels
from litho_design.exports.gds import rectangles, write_gds
from litho_design.exports.image import linear_greys, write_image, write_tiff
from litho_design.exports.job import Gwl
from litho_design.exports.sidecar import sidecar_path
from litho_design.exports.stl import write_stl
from litho_design.images.targets import load_target
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.source import load_printer
from litho_design.printers.training import out_of_distribution
from litho_design.tasks.design import Design
from litho_design.workflows.design import design_hologram
from tests.litho_design.conftest import unreported

POWERS = tuple(range(50, 63))
FORMATS = ["png16", "bmp", "tiff", "stl", "gds", "dxf", "gwl"]
# An "F" has no symmetry, so any flip or rotation is noticed.
LETTER = np.array([[1, 1, 1, 1], [1, 0, 0, 0], [1, 1, 1, 0], [1, 0, 0, 0], [1, 0, 0, 0]], np.uint8)


@pytest.fixture(scope="module")
def design(tmp_path_factory):
    from litho_design.holograms.settings import hologram_settings
    from litho_design.optics import Optics
    from litho_design.printers.printer import Printer

    default = hologram_settings("default")
    layout = LayoutSettings(size_px=64)
    search = default.search.model_copy(update={"iterations": 3, "polish_rounds": 0})
    settings = default.model_copy(
        update={"layout": layout, "optics": Optics(distance_um=20.0), "search": search}
    )
    folder = tmp_path_factory.mktemp("design")
    printer = Printer(None, layout, source="none")
    with unreported():
        design_hologram(load_target("ring", 64), printer, folder, settings=settings, announce=False)
    return folder


@pytest.mark.parametrize("kind", FORMATS)
def test_round_trip_is_exact_and_has_its_size(tmp_path, design, kind):
    file = export_design(design, kind, tmp_path / kind)
    levels, sidecar = import_levels(file)
    assert np.array_equal(levels, np.load(design / "layout_level.npy"))
    assert sidecar.size_um == pytest.approx((6.4, 6.4), abs=1e-9)
    assert sidecar.nominal_height_um[-1] == pytest.approx(1.2)
    assert sidecar.layout_sha256 == Design.read(design).files["layout_level.npy"]
    raw = json.loads(sidecar_path(file).read_text())
    assert {"settings", "stroke", "polarity"} <= raw.keys()
    assert np.array_equal(read_layout(file, levels=13), levels)


def test_every_export_can_be_read_as_a_layout_for_a_model(tmp_path):
    """Check that a model predicts an exported element as a design does, i.e. alone on the substrate, and that
    it refuses an element with another pitch or level height.
    """
    from litho_models.frozen.files import load_frozen
    from litho_models.frozen.on_store import predict_file

    model = load_frozen("zoo:physics")
    levels = np.kron(LETTER * 12, np.ones((4, 4), np.uint8))
    printer = load_printer("zoo:physics", LayoutSettings())
    wanted = printer(torch.from_numpy(levels)[None, None].float())[0, 0].numpy()
    for kind in FORMATS:
        file = export_design(levels, kind, tmp_path / kind)
        height, surround = predict_file(model, file, tmp_path / f"{kind}.gsf")
        np.testing.assert_allclose(height, wanted, rtol=0, atol=1e-6)
        assert surround == "surrounded by level 0"
    # Without a sidecar, the layout continues, so a uniform layout has no edge. An exported one has.
    flat = np.full((40, 40), 12, np.uint8)
    np.save(tmp_path / "flat.npy", flat)
    height, surround = predict_file(model, tmp_path / "flat.npy", tmp_path / "print.npy")
    assert np.ptp(height) < 1e-5
    assert surround == "continued by its outermost levels"
    alone = predict_file(model, export_design(flat, "gds", tmp_path / "flat"), tmp_path / "print.npy")[0]
    assert np.ptp(alone) > 0.1
    for name in ("pitch_um", "level_height_um"):
        file = export_design(levels, "gds", tmp_path / name, **{name: 0.05})
        with pytest.raises(InputError, match=name):
            predict_file(model, file, tmp_path / "x.npy")


@pytest.mark.parametrize(("suffix", "step"), [(".png", 65535 // 12), (".bmp", 255 // 12)])
def test_images_are_upright_for_another_reader(tmp_path, suffix, step):
    greys = linear_greys(LayoutSettings(), 16 if suffix == ".png" else 8)
    write_image(tmp_path / f"f{suffix}", LETTER * 7, greys, 0.1)
    grey = cv2.imread(str(tmp_path / f"f{suffix}"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(grey, LETTER.astype(int) * 7 * step)


def test_tiff_is_upright_and_has_its_size_for_another_reader(tmp_path):
    levels = np.kron(LETTER * 7, np.ones((40, 40), np.uint8))
    write_tiff(tmp_path / "f.tif", levels, 0.13, 0.1)
    with tifffile.TiffFile(tmp_path / "f.tif") as file:
        pages = [page.asarray() for page in file.pages]
        per_cm = [file.pages[0].tags[name].value for name in ("XResolution", "YResolution")]
        assert file.pages[0].tags["ResolutionUnit"].value == tifffile.RESUNIT.CENTIMETER
    assert np.array_equal(pages[0], levels)
    np.testing.assert_allclose(pages[1], levels * 0.1, rtol=1e-6)
    # The tolerance is 1e-9 m over the whole side.
    for pixels, (count, centimetres) in zip((160, 200), per_cm, strict=True):
        assert pixels * 0.01 * centimetres / count == pytest.approx(pixels * 0.13e-6, abs=1e-9)


@pytest.mark.parametrize("layers", ["cumulative", "exclusive"])
def test_gds_is_upright_and_has_its_size_for_another_reader(tmp_path, layers):
    gdstk = pytest.importorskip("gdstk")
    write_gds(tmp_path / "f.gds", LETTER * 2, 0.13, layers)
    library = gdstk.read_gds(tmp_path / "f.gds")
    (cell,) = library.top_level()
    # The F touches all four sides. With ``exclusive``, level 0 fills the rest.
    corners = np.array(cell.bounding_box()) * library.unit
    assert corners == pytest.approx(np.array([[0, 0], [4 * 0.13e-6, 5 * 0.13e-6]]), abs=1e-9)
    assert (library.unit, library.precision) == pytest.approx((1e-6, 1e-9), rel=1e-15)
    centres = [((x + 0.5) * 0.13, (4.5 - y) * 0.13) for y in range(5) for x in range(4)]
    highest = [polygon for polygon in cell.get_polygons() if polygon.layer == 2]
    assert np.array_equal(np.reshape(gdstk.inside(centres, highest), (5, 4)), LETTER > 0)


@pytest.mark.parametrize("kind", ["png16", "bmp"])
def test_a_changed_file_and_one_without_sidecar_are_refused(tmp_path, design, kind):
    file = export_design(design, kind, tmp_path / kind)
    with open(file, "ab") as stream:
        stream.write(b"x")
    with pytest.raises(InputError, match="content that changed after the export"):
        import_levels(file)
    sidecar_path(file).unlink()
    with pytest.raises(InputError, match="cannot read"):
        import_levels(file)


@pytest.mark.parametrize("job", [{"slicing_um": -0.1}, {"hatching_um": 0.0}, {"pedestal_um": float("nan")}])
def test_job_settings_that_no_printer_has_are_refused(tmp_path, design, job):
    with pytest.raises(InputError, match=next(iter(job))):
        export_design(design, "png16", tmp_path / "out", **job)


def test_a_solid_without_a_base_is_refused_before_anything_is_written(tmp_path, design):
    with pytest.raises(InputError, match="pedestal_um"):
        export_design(design, "stl", tmp_path / "out", pedestal_um=0.0)
    assert not (tmp_path / "out").exists()
    assert (
        import_levels(export_design(design, "png16", tmp_path / "out", pedestal_um=0.0))[1].pedestal_um == 0
    )


def test_exports_in_other_formats_stay(tmp_path, design):
    first = export_design(design, "png16", tmp_path / "out")
    second = export_design(design, "stl", tmp_path / "out")
    again = export_design(design, "png16", tmp_path / "out")
    levels = np.load(design / "layout_level.npy")
    assert all(np.array_equal(import_levels(file)[0], levels) for file in (first, second, again))
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["layout.png", "layout.png.json", "layout.stl", "layout.stl.json"]
    # A print job must not mix two layouts, and the sidecar of the other format names another layout.
    sidecar = sidecar_path(second)
    sidecar.write_text(sidecar.read_text().replace(import_levels(first)[1].layout_sha256, "0" * 64))
    with pytest.raises(InputError, match=r"layout\.stl\.json, an export of another layout"):
        export_design(design, "png16", tmp_path / "out")


def test_grey_is_linear_in_height(tmp_path, design):
    file = export_design(design, "bmp", tmp_path / "bmp")
    grey = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    levels = np.load(design / "layout_level.npy")
    assert np.array_equal(grey, levels * 21)  # 255 // 12
    table = np.loadtxt(file.with_suffix(".csv"), delimiter=",", skiprows=1)
    assert table[12] == pytest.approx((252, 1.2))


def test_stl_is_closed_upright_and_has_the_volume_of_its_columns(tmp_path):
    levels = np.kron(LETTER * 3, np.ones((2, 2), np.uint8)) + np.arange(8, dtype=np.uint8) % 3
    write_stl(tmp_path / "f.stl", levels, 0.4, 0.1, 1.0)
    triangles = read_stl_triangles(tmp_path / "f.stl").astype(np.float64)
    # Where two columns touch only along an edge, one corner is displaced by 1/128 of a cell.
    assert _volume(triangles) == pytest.approx((1.0 + 0.1 * levels).sum() * 0.16, rel=1e-4)
    # The solid has 8 x 10 cells of 0.4 µm, exact to 1e-9 m.
    assert triangles.reshape(-1, 3).min(0) == pytest.approx((0, 0, 0), abs=1e-3)
    assert triangles.reshape(-1, 3).max(0)[:2] == pytest.approx((3.2, 4.0), abs=1e-3)
    # Row 0 is at the top, so the bar of the F is at high y.
    high = triangles[triangles[:, :, 2].min(1) > 1.25]
    assert high[..., 1].max() == pytest.approx(4.0)
    with pytest.raises(InputError, match="pedestal"):
        write_stl(tmp_path / "g.stl", levels, 0.4, 0.1, 0.0)


def test_stl_has_few_triangles(tmp_path):
    def triangles(levels):
        return write_stl(tmp_path / "f.stl", np.array(levels, np.uint8), 0.4, 0.1, 1.0)

    # Each cell has two triangles for its top and for each wall, and one underneath along the rim.
    # Another triangle is needed where the side of a step meets the top of the step below.
    for steps in (1, 2, 7):
        tops, walls, rim = 5 * steps, 5 * (steps - 1), 2 * (5 + steps)
        assert triangles([range(steps)] * 5) == 2 * tops + 2 * walls + 3 * rim + 2 * (steps - 1)
    assert triangles(np.pad([[1]], 1)) == 2 * 9 + 2 * 4 + 3 * 12


@pytest.mark.parametrize("seed", range(20))
def test_stl_is_watertight_where_columns_touch_at_corners(tmp_path, seed):
    """Check random layouts with two parsers that share no code with the writer."""
    generator = np.random.default_rng(seed)
    levels = generator.integers(0, 2 + seed % 12, generator.integers(1, 14, 2)).astype(np.uint8)
    file = tmp_path / "random.stl"
    count = write_stl(file, levels, 0.4, 0.1, 1.0)
    for corners in (_by_struct(file), _by_cells_of_bytes(file)):
        assert len(corners) == count
        _require_closed(corners)
    # A corner displaced by 1/128 removes a pyramid of 1/128 of a cell from its column.
    most = levels.size * 0.16 * 0.1 * levels.max() / 3 / 128
    assert _volume(np.array(corners)) == pytest.approx((1.0 + 0.1 * levels).sum() * 0.16, abs=most + 1e-6)
    assert np.array_equal(read_stl_levels(file, levels.shape, 0.4, 0.1, 1.0), levels)


def _require_closed(corners) -> None:
    """Check that the triangles form one closed surface that faces outwards."""
    points, places = np.unique(np.reshape(corners, (-1, 3)), axis=0, return_inverse=True)
    faces = places.reshape(-1, 3)
    ends = np.roll(faces, -1, axis=1)
    there, back = np.sort(faces * len(points) + ends, None), np.sort(ends * len(points) + faces, None)
    # Every edge occurs once in each direction.
    assert np.array_equal(there, back)
    assert (np.diff(there) > 0).all()
    # This is Euler's formula.
    assert len(points) - len(there) // 2 + len(faces) == 2


def _volume(triangles: np.ndarray) -> float:
    """Return the volume of a closed surface, by the divergence theorem."""
    return np.einsum("ij,ij->i", triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])).sum() / 6


def _by_struct(file) -> list:
    data = file.read_bytes()
    (count,) = struct.unpack_from("<I", data, 80)
    found = list(struct.iter_unpack("<12fH", data[84:]))
    assert len(found) == count
    return [tuple(one[first : first + 3] for first in (3, 6, 9)) for one in found]


def _by_cells_of_bytes(file) -> list:
    raw = np.fromfile(file, np.uint8)[84:].reshape(-1, 50)
    corners = np.ascontiguousarray(raw[:, 12:48]).view("<f4").reshape(-1, 3, 3)
    return [tuple(map(tuple, face)) for face in corners.tolist()]


@pytest.mark.parametrize("layers", ["cumulative", "exclusive"])
def test_gds_layers_have_the_area_of_their_levels(tmp_path, design, layers):
    gdstk = pytest.importorskip("gdstk")
    file = export_design(design, "gds", tmp_path / "gds", gds_layers=layers)
    levels = np.load(design / "layout_level.npy")
    (cell,) = gdstk.read_gds(file).top_level()
    area = {}
    for polygon in cell.get_polygons():
        area[polygon.layer] = area.get(polygon.layer, 0) + polygon.area()
        assert len(polygon.points) == 4
    for layer, covered in area.items():
        mask = levels >= layer if layers == "cumulative" else levels == layer
        assert covered == pytest.approx(mask.sum() * 0.01, rel=1e-9)
    assert np.array_equal(import_levels(file)[0], levels)


def test_gds_blocks_that_are_equal_are_stored_once_and_read_by_another_parser(tmp_path):
    """Check a GDS file with an independent parser, which follows references and uses neither gdstk nor the
    writer.
    """
    tile = np.random.default_rng(0).integers(0, 4, (32, 32)).astype(np.uint8).repeat(4, 0).repeat(4, 1)
    levels = np.tile(tile, (3, 2))
    levels[300, 200] = 5
    assert write_gds(tmp_path / "f.gds", levels, 0.1, "exclusive") > 0
    cells = _gds_cells(tmp_path / "f.gds")
    # There are three rows of two blocks. Five of the six blocks are equal.
    rows = [name for name, _ in cells["ELEMENT"]["references"]]
    assert [len(cells[name]["references"]) for name in ("LAYOUT", *rows)] == [1, 2, 2, 2]
    assert len({name for row in rows for name, _ in cells[row]["references"]}) == 2
    seen = np.full(levels.shape, -1)

    def draw(name, x0, y0):
        for layer, corners in cells[name]["boundaries"]:
            (left, low), (right, high) = np.array(corners).min(0), np.array(corners).max(0)
            place = [round(edge / 100) for edge in (x0 + left, y0 + low, x0 + right, y0 + high)]
            block = seen[384 - place[3] : 384 - place[1], place[0] : place[2]]
            assert (block == -1).all(), "a place is drawn twice"
            block[...] = layer
        for other, (x, y) in cells[name]["references"]:
            draw(other, x0 + x, y0 + y)

    draw("LAYOUT", 0, 0)
    assert np.array_equal(seen, levels)


def test_a_bigtiff_is_written_in_strips_that_another_reader_knows(tmp_path, design, monkeypatch):
    """Use Pillow and libtiff to check a file that tifffile wrote."""
    monkeypatch.setattr("litho_design.exports.image._CLASSIC_BYTES", 0)
    levels = np.kron(LETTER * 7, np.ones((50, 50), np.uint8))
    write_tiff(tmp_path / "f.tif", levels, 0.13, 0.1)
    assert (tmp_path / "f.tif").read_bytes()[:4] == b"II" + struct.pack("<H", 43)
    with Image.open(tmp_path / "f.tif") as pages:
        assert np.array_equal(np.asarray(pages), levels)
        # Tag 282 holds the pixels per centimetre.
        assert float(pages.tag_v2[282]) == pytest.approx(1e4 / 0.13, rel=1e-6)
        pages.seek(1)
        assert np.asarray(pages) == pytest.approx(levels * 0.1)
    file = export_design(design, "tiff", tmp_path / "out", marks=False)
    assert np.array_equal(import_levels(file)[0], np.load(design / "layout_level.npy"))


class _Tall:
    """Provide random levels in rows of 512 px. Only the requested rows are in memory."""

    def __init__(self, height):
        self.shape = (height, 512)

    def __getitem__(self, rows):
        found = [
            np.random.default_rng(row).integers(0, 4, (1, 64)) for row in range(*rows.indices(self.shape[0]))
        ]
        return np.concatenate(found).astype(np.uint8).repeat(8, axis=1)


@pytest.mark.parametrize("kind", ["tiff", "gds"])
def test_memory_of_an_export_does_not_grow_with_its_rows(tmp_path, kind, monkeypatch):
    monkeypatch.setattr("litho_design.exports.image._CLASSIC_BYTES", 0)
    peaks, bands = [], 0
    for height in (128, 256, 768):
        levels, file = _Tall(height), tmp_path / f"{height}.{kind}"
        tracemalloc.start()
        if kind == "tiff":
            write_tiff(file, levels, 0.1, 0.1)
            back = TiffRows(file)
        else:
            write_gds(file, levels, 0.1, "cumulative")
            back = GdsRows(file, levels.shape, 0.1, "cumulative")
        for top in range(0, height, 128):
            assert np.array_equal(back[top : top + 128], levels[top : top + 128])
            bands += 1
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert bands == 1 + 2 + 6
    # The first export also loads modules. The growth is due to the names of 16 more blocks, below 1 kB each.
    # Keeping all levels would add 0.26 MB, and all rectangles (64 bytes for about 16 pixels) 1 MB.
    assert peaks[2] - peaks[1] < 2e5


def _gds_cells(file) -> dict[str, dict[str, list]]:
    """Return the boundaries (layer, corners) and the references (name, place) of each GDSII cell. Coordinates
    are in file units.
    """
    data, at, cells = file.read_bytes(), 0, {}
    while at < len(data):
        length, kind = struct.unpack_from(">HB", data, at)
        body, at = data[at + 4 : at + length], at + length
        if kind == 0x06:
            cell = cells.setdefault(body.rstrip(b"\0").decode(), {"boundaries": [], "references": []})
        elif kind == 0x0D:
            (layer,) = struct.unpack(">h", body)
        elif kind == 0x12:
            name = body.rstrip(b"\0").decode()
        elif kind in (0x08, 0x0A):
            what = "boundaries" if kind == 0x08 else "references"
        elif kind == 0x10:
            points = np.frombuffer(body, ">i4").reshape(-1, 2).tolist()
            cell[what].append((layer, points) if what == "boundaries" else (name, points[0]))
        elif kind == 0x04:
            break
    return cells


@pytest.mark.parametrize("kind", FORMATS)
def test_a_mark_and_a_witness_stand_beside_the_element(tmp_path, design, kind, monkeypatch):
    # Without a printer, the reach is zero. In 6.4 µm, an F with 0.8 µm strokes and a witness of 1.2 µm fit.
    monkeypatch.setattr(marks, "_STROKE_UM", 0.8)
    monkeypatch.setattr(marks, "_FLAT_UM", 1.2)
    file = export_design(design, kind, tmp_path, marks=True)
    levels, sidecar = import_levels(file)
    assert np.array_equal(levels, np.load(design / "layout_level.npy"))
    found = sidecar.marks
    assert sidecar.shape_px == (64, 64 + 8 + 4 * 8)
    assert found.witness_height_um == pytest.approx(1.2)
    if kind == "gds":
        assert {"ELEMENT", "ORIENTATION", "WITNESS"} <= _gds_cells(file).keys()
    if kind == "png16":
        whole = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) // (65535 // 12)
        parts = [whole[top:bottom, left:right] for top, bottom, left, right in found.parts().values()]
        assert np.array_equal(parts[0], levels)
        assert (parts[2] == 12).all()
        # Nothing else is printed, and the F has no symmetry.
        assert (whole > 0).sum() == sum((part > 0).sum() for part in parts)
        letter = np.pad(parts[1], ((0, 0), (0, 8)))
        turned = [np.rot90(side, turn) for side in (letter, letter.T) for turn in range(4)]
        assert sum(np.array_equal(letter, other) for other in turned) == 1


def test_marks_keep_a_distance_of_the_reach_of_the_printer():
    layout = LayoutSettings(size_px=512)
    levels = np.zeros((512, 512), np.uint8)
    canvas, found = marks.with_marks(levels, layout, 5.9, [0.1, 0.8])
    box = {name: np.array(part) for name, part in found.parts().items()}
    # The reach of 5.9 µm is 59 px, or 60 px in whole cells. This is the distance to the element, and from the
    # F to the witness.
    assert box["ORIENTATION"][2] - 512 == box["WITNESS"][2] - 512 == 60
    assert box["WITNESS"][0] - box["ORIENTATION"][1] >= 60
    # The middle 4 µm are farther than the reach from every edge.
    assert box["WITNESS"][1] - box["WITNESS"][0] >= 2 * 59 + 40
    assert all((edge % 4 == 0).all() for edge in box.values())
    assert canvas.shape[1] == box["WITNESS"][3]
    with pytest.raises(InputError, match="at least 28"):
        marks.with_marks(levels[:100, :100], layout, 5.9, [0.1, 0.8])


def test_rectangles_cover_once():
    masks = np.stack([LETTER > 0, LETTER == 0, LETTER < 0, np.random.default_rng(0).random((5, 4)) < 0.5])
    cover = np.zeros(masks.shape, int)
    for mask, top, bottom, left, right in rectangles(masks).tolist():
        cover[mask, top:bottom, left:right] += 1
    assert np.array_equal(cover, masks)
    # The rectangles are two bars, the stem between them, and the two rows of stem below, which are merged.
    assert len(rectangles(masks[:1])) == 4


@pytest.mark.parametrize(
    ("job", "hatching_um"),
    [
        (Gwl(), 0.1),
        (Gwl(mode="piezo"), 0.05),
        (Gwl(field_um=0.7), 0.1),
        (Gwl(power_percent=range(50, 63)), 0.1),
    ],
)
def test_gwl_writes_the_volume_of_the_layout_voxel_by_voxel(tmp_path, design, job, hatching_um):
    """Check a GWL file with a parser that follows the stage and paints lines into voxels."""
    asked = {"pedestal_um": 0.3, "hatching_um": hatching_um, "gwl": dict(job)}
    file = export_design(design, "gwl", tmp_path / "out", **asked)
    levels = np.load(design / "layout_level.npy")
    painted = np.zeros((15, 64, 64))
    stage, points, power, powers, mode = {"X": 0.0, "Y": 0.0}, [], None, {}, None
    for line in file.read_text().splitlines():
        if line.startswith("MoveStage"):
            stage[line[9]] += float(line.split()[1])
        elif line.startswith(("GalvoScanMode", "PiezoScanMode")):
            mode = line[:5].lower()
        elif line.startswith("LaserPower"):
            power = float(line.split()[1])
        elif line == "Write":
            (x0, y, z), (x1, y1, z1) = points
            assert (y, z) == (y1, z1)
            assert mode == "piezo" or max(abs(x0), abs(x1), abs(y)) <= job.field_um / 2
            begin, end = (round((x + stage["X"]) / 0.1) for x in (x0, x1))
            number = int(z / 0.1)
            painted[number, 63 - int((y + stage["Y"]) / 0.1), begin:end] += hatching_um / 0.1
            powers.setdefault(number, set()).add(power)
            points = []
        elif line[0] in "-0123456789":
            points.append(tuple(map(float, line.split())))
    assert mode == job.mode
    wanted = np.arange(15)[:, None, None] < 3 + levels
    assert painted == pytest.approx(wanted.astype(float))
    if len(job.power_percent) > 1:
        assert powers == {n: {50.0 + max(0, n - 2)} for n in powers}


def test_gwl_refuses_what_it_cannot_write_exactly(tmp_path, design):
    for said, more in (
        ("slices per level", {"slicing_um": 0.15}),
        ("slices in the pedestal", {"pedestal_um": 0.25}),
        ("hatching distances", {"hatching_um": 0.07}),
        ("laser power", {"gwl.power_percent": (50.0, 40.0)}),
        ("pedestal_um", {"pedestal_um": 0.0}),
    ):
        with pytest.raises(InputError, match=said):
            export_design(design, "gwl", tmp_path / "out", **more)
    with pytest.raises(InputError, match="piezo mode"):
        export_design(np.ones((4, 4000), np.uint8), "gwl", tmp_path / "out", gwl={"mode": "piezo"})


def test_dxf_has_a_closed_polyline_on_the_layer_of_its_grey(tmp_path):
    """Check a DXF file with a parser of group codes: corners, layers, unit, and the sum of areas."""
    file = export_design(LETTER * 7, "dxf", tmp_path, pitch_um=0.13)
    words = file.read_text().split()
    pairs = list(zip(words[::2], words[1::2], strict=True))
    assert ("1", "AC1009") in pairs
    assert pairs[pairs.index(("9", "$INSUNITS")) + 1] == ("70", "13")
    area, corners = 0.0, []
    for code, word in pairs:
        if (code, word) == ("0", "POLYLINE"):
            corners = []
        elif code in ("10", "20"):
            corners.append(float(word))
        elif code == "8":
            assert word == "252"
        elif (code, word) == ("0", "SEQEND"):
            x, y = np.array(corners[2:]).reshape(-1, 2).T
            area += abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2
            assert len(x) == 4
    assert pairs.count(("70", "1")) == pairs.count(("0", "POLYLINE")) > 0
    assert area == pytest.approx(LETTER.sum() * 0.13**2, abs=1e-6)
    # The F is upright, so its bar is at the top.
    assert max(float(word) for code, word in pairs if code == "20") == pytest.approx(5 * 0.13)


@pytest.mark.parametrize("kind", FORMATS)
def test_bare_levels_heights_and_elements_are_exported(tmp_path, kind):
    levels = np.kron(LETTER * 7, np.ones((2, 3), np.uint8))
    heights = levels * 0.2 + np.random.default_rng(0).uniform(-0.09, 0.09, levels.shape)
    np.save(tmp_path / "h.npy", heights)
    for name, given in (("levels", levels), ("heights", heights), ("file", tmp_path / "h.npy")):
        file = export_design(given, kind, tmp_path / name, pitch_um=0.2, level_height_um=0.2, slicing_um=0.1)
        back, sidecar = import_levels(file)
        assert np.array_equal(back, levels)
        assert sidecar.size_um == pytest.approx((2.0, 2.4))
        assert sidecar.maximum_height_um == pytest.approx(1.4)
        assert sidecar.design_sha256 is None
    element = Element("none", {"size_px": 16})
    assert np.array_equal(import_levels(export_design(element, kind, tmp_path / "e"))[0], element.levels())
    for bad in (np.full((4, 4), -1), np.full((4, 4), np.nan), np.zeros(4), np.full((4, 4), 999)):
        with pytest.raises(InputError, match="array to export"):
            export_design(bad, kind, tmp_path / "bad")
    with pytest.raises(InputError, match="layout to export"):
        export_design(object(), kind, tmp_path / "bad")


def test_floats_that_could_be_levels_or_heights_are_refused(tmp_path):
    """Check that no array is exported ten times too high. An array that means the same as levels and as
    heights is accepted.
    """
    levels = LETTER * 12
    np.save(tmp_path / "levels.npy", levels.astype(float))
    for given in (levels.astype(np.float32), tmp_path / "levels.npy"):
        with pytest.raises(InputError, match=r"whole numbers from 0 to 12, wanted integers for levels"):
            export_design(given, "png16", tmp_path / "refused")
    for given, step_um in ((levels * 0.0, 0.1), (levels * 1.0, 1.0)):
        file = export_design(given, "png16", tmp_path / f"{step_um}", level_height_um=step_um)
        assert np.array_equal(import_levels(file)[0], given)


def test_a_dose_curve_gives_each_level_the_grey_that_prints_it(tmp_path):
    """Check a quadratic dose curve: height = (grey / 100)^2 / 4 + 0.5 µm."""
    grey = np.arange(0, 256, 5)
    rows = [f"{g},{(g / 100) ** 2 / 4 + 0.5:.9g}" for g in grey]
    (tmp_path / "curve.csv").write_text("grey,height_um\n" + "\n".join(rows))
    file = export_design(LETTER * 12, "bmp", tmp_path / "out", dose_curve=tmp_path / "curve.csv")
    # The grey whose height is 1.2 µm above that of grey 0 is 100 sqrt(4.8) = 219.1.
    assert cv2.imread(str(file), cv2.IMREAD_UNCHANGED).max() == 219
    levels, sidecar = import_levels(file)
    assert np.array_equal(levels, LETTER * 12)
    assert sidecar.greys[4] == round(100 * (4 * 0.4) ** 0.5)
    assert sidecar.white_height_um is None
    linear = import_levels(export_design(LETTER * 12, "png16", tmp_path / "png"))[1]
    assert linear.white_height_um == pytest.approx(65535 / (65535 // 12) * 0.1)
    (tmp_path / "curve.csv").write_text("grey,height_um\n0,0\n255,1.0\n")
    with pytest.raises(InputError, match=r"dose curve, got a height range of 1 µm, but levels over 1\.2 µm"):
        export_design(LETTER * 12, "bmp", tmp_path / "no", dose_curve=tmp_path / "curve.csv")
    with pytest.raises(InputError, match="both increasing"):
        export_design(LETTER * 12, "bmp", tmp_path / "no", dose_curve=tmp_path / "none.csv")


def test_distance_to_the_training_levels():
    layout = LayoutSettings(size_px=16, levels=4)
    levels = np.repeat(np.arange(4, dtype=np.uint8), 64).reshape(16, 16)
    same = out_of_distribution(levels, layout, {"training_level_share": [1, 1, 1, 1]})
    assert same is not None
    assert same.level_distance == pytest.approx(0)
    assert not same.flagged
    middle = out_of_distribution(levels, layout, {"training_level_share": [0, 0.5, 0.5, 0]})
    assert middle is not None
    # Half of the pixels have levels that do not occur in training.
    assert middle.level_distance == pytest.approx(0.5)
    assert middle.extreme_level_share == pytest.approx(0.5)
    assert out_of_distribution(levels, layout, {}) is None
