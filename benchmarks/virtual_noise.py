"""Publish the noise analysis of virtual prints, whose roughness is known, in the documentation.

    litho-data masks --out doses --pattern dose-matrix --count 7 --size-px 512
    litho-data simulate --out doses-printed --layouts doses/card.toml
    litho-data build doses-printed/raw/card.toml --out doses.zarr
    litho-models noise doses.zarr --out doses-noise
    litho-data simulate --out fab --references
    litho-data build fab/raw/card.toml --out fab.zarr
    litho-models benchmark fab.zarr --models linear,features --out fab-benchmark
    litho-models noise fab.zarr --out fab-noise --residuals fab-benchmark
    python -m benchmarks.virtual_noise doses-noise fab-noise

The texts on the page are written from the copied records. A test checks that the page agrees with them.
"""

from __future__ import annotations

from pathlib import Path

from benchmarks.markdown_table import markdown_table, with_interval
from benchmarks.record import options, publish
from litho_data.commands.progress import run_script
from litho_data.virtual_fab.settings import Noise
from litho_models.noise import NoiseAnalysis

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "results" / "virtual-noise"
PAGE = ROOT / "docs" / "noise.md"
DOSES, REFERENCES = "dose-matrix", "references"


def texts(folder: Path) -> dict[str, str]:
    """Return the texts for the page, by the names of their marks. They are made from the two records in a
    folder.
    """
    doses, references = (NoiseAnalysis.read(folder / name) for name in (DOSES, REFERENCES))
    return {
        "dose matrix": dose_table(doses),
        "planted roughness": planted_text(references),
    }


def dose_table(found: NoiseAnalysis) -> str:
    """Return a table of the heights, the roughness, the lost steps and the readability at every dose,
    followed by the recommended dose.
    """
    assert found.dose is not None
    rows = [
        (
            f"{row.dose:g}",
            f"{row.height_gain:.3f}",
            f"{row.full_height_nm:.0f} nm",
            f"{row.roughness_nm:.1f} nm",
            f"{row.lost_low} + {row.lost_high}",
            f"{row.worst_readability:.2f} σ",
        )
        for row in found.dose.rows
    ]
    return markdown_table(
        (
            "dose",
            "gain",
            "height of the highest level",
            "roughness",
            "lost steps at low + at high levels",
            "readability of the worst step",
        ),
        rows,
        f"Recommended dose: {found.dose.recommended_dose:g}. Reason: {found.dose.reason}. Scans left out of "
        f"the other estimates (scan: reason): {', '.join(found.run.dropped)}.",
    )


def planted_text(found: NoiseAnalysis) -> str:
    """Return a text that compares two measured values of the roughness, from the flat print and from the
    noise budget, with the true one.
    """
    flat = next(one for one in found.references.flats if one.background == "offset")
    assert found.budget is not None
    noise = found.budget.floor.at("full")
    assert noise is not None
    return (
        f"The true roughness of the virtual prints is {Noise().roughness_nm:g} nm. The value from the flat "
        f"print is {flat.sigma_nm:.2f} ± {flat.sigma_uncertainty_nm:.2f} nm. The value from the noise budget "
        f"at k = 7, computed from the residuals of `{found.budget.model}` on {found.run.n_scans} scans, is "
        f"{with_interval(noise.rmse_nm, noise.rmse_ci95_nm)}."
    )


def main() -> None:
    """Copy the records, and write the texts into the page."""
    parser = options(__doc__)
    for name in (DOSES, REFERENCES):
        parser.add_argument(name, type=Path, help="folder with a result of litho-models noise")
    given = vars(parser.parse_args())
    for name in (DOSES, REFERENCES):
        NoiseAnalysis.read(given[name]).write(FOLDER / name)
    for mark, text in texts(FOLDER).items():
        print(text)
        publish(PAGE, mark, text)


if __name__ == "__main__":
    run_script(main)
