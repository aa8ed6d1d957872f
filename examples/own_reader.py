"""Add a reader of your own for files that begin with TOYAFM. Python code, dataset cards and commands can then
read such files.

In your own project, a file like this one is all you need. In this package, each reader is a module in
`litho_data/readers/` that ends with `READER = Reader(...)` and is listed in `registry.py`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from litho_data.readers import Channel, Reader, read_scan, register_reader

MAGIC = b"TOYAFM"


def read_channels(path: Path) -> list[Channel]:
    """Return the only channel of a file. The file begins with a line `TOYAFM ny nx y_um x_um`, which states
    the shape and the side lengths. The heights follow as float32 in nm, with the top row first.
    """
    head, _, data = path.read_bytes().partition(b"\n")
    # If a reader raises any exception, the user sees a one-line message about the file.
    ny, nx, y_um, x_um = (float(text) for text in head.split()[1:])
    height_nm = np.frombuffer(data, "<f4").reshape(int(ny), int(nx))
    return [
        Channel(
            name="height",
            shape=(int(ny), int(nx)),
            unit="nm",
            size_um=(y_um, x_um),
            load=lambda: (height_nm, None),
            header={"first line": head.decode("latin-1")},
        )
    ]


def write_toy(path: Path, height_nm: np.ndarray, size_um: tuple[float, float]) -> None:
    """Write a file in the TOYAFM format."""
    ny, nx = height_nm.shape
    head = f"TOYAFM {ny} {nx} {size_um[0]} {size_um[1]}\n".encode()
    path.write_bytes(head + height_nm.astype("<f4").tobytes())


TOY = Reader("toy", lambda path, head: head.startswith(MAGIC), read_channels)


def main() -> None:
    register_reader(TOY)
    file = Path("runs") / "toy.afm"
    file.parent.mkdir(exist_ok=True)
    write_toy(file, 100 * np.random.default_rng(0).random((64, 64)), (6.4, 6.4))
    scan = read_scan(file)
    print(f"{scan.name}: {scan.shape} pixels of {scan.pitch_um} µm, up to {scan.height_um.max():.3f} µm")


if __name__ == "__main__":
    main()
