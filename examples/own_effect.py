"""Add two effects of your own to the closed loop: one that the printer causes, and one that differs from scan
to scan.

    python examples/own_effect.py STORE.zarr --out loop

The script registers an effect of the process (the first layers sink into the adhesion promoter) and a
per-scan term (the scanner's bow has a cubic part). It then runs the closed loop as `litho-models close-loop`
does. Nothing else needs to change: `close_loop.json` and `report.html` contain a verdict on both effects.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

from litho_data.commands.progress import run_script
from litho_models import close_loop, register_effect, register_scan_term
from litho_models.effects import Effect, FieldContext, Parameter, of_single_scans
from litho_models.effects.effect import Values
from litho_models.scan_terms import FloatMap, ScanTerm, TermPixels

SINKING_DEPTH_UM = 0.2


def sinking_layers(height: Tensor, values: Values, context: FieldContext) -> Tensor:
    """Return the height H - d exp(-M / 0.2 µm), where M is the layout's height. The lowest parts of the
    layout are printed lower, by at most the depth d.
    """
    return height - values["depth_um"] * torch.exp(-context.layout_um / SINKING_DEPTH_UM)


def cubic_bow_map(pixels: TermPixels) -> FloatMap:
    """Return x³ at n pixels of a scan, as an array of shape (1, n). Here, x runs from -1 to 1 over the scan,
    so the mean of x³ is zero.
    """
    x = pixels.smooth[0]
    return (x**3)[None]


def register() -> None:
    """Register both effects, and the per-scan term that implements the second one."""
    register_effect(
        Effect(
            name="sinking-layers",
            title="first layers sinking into the adhesion promoter",
            stage="development",
            role="process",
            acts_on="height",
            parameters={"depth_um": Parameter("µm", 0.0, 0.3, 0.03)},
            apply=sinking_layers,
            separating="print staircases with and without the promoter",
        )
    )
    register_effect(
        Effect(
            name="cubic-bow",
            title="cubic part of each scan's bow",
            stage="measurement",
            role="measurement",
            acts_on="height",
            parameters={"bow_xxx_um": Parameter("µm", -0.3, 0.3, 0.02)},
            apply=of_single_scans,
            separating="scan a flat substrate",
        )
    )
    register_scan_term(ScanTerm("cubic-bow", "cubic-bow", "µm", ("x³",), maps=cubic_bow_map))


def main() -> None:
    """Register the effects, run the closed loop, and print the verdict on each effect."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("store", help="dataset store")
    parser.add_argument("--out", required=True, help="folder of the result")
    parser.add_argument("--base", default="physics", help="model that the loop corrects (default physics)")
    parser.add_argument("--folds", type=int, default=5, help="number of folds of held-out scans (default 5)")
    given = parser.parse_args()
    register()
    result = close_loop(given.store, given.out, base=given.base, folds=given.folds)
    verdicts: dict[str, str] = {one.name: one.verdict for one in result.effects}
    verdicts |= {one.name: one.verdict for one in result.candidates}
    print(f"sinking-layers: {verdicts['sinking-layers']}")
    for finding in result.single_scans:
        if finding.name == "cubic-bow":
            print(f"{finding.name}: {'seen' if finding.seen else 'not seen'}, {finding.evidence}")


if __name__ == "__main__":
    run_script(main)
