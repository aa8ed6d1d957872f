"""How far is the SI-PSNR of a photograph from that of the light that was photographed?

    python -m benchmarks.photographs --out runs/photographs [--photographs 30] [--publish]

Two holograms are designed through the zoo's physics model, and prints unlike the expected ones photographed
by cameras that are turned, moved, tilted, mirrored, noisy and darker in their corners at random; every sixth
photograph has 15 % of noise, is encoded for a screen or overexposed. The first eight that are turned or
mirrored are also given without saying so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from benchmarks.record import conclude, options, origin
from litho_data.foundation.commands import run_script
from litho_data.foundation.errors import InputError
from litho_data.register.geometry import ORIENTATIONS, orient
from litho_design import design_hologram, hologram_settings, load_design
from litho_design.images.similarity import si_psnr_db
from litho_design.judging.loaded import LoadedDesign
from litho_design.judging.photographs import PhotoSource, score_hologram_photo

PAGE = Path(__file__).parents[1] / "docs" / "optics.md"
RESULT = PAGE.parent / "results" / "photographs" / "photographs.json"
NAME = "photographs.json"
TARGETS = {"text": (256, 25.0), "ring": (192, 15.0)}
DARK, WHITE, RANGE = 8000.0, 40000.0, 65535
LIMIT_DB = 0.3
# Of the scales drawn below, a tenth to either side.
SCALE_SD = 0.06
# By number, of every eighteen photographs.
FAULTS = {5: {"noise": 0.15}, 11: {"gamma": 1 / 2.2}, 17: {"exposure": 3.5}}
_FINER = 4
_UNSAID = 8
# Inverse operations by name: a photograph that was turned by the one comes upright by the other.
_BACK = {"rotate-90": "rotate-270", "rotate-270": "rotate-90"}


@dataclass(frozen=True)
class Camera:
    """One camera: how it stands, and what it does to the light."""

    pitch_um: float = 0.15
    turn_deg: float = 0.0
    shift_um: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0
    tilt: tuple[float, float] = (0.0, 0.0)
    vignetting: float = 0.0
    noise: float = 0.0
    exposure: float = 1.0
    gamma: float = 1.0

    def counts(self, light: np.ndarray, pitch_um: float, seed: int) -> np.ndarray:
        """The photograph uint16 of light (n, n) on pixels of ``pitch_um``."""
        step = self.pitch_um / pitch_um / self.scale
        side = round(1.15 * len(light) / step)
        place = (np.arange(side * _FINER) + 0.5) / _FINER - side / 2
        across = 1 + 2 / side * (self.tilt[0] * place[None] + self.tilt[1] * place[:, None])
        turn, middle = step * np.exp(1j * np.deg2rad(self.turn_deg)), (len(light) - 1) / 2
        seen_at = turn * (place[None] + 1j * place[:, None]) / across + complex(*self.shift_um) / pitch_um
        fine = cv2.remap(
            light.astype(np.float32),
            (seen_at.real + middle).astype(np.float32),
            (seen_at.imag + middle).astype(np.float32),
            cv2.INTER_CUBIC,
        )
        seen: np.ndarray = fine.clip(0).reshape(side, _FINER, side, _FINER).mean((1, 3))
        edge = np.square(np.linspace(-1, 1, side))
        seen *= (1 - self.vignetting * (edge[:, None] + edge) / 2) / seen.max()
        seen += np.random.default_rng(seed).normal(0, self.noise, seen.shape)
        bent = seen if self.gamma == 1 else seen.clip(0) ** self.gamma
        counts = WHITE * self.exposure * bent + DARK
        return counts.round().clip(0, RANGE).astype(np.uint16)


def drawn_camera(generator: np.random.Generator, fault: Mapping[str, float]) -> Camera:
    """A camera at random, with a fault that no score can stand, or none."""
    low, high = generator.uniform(-1, 1, (2, 2)).tolist()
    given: dict[str, Any] = {
        "pitch_um": generator.uniform(0.1, 0.2),
        "turn_deg": generator.uniform(-8, 8),
        "shift_um": tuple(low),
        "scale": generator.uniform(0.9, 1.1),
        "tilt": tuple(0.08 * one for one in high),
        "vignetting": generator.uniform(0, 0.3),
        "noise": 10 ** generator.uniform(-3, -1.3),
    }
    return Camera(**{**given, **fault})


def photographed(loaded: LoadedDesign, count: int, folder: Path) -> list[dict[str, Any]]:
    """One row per photograph of a print that is not quite the expected one."""
    assert loaded.target is not None
    pitch_um = loaded.record.layout.pitch_um
    rows: list[dict[str, Any]] = []
    names = list(ORIENTATIONS)
    for number in range(count):
        generator = np.random.default_rng([count, number])
        rough = cv2.GaussianBlur(generator.standard_normal(loaded.expected_um.shape), (0, 0), 2.0)
        gain, sigma_um = generator.uniform(0.85, 1.1), generator.uniform(0, 0.04)
        print_um = gain * loaded.expected_um.numpy() + sigma_um * rough / rough.std()
        light = cv2.GaussianBlur(loaded.image(torch.from_numpy(print_um.astype(np.float32))), (0, 0), 1.0)
        orientation = names[number % len(names)]
        fault = FAULTS.get(number % 18, {})
        camera = drawn_camera(generator, fault)
        seen = orient(camera.counts(light.astype(float), pitch_um, number), orientation)
        file = folder / "photograph.png"
        cv2.imwrite(str(file), np.ascontiguousarray(seen))
        dark = DARK if number % 2 else None
        row = {"number": number, "orientation": orientation, "noise": camera.noise, "fault": fault}
        said = _scored(
            loaded,
            PhotoSource(
                file,
                camera.pitch_um,
                dark,
                orientation=_BACK.get(orientation, orientation),
                pitch_sd=SCALE_SD,
            ),
        )
        truth = si_psnr_db(torch.from_numpy(light).double(), loaded.target.double())
        if isinstance(said, str):
            row["refused"] = said
        else:
            row["error_db"], row["sd_db"] = said[0] - truth, said[1]
        if orientation != "identity" and sum("silent" in one for one in rows) < _UNSAID:
            unsaid = _scored(loaded, PhotoSource(file, camera.pitch_um, dark, pitch_sd=SCALE_SD))
            row["silent"] = not isinstance(unsaid, str) and not unsaid[2]
        rows.append(row)
    return rows


def _scored(loaded: LoadedDesign, source: PhotoSource) -> str | tuple[float, float, bool]:
    """SI-PSNR, its standard deviation, and whether the orientation is ambiguous; or why it was refused."""
    try:
        found = score_hologram_photo(loaded, source)
    except InputError as error:
        return str(error).partition("got ")[2]
    figures = found.figures.model_dump()
    return figures["si_psnr_db"], found.uncertainty["si_psnr_db"], bool(found.record.ambiguous)


def as_markdown(record: Mapping[str, Any]) -> str:
    """One paragraph: errors, refusals, orientations."""
    rows = record["rows"]
    errors = np.array([row["error_db"] for row in rows if "error_db" in row])
    faults = [row for row in rows if row["fault"]]
    turned = [row["silent"] for row in rows if "silent" in row]
    spoilt, refused = (sum("refused" in row for row in some) for some in (faults, rows))
    return (
        f"{len(rows)} photographs of prints of two holograms, of them {len(faults)} with a noise of 15 % of "
        f"white, encoded for a screen or overexposed: {spoilt} of these and {refused - spoilt} of the others "
        f"were refused. The other {errors.size} were scored, with errors of the SI-PSNR from "
        f"{errors.min():+.2f} to {errors.max():+.2f} dB (rms {np.sqrt(np.mean(errors**2)):.2f} dB), "
        f"{int((np.abs(errors) > LIMIT_DB).sum())} beyond {LIMIT_DB} dB. Of {len(turned)} turned or mirrored "
        f"ones of which that was not said, {sum(turned)} were taken in silence."
    )


def main() -> None:
    """Design, photograph, score, print, write."""
    parser = options(__doc__, "write record and text into docs")
    parser.add_argument("--out", type=Path, required=True, help="folder of designs and photographs")
    parser.add_argument("--photographs", type=int, default=30, help="of each hologram")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for target, (size_px, distance_um) in TARGETS.items():
        folder = arguments.out / target
        settings = hologram_settings(
            changes={"layout.size_px": size_px, "optics.distance_um": distance_um, "search.iterations": 20,
                     "search.polish_rounds": 0}
        )  # fmt: skip
        design_hologram(target, "zoo:physics", folder, settings=settings, announce=False)
        found = photographed(load_design(folder), arguments.photographs, arguments.out)
        rows += [{"target": target} | row for row in found]
    record = {"schema": "litho-design/benchmark-photographs/1", **origin(), "rows": rows}
    out = RESULT if arguments.publish else arguments.out / NAME
    conclude(record, as_markdown(record), out, PAGE, NAME, published=arguments.publish)


if __name__ == "__main__":
    run_script(main)
