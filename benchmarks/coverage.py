"""Check whether the uncertainties of measured scores cover their errors.

    python -m benchmarks.coverage [--seed 1] [--count 200] [--publish]

Holograms are designed through the Physics model of the zoo. Each print is a random mixture of the prints of
two other models of the zoo, with another height scale and a rough surface. Then an imperfect camera
photographs its image, or an imperfect microscope scans the print. The error of a score is its difference from
the score of the true print. An interrupted run resumes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.markdown_table import markdown_table
from benchmarks.record import conclude, kept, options, origin
from litho_data.commands.progress import run_script
from litho_data.foundation.errors import InputError
from litho_design import design_hologram, hologram_settings, load_design, load_printer
from litho_design.images.measurements import MeasuredSource, PhotoSource
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.score import judge_design

PAGE = Path(__file__).parents[1] / "docs" / "scores.md"
RESULT = PAGE.parent / "results" / "coverage" / "coverage.json"
FIGURE = "si_psnr_db"
TARGETS = ("ring", "text", "letters", "spots", "chart")
# Number of designs of each target. Measurements of the same design have similar errors, so one design is not
# enough.
VERSIONS = 4
DESIGNED_BY = "zoo:physics"
PRINTED_BY = ("zoo:pbl", "zoo:random-features", "zoo:blur-table", "zoo:affine-mtf", "zoo:features")
SETTINGS = {"layout.size_px": 128, "optics.distance_um": 25, "search.iterations": 60, "window.yield_draws": 2}
# Pixels of substrate around the print in each kind of scan.
MARGINS_PX = {"scan": 16, "scan without substrate": 3}
KINDS = ("photograph", *MARGINS_PX)
_FINER = 4


@dataclass(frozen=True)
class Camera:
    """Describe a camera by its position and its effect on the light."""

    pitch_um: float = 0.15
    turn_deg: float = 0.0
    shift_um: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0
    tilt: tuple[float, float] = (0.0, 0.0)
    vignetting: float = 0.0
    blur_um: float = 0.0
    noise: float = 0.0
    speckle: float = 0.0
    exposure: float = 1.0
    gamma: float = 1.0
    dark: float = 8000.0
    white: float = 40000.0
    bits: int = 16

    def counts(self, light: np.ndarray, pitch_um: float, seed: int) -> np.ndarray:
        """Return a uint16 photograph of the light (n, n), which is given on pixels of ``pitch_um``."""
        rng = np.random.default_rng(seed)
        step = self.pitch_um / pitch_um / self.scale
        side = round(1.15 * len(light) / step)
        place = (np.arange(side * _FINER) + 0.5) / _FINER - side / 2
        across = 1 + 2 / side * (self.tilt[0] * place[None] + self.tilt[1] * place[:, None])
        turn, middle = step * np.exp(1j * np.deg2rad(self.turn_deg)), (len(light) - 1) / 2
        seen_at = turn * (place[None] + 1j * place[:, None]) / across + complex(*self.shift_um) / pitch_um
        sharp = light.astype(np.float32)
        if self.blur_um:
            sharp = cv2.GaussianBlur(sharp, (0, 0), self.blur_um / pitch_um)  # type: ignore[assignment]
        fine = cv2.remap(
            sharp,
            (seen_at.real + middle).astype(np.float32),
            (seen_at.imag + middle).astype(np.float32),
            cv2.INTER_CUBIC,
        )
        seen: np.ndarray = fine.clip(0).reshape(side, _FINER, side, _FINER).mean((1, 3))
        edge = np.square(np.linspace(-1, 1, side))
        seen *= (1 - self.vignetting * (edge[:, None] + edge) / 2) / seen.max()
        if self.speckle:
            seen *= 1 + rng.normal(0, self.speckle, seen.shape)
        seen += rng.normal(0, self.noise, seen.shape)
        bent = seen if self.gamma == 1 else seen.clip(0) ** self.gamma
        counts = (self.white * self.exposure * bent + self.dark) / 65535
        top = 2**self.bits - 1
        return (counts * top).round().clip(0, top).astype(np.uint16)


def printed(
    loaded: LoadedDesign, rng: np.random.Generator, printers: Mapping[str, Any]
) -> tuple[torch.Tensor, list[Any]]:
    """Return the heights (size, size), µm, of a print by another printer than the design expects, and the
    models that had no part in it.

    It is a random mixture of the prints of two models. The power spectrum of its roughness falls with the
    square of the frequency, as that of the deviation of the measured prints from Physics does.
    """
    names = rng.permutation(PRINTED_BY).tolist()
    one, other = (loaded.printed_um(printers[name]).double().numpy() for name in names[:2])
    height = one + rng.uniform() * (other - one)
    size = len(height)
    # The field is a part of a larger one, so its slowest waves are longer than the field.
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(2 * size)] * 2))
    frequency[0, 0] = np.inf
    rough = np.fft.ifft2(np.fft.fft2(rng.standard_normal((2 * size, 2 * size))) / frequency).real[
        :size, :size
    ]
    height = height * (1 + 0.03 * rng.standard_normal()) + rng.uniform(0.002, 0.010) * rough / rough.std()
    return torch.from_numpy(height.clip(0)).float(), [printers[name] for name in names[2:]]


def photograph(
    loaded: LoadedDesign, height: torch.Tensor, rng: np.random.Generator, file: Path
) -> PhotoSource:
    """Photograph the image behind a print, and return what the user would state about the photograph."""
    pitch_sd = float(rng.choice([0.0, 0.02]))
    bits = int(rng.choice([8, 12, 16]))
    camera = Camera(
        pitch_um=rng.uniform(0.08, 0.2),
        turn_deg=rng.normal(0, 2),
        shift_um=tuple(rng.normal(0, 0.5, 2).tolist()),
        scale=1 + pitch_sd * rng.standard_normal(),
        tilt=tuple((rng.choice([0, 0.03]) * rng.standard_normal(2)).tolist()),
        vignetting=float(rng.uniform(0, 0.15)),
        blur_um=float(rng.uniform(0, 0.1)),
        noise=float(10 ** rng.uniform(-3, -1.7)),
        speckle=float(rng.uniform(0, 0.05)),
        bits=bits,
    )
    counts = camera.counts(loaded.image(height), loaded.record.layout.pitch_um, int(rng.integers(2**31)))
    cv2.imwrite(str(file), counts.astype(np.uint8) if bits == 8 else counts)
    dark = camera.dark / 65535 * (2**bits - 1)
    known = bool(rng.random() < 0.5)
    return PhotoSource(file, camera.pitch_um, pitch_sd=pitch_sd, dark_level=dark if known else None)


def scan(
    loaded: LoadedDesign, height: torch.Tensor, rng: np.random.Generator, file: Path, margin_px: int
) -> MeasuredSource:
    """Scan a print and ``margin_px`` pixels of substrate around it. Return what the user would state about
    the scan.
    """
    pitch_um = loaded.record.layout.pitch_um
    around = np.pad(height.double().numpy(), margin_px)
    size = len(around)
    turn = np.asarray(
        cv2.getRotationMatrix2D((size / 2, size / 2), rng.normal(0, 1.5), 1 + rng.normal(0, 0.005)), float
    )
    turn[:, 2] += rng.normal(0, 2, 2)
    seen = np.asarray(cv2.warpAffine(around, turn, (size, size), flags=cv2.INTER_CUBIC), float)
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    seen *= 1 + 0.02 * rng.standard_normal()
    tilt, bow = rng.normal(0, 0.2, 2), rng.normal(0, 0.05, 3)
    seen += tilt[0] * x + tilt[1] * y + bow[0] * x * x + bow[1] * x * y + bow[2] * y * y
    seen += rng.uniform(0.001, 0.006) * rng.standard_normal(seen.shape)
    np.savetxt(file, seen * 1e-6)
    return MeasuredSource(file, "m", size * pitch_um, tip_um=0.0)


def measure(
    kind: str, loaded: LoadedDesign, rng: np.random.Generator, printers: Any, folder: Path
) -> dict[str, Any]:
    """Print a design, measure it, and compare the score of the measurement with that of the true print."""
    height, others = printed(loaded, rng, printers)
    truth = getattr(loaded.score(height), FIGURE)
    try:
        if kind == "photograph":
            source = photograph(loaded, height, rng, folder / "photo.png")
            found = judge_design(loaded, others, camera=source).scores[-1]
        else:
            scanned = scan(loaded, height, rng, folder / "scan.txt", MARGINS_PX[kind])
            found = judge_design(loaded, [], scan=scanned).scores[0]
    except InputError as error:
        return {"kind": kind, "refused": str(error)}
    assert found.uncertainty is not None
    return {
        "kind": kind,
        "truth": truth,
        "error": found.figures[FIGURE] - truth,
        "sd": found.uncertainty[FIGURE],
    }


def designs(folder: Path, seed: int) -> list[LoadedDesign]:
    """Return ``VERSIONS`` designs of each target, from searches with different seeds. Make those that are
    missing.
    """
    found = []
    for version, target in product(range(VERSIONS), TARGETS):
        settings = hologram_settings(changes={**SETTINGS, "search.seed": seed + version})
        own = folder / f"{target}-{version}"
        if not (own / "design.json").exists():
            design_hologram(target, DESIGNED_BY, own, settings=settings, judges=(), announce=False)
        found.append(load_design(own))
    return found


def line_of(rows: list[dict[str, Any]], kind: str) -> tuple[str, ...]:
    """Return the table's row about the measurements of one kind."""
    own = [row for row in rows if row["kind"] == kind]
    kept = [row for row in own if "error" in row]
    if not kept:
        return kind, f"0 of {len(own)}", *["–"] * 4
    error, sd = (np.array([row[name] for row in kept]) for name in ("error", "sd"))
    within = [f"{100 * np.mean(np.abs(error) <= k * sd):.1f} %" for k in (1, 3)]
    spread = f"{np.sqrt(np.mean(error**2)):.2f} dB"
    return kind, f"{len(kept)} of {len(own)}", *within, f"{error.mean():+.3f} dB", spread


