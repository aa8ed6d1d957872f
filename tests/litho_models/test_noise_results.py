"""The page on noise quotes the committed results of virtual prints, and they find what was planted."""

from __future__ import annotations

import pytest

from benchmarks import virtual_noise
from benchmarks.record import published
from litho_data.virtual_fab.settings import Noise
from litho_models.noise import NoiseAnalysis


@pytest.mark.parametrize("mark", ["dose matrix", "planted roughness"])
def test_the_page_quotes_the_committed_results(mark):
    assert published(virtual_noise.PAGE, mark) == virtual_noise.texts(virtual_noise.FOLDER)[mark]


def test_no_dose_and_no_roughness_is_off_what_was_planted():
    doses = NoiseAnalysis.read(virtual_noise.FOLDER / virtual_noise.DOSES)
    assert doses.dose.recommended_dose == 1.0
    gains = [row.height_gain for row in doses.dose.rows]
    assert gains == sorted(gains)
    planted_nm = Noise().roughness_nm
    for name in (virtual_noise.DOSES, virtual_noise.REFERENCES):
        found = NoiseAnalysis.read(virtual_noise.FOLDER / name)
        gamma = next(bound for bound in found.bounds if "surroundings are alike" in bound.name)
        # The interval over scans is 2 % of σ to either side; a dose step taken for noise would be 50 nm.
        assert gamma.sigma_nm == pytest.approx(planted_nm, rel=0.05)
