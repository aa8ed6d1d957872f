"""Check that the first result judges both designs in the same way, and that it warns if diffraction blurs the
target.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from litho_data.foundation.errors import InputError
from litho_design import design_hologram, first, hologram_settings
from litho_design.images.targets import load_target, stroke_width_px
from litho_design.judging.gap import GapResult
from litho_design.tasks.task import registered_task
from litho_design.workflows.first import small_hologram
from tests.tables import require_tables_equal_record

TINY = {
    "layout.size_px": 64,
    "optics.distance_um": 12,
    "search.iterations": 2,
    "search.polish_rounds": 0,
    "window.yield_draws": 5,
}


def test_both_designs_are_printed_by_the_same_model_and_shown_on_one_page(tmp_path):
    result = first(tmp_path, target="ring", settings=hologram_settings(changes=TINY), announce=False)
    assert {(entry.arm, entry.judge) for entry in result.entries} == {
        (arm, judge) for arm in ("none", "pbl") for judge in ("none", "pbl", "physics")
    }
    page = (tmp_path / "report.html").read_text("utf-8")
    for entry in result.entries:
        if entry.judge == "pbl":
            assert f"{entry.judged['si_psnr_db']:.3f}" in page
    assert page.count("<img") == 1
    matrices = {f"matrix_{figure}.csv": figure for figure in registered_task("hoe").headline}
    ends = {"paired.csv": {"95 % from": "", "to": ""}}
    require_tables_equal_record(tmp_path, GapResult.FILE_NAME, ends, pivoted=[*matrices])
    for table, figure in matrices.items():
        shown = pd.read_csv(tmp_path / table).set_index("designed with")
        for one in (one for one in result.summary if one.figure == figure):
            assert shown.loc[one.arm, f"printed by {one.judge}"] == pytest.approx(one.judged_mean, abs=6e-4)
    # The judge is a model that was not used in the designs. The page says what may be chance.
    assert "If physics prints the layouts, those designed with" in page
    assert "1 seed cannot tell this difference from chance" in page
    for arm in ("none", "pbl"):
        place = f"designs/{arm}/seed0/report.html"
        assert f'href="{place}"' in page
        assert (tmp_path / place).exists()


@pytest.mark.parametrize("width", [1, 2, 3, 6, 9])
def test_the_width_of_strokes_is_found(width):
    target = np.zeros((64, 64), np.float32)
    target[20 : 20 + width, 4:60] = target[40 : 40 + width, 4:60] = 1
    assert stroke_width_px(target) == width


def test_the_first_hologram_can_be_resolved_and_a_far_one_is_announced(tmp_path, capsys):
    """Check that the strokes of the first result are wider than wavelength x distance / side."""
    settings = small_hologram()
    finest_um = settings.optics.wavelength_um * settings.optics.distance_um / settings.layout.size_um
    assert stroke_width_px(load_target("text", settings.layout.size_px).pixels) * 0.1 > 1.2 * finest_um
    square = np.pad(np.ones((12, 12), np.float32), 26)
    near = hologram_settings(changes=TINY)
    assert not design_hologram(square, "none", tmp_path / "near", settings=near).notes
    capsys.readouterr()
    far = hologram_settings(changes=TINY | {"optics.distance_um": 40})
    design = design_hologram(square, "none", tmp_path / "far", settings=far)
    # The finest detail is 0.6328 µm x 40 µm / 6.4 µm = 3.955 µm, but the square is 1.2 µm wide.
    said = capsys.readouterr().err.splitlines()[0]
    assert "about 1.2 µm wide, but an element of 6.4 µm at 40 µm" in said
    assert "λz/D = 4 µm" in said
    assert "--distance-um 12 or less" in said
    assert said == design.notes[0]
    assert "resolves no detail finer than" in (tmp_path / "far" / "report.html").read_text("utf-8")


def test_holograms_start_from_gerchberg_saxton_except_as_published():
    starts = [hologram_settings(variant).search.start for variant in ("default", "paper", "authors")]
    assert starts == ["gs", "random", "random"]


def test_for_a_folder_of_another_design_the_message_names_the_difference(tmp_path):
    made = hologram_settings(changes=TINY | {"search.start": "random"})
    design_hologram("ring", "none", tmp_path, settings=made, announce=False)
    again = design_hologram("ring", "none", tmp_path, settings=made, announce=False)
    assert again.settings == made.model_dump(mode="json")
    with pytest.raises(InputError, match=r"search\.start = 'random', but now 'gs' is requested"):
        design_hologram("ring", "none", tmp_path, settings=hologram_settings(changes=TINY), announce=False)
    with pytest.raises(InputError, match=r"target\.name = 'ring', but now 'chart'"):
        design_hologram("chart", "none", tmp_path, settings=made, announce=False)
