"""Write small AFM files to test the readers. Each writer follows only the description of its format."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

# The map is not square, has no symmetry and one high corner, so that any flip or rotation is noticed.
SHAPE = (5, 8)
SIZE_UM = (2.5, 1.6)
HEIGHT_UM = 0.001 * (10 * np.arange(5)[:, None] + np.arange(8)[None, :]).astype(float)
HEIGHT_UM[0, 0] = 0.5


def write_gsf(path: Path, height_m: np.ndarray, header: dict[str, str]) -> None:
    lines = {"XRes": height_m.shape[1], "YRes": height_m.shape[0]} | header
    text = "Gwyddion Simple Field 1.0\n" + "".join(f"{key} = {value}\n" for key, value in lines.items())
    raw = text.encode()
    path.write_bytes(raw + b"\0" * (4 - len(raw) % 4) + height_m.astype("<f4").tobytes())


def write_gwy(
    path: Path, channels: dict[str, tuple[np.ndarray, str]], mask: np.ndarray | None = None
) -> None:
    from gwyfile.objects import GwyContainer, GwyDataField, GwySIUnit

    container = GwyContainer()
    for number, (title, (values, unit)) in enumerate(channels.items()):
        container[f"/{number}/data"] = GwyDataField(
            values,
            xreal=SIZE_UM[1] * 1e-6,
            yreal=SIZE_UM[0] * 1e-6,
            si_unit_xy=GwySIUnit(unitstr="m"),
            si_unit_z=GwySIUnit(unitstr=unit),
        )
        container[f"/{number}/data/title"] = title
        container[f"/{number}/meta"] = GwyContainer({"Scan rate": "1.5 Hz"})
    if mask is not None:
        container["/0/mask"] = GwyDataField(mask.astype(float), xreal=1.0, yreal=1.0)
    container.tofile(str(path))


def write_spm(path: Path, counts: np.ndarray, *, hard_v: float, sensitivity_nm_per_v: float) -> None:
    """Write a Bruker Nanoscope file with 16-bit counts and rows from bottom to top."""
    data = counts[::-1].astype("<i2").tobytes()
    ny, nx = counts.shape
    header = [
        "\\*File list",
        "\\Version: 0x05120000",
        "\\*Ciao scan list",
        "\\Scan Size: 1.6 2.5 ~m",
        f"\\@Sens. Zsens: V {sensitivity_nm_per_v} nm/V",
        "\\*Ciao image list",
        "\\Data offset: 2048",
        f"\\Data length: {len(data)}",
        "\\Bytes/pixel: 2",
        f"\\Samps/line: {nx}",
        f"\\Number of lines: {ny}",
        "\\Scan Size: 1.6 2.5 ~m",
        '\\@2:Image Data: S [Height] "Height"',
        f"\\@2:Z scale: V [Sens. Zsens] ({hard_v / 65536} V/LSB) {hard_v} V",
        "\\*File list end",
    ]
    path.write_bytes("\r\n".join(header).encode("latin-1").ljust(2048, b"\x1a") + data)


def write_sur(path: Path, counts: np.ndarray, *, height_per_count_um: float) -> None:
    """Write a Digital Surf file with 32-bit counts and rows from top to bottom."""
    ny, nx = counts.shape
    head = struct.pack("<12s4H30s30s", b"DIGITAL SURF", 0, 1, 1, 1, b"scan".ljust(30), b"".ljust(30))
    head += struct.pack("<5H2IH", 0, 0, 0, 0, 1, 0, 0, 32)
    head += struct.pack("<4iI", int(counts.min()), int(counts.max()), nx, ny, nx * ny)
    head += struct.pack("<3f", SIZE_UM[1] / nx, SIZE_UM[0] / ny, height_per_count_um)
    head += b"".join(text.ljust(16) for text in [b"X", b"Y", b"Height", *[b"\xb5m"] * 6])
    head += struct.pack("<3f3H3I7Hf2IH2H", 1, 1, 1, *[0] * 9, 1, 1, 2020, 1, *[0] * 6)
    head += b"\0" * 128 + struct.pack("<3f", 0, 0, 0) + b"\0" * 34
    path.write_bytes(head + counts.astype("<i4").tobytes())


def write_ibw(path: Path, channels: dict[str, np.ndarray], note: str) -> None:
    """Write an Igor binary wave 5 as Asylum does: wave[x, y, channel] in metres, with y upwards."""
    layers = np.stack([values[::-1].T for values in channels.values()], axis=2)
    nx, ny, count = layers.shape
    raw_note = note.encode("latin-1")
    labels = b"".join(name.encode().ljust(32, b"\0") for name in ["", *channels])
    data = layers.astype("<f4").tobytes(order="F")
    wave = struct.pack("<4I2H6sH32s2I", 0, 0, 0, layers.size, 2, 0, b"", 1, b"scan", 0, 0)
    wave += struct.pack("<4i", nx, ny, count, 0)
    wave += struct.pack("<8d", SIZE_UM[1] * 1e-6 / nx, SIZE_UM[0] * 1e-6 / ny, 1, 1, 0, 0, 0, 0)
    wave += b"m\0\0\0" + b"m\0\0\0" * 2 + b"\0" * 8
    wave = wave.ljust(320, b"\0")
    sizes = [320 + len(data), 0, len(raw_note), 0, 0, 0, 0, 0, 0, 0, len(labels), 0, 0, 0, 0]
    head = struct.pack("<hh15I", 5, 0, *sizes)
    checksum = -int(np.frombuffer(head + wave, dtype="<i2").sum(dtype=np.int64)) % 65536
    head = struct.pack("<hH15I", 5, checksum, *sizes)
    path.write_bytes(head + wave + data + raw_note + labels)


def write_jpk(path: Path, counts: np.ndarray) -> None:
    """Write a JPK image: a TIFF file with private tags. One of its pages has two scalings, and its rows run
    from bottom to top.

    The slot "nominal" is a decoy with an offset of 7 nm and 3 nm per count. The default slot has an offset of
    5 nm and 0.25 nm per count.
    """
    import tifffile

    def text(code: int, value: str) -> tuple:
        return (code, "s", 0, value, False)

    def number(code: int, value: float) -> tuple:
        return (code, "d", 1, value, False)

    def slot(index: int, name: str, multiply: float, offset: float) -> list[tuple]:
        first = 0x8090 + 0x30 * index
        parts = {0x00: name, 0x10: name, 0x11: "encoder", 0x12: "m", 0x13: "LinearScaling"}
        return [text(first + code, value) for code, value in parts.items()] + [
            number(first + 0x14, multiply),
            number(first + 0x15, offset),
        ]

    whole = [
        text(0x8000, "1.0"),
        text(0x8003, "2020-01-02 03:04:05 UTC"),
        number(0x8042, SIZE_UM[1] * 1e-6),
        number(0x8043, SIZE_UM[0] * 1e-6),
    ]
    page = [text(0x8050, "height"), (0x8051, "I", 1, 0, False), text(0x8052, "Height (measured)")]
    page += [(0x8080, "I", 1, 2, False), text(0x8081, "calibrated")]
    page += slot(0, "nominal", 3e-9, 7e-9) + slot(1, "calibrated", 0.25e-9, 5e-9)
    with tifffile.TiffWriter(path) as file:
        file.write(np.zeros((4, 4), np.uint8), extratags=whole, metadata=None)
        file.write(counts[::-1].astype(np.uint16), extratags=page, metadata=None)


def write_x3p(path: Path, height_m: np.ndarray) -> None:
    """Write an ISO 25178-72 file: a ZIP archive of XML and float64 rows from top to bottom."""
    import zipfile

    ny, nx = height_m.shape
    pitch_m = (SIZE_UM[0] * 1e-6 / ny, SIZE_UM[1] * 1e-6 / nx)
    axes = "".join(
        f"<{name}><AxisType>{kind}</AxisType><DataType>D</DataType>"
        f"<Increment>{step!r}</Increment><Offset>0</Offset></{name}>"
        for name, kind, step in (("CX", "I", pitch_m[1]), ("CY", "I", pitch_m[0]), ("CZ", "A", 1.0))
    )
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?><p:ISO5436_2 xmlns:p="http://www.opengps.eu/2008/ISO5436_2">'
        "<Record1><Revision>ISO5436 - 2000</Revision><FeatureType>SUR</FeatureType>"
        f"<Axes>{axes}</Axes></Record1>"
        f"<Record3><MatrixDimension><SizeX>{nx}</SizeX><SizeY>{ny}</SizeY><SizeZ>1</SizeZ></MatrixDimension>"
        "<DataLink><PointDataLink>bindata/data.bin</PointDataLink></DataLink></Record3></p:ISO5436_2>"
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("main.xml", xml)
        archive.writestr("bindata/data.bin", height_m.astype("<f8").tobytes())