def text_of(record: Mapping[str, Any]) -> str:
    """Return a table with a row for each kind of measurement."""
    columns = ("measurement", "accepted", "within 1 σ", "within 3 σ", "mean error", "rms error")
    return markdown_table(columns, [line_of(record["rows"], kind) for kind in KINDS])


def main() -> None:
    """Run the missing measurements, and write the record of all."""
    parser = options(__doc__, "write the table into docs/scores.md", RESULT)
    parser.add_argument(
        "--cache", type=Path, default=Path("runs/coverage"), help="folder of designs and results"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=200, help="measurements of each kind")
    given = parser.parse_args()
    folder = given.cache / str(given.seed)
    loaded = designs(folder, given.seed)
    layout = loaded[0].record.layout
    printers = {name: load_printer(name, layout) for name in PRINTED_BY}
    rows = []
    for number in range(given.count):
        for place, kind in enumerate(KINDS):
            rng = np.random.default_rng([given.seed, number, place])
            found = partial(measure, kind, loaded[number % len(loaded)], rng, printers, folder)
            rows.append(kept(folder / f"{kind}-{number}.json", found))
            print(number, rows[-1], flush=True)
    record = {"run": origin(), "seed": given.seed, "rows": rows}
    conclude(record, text_of(record), given.out, PAGE, "coverage", published=given.publish)


if __name__ == "__main__":
    run_script(main)
