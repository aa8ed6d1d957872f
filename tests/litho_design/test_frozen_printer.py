"""Test designs with a frozen model on disk, and the command line for them."""

from __future__ import annotations

import json
import sys

import cv2
import numpy as np
import pandas as pd
import pytest
import tifffile
import torch

from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_facts
from litho_design import design_hologram, hologram_settings, score
from litho_design.cli.app import app, main
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.source import JUDGES, load_printer, load_printers, models_at_hand
from litho_design.printers.training import OutOfDistribution
from litho_design.reports.advice import distribution_warning, spread_sentence, stroke_advice
from litho_design.tasks.design import Design
from litho_models import save_frozen, zoo
from litho_models.models import model_class
from tests.tables import require_figures_by_column

SMALL = ("--size-px", "128", "--distance-um", "30", "--iterations", "20", "--yield-draws", "5")
FEW = ("--yield-draws", "2", "--set", "search.polish_rounds=0")


@pytest.fixture
def affine_folder(tmp_path):
    simulator_class = model_class("affine")
    simulator = simulator_class(simulator_class.Config())
    with torch.no_grad():
        for parameter, value in zip(simulator.parameters(), (0.62, 0.164), strict=True):
            parameter.fill_(value)
    return save_frozen(simulator, tmp_path / "affine")


@pytest.mark.parametrize("name", ["identity", "affine"])
def test_simple_models_print_their_closed_form(tmp_path, name):
    simulator_class = model_class(name)
    simulator = simulator_class(simulator_class.Config())
    with torch.no_grad():
        for parameter, value in zip(simulator.parameters(), (0.62, 0.164), strict=False):
            parameter.fill_(value)
    printer = load_printer(str(save_frozen(simulator, tmp_path / name)), LayoutSettings(size_px=32))
    level = torch.randint(0, 13, (1, 1, 32, 32)).float()
    gain, offset_um = torch.tensor([0.62, 0.164])
    expected = level * 0.1 if name == "identity" else gain * (level * 0.1) + offset_um
    assert torch.equal(printer(level), expected)
    assert printer.level_heights_um() == pytest.approx(expected.new_tensor(
        [0.1 * n if name == "identity" else 0.062 * n + 0.164 for n in range(13)]
    ).tolist(), abs=1e-6)  # fmt: skip


@pytest.mark.parametrize("sigma_um", [0.3, 0.65, 0.825])
def test_a_model_with_an_interior_is_not_asked_for_the_guard_ring(tmp_path, sigma_um):
    simulator_class = model_class("affine-mtf")
    simulator = simulator_class(simulator_class.Config(sigmas_um=(0.1, sigma_um)))
    with torch.no_grad():
        for parameter in simulator.parameters():
            parameter.add_(0.1)
    layout = LayoutSettings(size_px=32)
    printer = load_printer(str(save_frozen(simulator, tmp_path / "mtf")), layout)
    # The guard ring equals the reach (12, 26 and 33 px), whatever the rounding of a division by a pitch of
    # 0.1.
    assert printer.guard_px == simulator.reach_px
    level = torch.randint(0, 13, (1, 1, 32, 32), generator=torch.Generator().manual_seed(0)).float()
    wide = torch.nn.functional.pad(level * 0.1, (60,) * 4)
    with torch.no_grad():
        expected = simulator(wide)[..., 60:-60, 60:-60]
    assert torch.allclose(printer(level), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        # The message is the same in `score`, which does not have this option.
        (
            {"pitch_um": 0.2, "cell_um": 0.4},
            r"pitch_um of the layout, .*--pitch-um 0\.1, or use a model with a pitch of 0\.2 µm$",
        ),
        ({"levels": 16}, "calibrated"),
        ({"level_height_um": 0.08}, "level_height_um"),
    ],
)
def test_layouts_that_the_model_does_not_know_are_refused(affine_folder, change, message):
    with pytest.raises(InputError, match=message):
        load_printer(str(affine_folder), LayoutSettings(size_px=64, **change))


def test_models_of_the_package_have_a_short_name():
    from litho_models.frozen import zoo

    layout = LayoutSettings(size_px=16)
    (name, *_) = zoo.list()
    printer = load_printer(f"zoo:{name}", layout)
    assert printer.weights_sha256() == load_printer(str(zoo.folder(name)), layout).weights_sha256()
    with pytest.raises(InputError, match=f"did you mean zoo:{name}"):
        load_printer(name, layout)
    with pytest.raises(InputError, match="zoo model"):
        load_printer("zoo:nothing", layout)


def test_more_levels_are_a_stated_guess(affine_folder):
    layout = LayoutSettings(size_px=16, levels=16)
    printer = load_printer(str(affine_folder), layout, extrapolate=True)
    assert printer.record().extrapolated
    assert float(printer(torch.full((1, 1, 16, 16), 15.0)).mean()) == pytest.approx(0.62 * 1.5 + 0.164)


@pytest.mark.long
def test_commands_design_score_and_compare(tmp_path, affine_folder):
    from typer.testing import CliRunner

    def call(*arguments):
        result = CliRunner().invoke(app, [str(a) for a in arguments], catch_exceptions=False)
        assert result.exit_code == 0
        return result.output

    design = tmp_path / "design"
    output = call("hoe", "--model", affine_folder, "--target", "ring", "--out", design, *SMALL)
    assert "predicted by the model of the design" in output
    record = Design.read(design)
    assert record.printer.name == "affine"
    # Compare the model on disk before and after.
    assert record.printer.sha256 == load_printer(str(affine_folder), record.layout).weights_sha256()
    # The card of this model does not state its training levels, so extrapolation is unknown.
    assert "extrapolation" not in stroke_advice(record)
    assert "the card of the model affine does not describe" in distribution_warning(record)
    seen = OutOfDistribution(
        level_distance=0.6, flagged=True, extreme_level_share=0.4, training_extreme_level_share=0.001
    )
    rarely = record.model_copy(update={"out_of_distribution": seen})
    assert "0.1 % of the training layouts" in stroke_advice(rarely)
    assert "60 % of the pixels" in distribution_warning(rarely)
    usual = record.model_copy(update={"out_of_distribution": seen.model_copy(update={"flagged": False})})
    assert distribution_warning(usual) == ""
    levels = np.load(design / "layout_level.npy")
    assert levels.shape == (128, 128)
    # The three figures show layout, print and images; the search; and the yield.
    assert (design / "report.html").read_text("utf-8").count("data:image/svg+xml;base64,") == 3
    call("score", design, "--judge", "none", "--judge", f"twin={affine_folder}", "--out", tmp_path / "score")
    judged = json.loads((tmp_path / "score" / "score.json").read_text())
    scores = judged["scores"]
    assert [(s["judge"]["name"], s["independent"]) for s in scores] == [("none", True), ("twin", False)]
    models = f"none,affine={affine_folder}"
    call("compare", "--models", models, "--target", "ring", "--seeds", "1", "--out", tmp_path / "gap", *SMALL)
    gap = json.loads((tmp_path / "gap" / "gap.json").read_text())
    assert gap["schema"] == "litho-design/gap/1"
    assert {entry["arm"] for entry in gap["entries"]} == {"none", "affine"}
    assert {record.run.commit, judged["commit"], gap["commit"]} == {run_facts()["commit"]}


def test_printers_are_given_by_name_or_as_objects(make_printer):
    layout = LayoutSettings(size_px=16)
    own = make_printer(layout, name="own")
    found = load_printers(["none", " flat=none ", own], layout)
    assert [*found] == ["none", "flat", "own"]
    assert found["own"] is own
    for words, message in (([" "], "wanted none, MODEL or NAME"), (["none", "none"], "'none' twice")):
        with pytest.raises(InputError, match=message):
            load_printers(words, layout)


@pytest.mark.parametrize("name", ["../../x", "a/b", "..", "-x", "/x"])
def test_a_name_that_leads_out_of_the_folder_is_refused(make_printer, name):
    layout = LayoutSettings(size_px=16)
    for sources in ([f"{name}=none"], {name: "none"}, [make_printer(layout, name=name)]):
        with pytest.raises(InputError, match=r"^name of a model, got .*, wanted a plain name"):
            load_printers(sources, layout)


def test_a_score_without_a_judge_uses_the_available_models(tmp_path, monkeypatch):
    """Check that a score without a judge uses the available models and states how far they disagree."""
    changes = {"layout.size_px": 48, "optics.distance_um": 8, "search.iterations": 2}
    spreads = ("gain_sd", "offset_sd_um", "blur_sd_um", "defocus_sd_um")
    steady = {f"window.{one}": 0.0 for one in spreads}
    few = {"search.polish_rounds": 0, "window.yield_draws": 2}
    settings = hologram_settings(changes=changes | few | steady)
    known = {"judges": ("none",), "announce": False}
    design = design_hologram("ring", "zoo:physics", tmp_path / "design", settings=settings, **known)
    result = score(tmp_path / "design", tmp_path / "score")
    others = [one for one in JUDGES if one != "physics"]
    assert [one.judge.source for one in result.scores] == [f"{zoo.PREFIX}{one}" for one in others]
    assert all(one.independent for one in result.scores)
    values = [design.predicted["si_psnr_db"], *(one.figures["si_psnr_db"] for one in result.scores)]
    assert design.thick is not None
    prints = {"print": design.predicted, "print, thick element": design.thick, **(design.baselines or {})}
    require_figures_by_column(tmp_path / "design" / "scores.csv", prints)
    require_figures_of_a_design(tmp_path / "design", design)
    judged = {one.judge.name: one.figures for one in result.scores}
    by_judge = {"physics (design)": design.predicted, **judged, **(result.baselines or {})}
    require_figures_by_column(tmp_path / "score" / "scores.csv", by_judge)
    heights = pd.read_csv(tmp_path / "score" / "heights.csv").set_index("printed by")
    for one in result.scores:
        assert one.mean_height_difference_um is not None
        assert one.rms_height_difference_um is not None
        stated_nm = [1000 * one.mean_height_difference_um, 1000 * one.rms_height_difference_um]
        assert heights.loc[one.judge.name].tolist() == pytest.approx(stated_nm)
    page = (tmp_path / "score" / "report.html").read_text("utf-8")
    assert f"{np.median(values):.3g} as the median, and {min(values):.3g} at worst" in page
    said = spread_sentence("si_psnr_db", {"own": 20.0, "other": 18.0, "third": 18.5}, False, 1.5)
    assert "18.5 as the median, and 18 at worst (by other). The models disagree by 2 dB, more than" in said
    assert "disagree" not in spread_sentence("rms_nm", {"own": 4.0, "other": 6.0}, True, 3.0)
    alone = design_hologram("ring", "none", tmp_path / "none", settings=settings, **known)
    assert alone.printer.dataset_sha256 == ""
    with pytest.raises(InputError, match="got no judge"):
        score(tmp_path / "none", tmp_path / "empty")
    # Models of another printer are excluded by their cards before their weights are read.
    foreign = design.printer.model_copy(update={"dataset_sha256": 64 * "f"})
    monkeypatch.setattr("litho_design.printers.source.load_printer", None)
    assert models_at_hand([foreign], settings.layout) == []


def require_figures_of_a_design(folder, design):
    """Check the tables of a design: models, levels, draws, and the distance from the training layouts."""
    tables = {name: pd.read_csv(folder / f"{name}.csv") for name in ("width", "levels", "window", "distance")}
    named = tables["width"].set_index(["layout", "printed by"])
    wanted = {(name, by): own for name, of in design.width.figures.items() for by, own in of.items()}
    assert len(named) == len(wanted) > 2
    for place, figures in wanted.items():
        assert named.loc[place].dropna().to_dict() == pytest.approx(figures)
    assert tables["levels"]["printed_um"].tolist() == pytest.approx(design.stroke.printed_height_um)
    distance = design.out_of_distribution.model_dump(exclude={"flagged", "unusual"})
    assert tables["distance"].loc[0, [*distance]].to_dict() == pytest.approx(distance)
    extreme = np.isin(np.load(folder / "layout_level.npy"), (0, design.layout.levels - 1))
    assert distance["extreme_level_share"] == pytest.approx(extreme.mean())
    # Without variation, each print equals the modelled one, and its loss is that of the search.
    wanted = {"loss": design.polished_loss, **design.predicted}
    assert len(tables["window"]) == 2
    for draw in tables["window"].to_dict("records"):
        assert draw == pytest.approx({name: wanted[name] for name in draw}, rel=1e-4)


@pytest.mark.usefixtures("no_report")
@pytest.mark.parametrize(
    "task",
    [
        ("hoe", "--distance-um", "30"),
        ("lens", "--focal-length-um", "60", "--window-px", "64", "--cell-um", "0.2"),
    ],
)
def test_a_model_of_another_pitch_designs_at_its_own_pitch(tmp_path, monkeypatch, task):
    simulator_class = model_class("affine")
    coarse = save_frozen(simulator_class(simulator_class.Config(pitch_um=0.2)), tmp_path / "coarse")
    common = (
        "--model",
        coarse,
        "--out",
        tmp_path / "d",
        "--size-px",
        96,
        "--pitch-um",
        0.2,
        "--iterations",
        2,
        *FEW,
    )
    monkeypatch.setattr(sys, "argv", ["litho-design", *task, *map(str, common)])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    layout = Design.read(tmp_path / "d").layout
    assert (layout.pitch_um, layout.size_um) == (0.2, pytest.approx(19.2))
    levels = np.load(tmp_path / "d" / "layout_level.npy")
    # The free cells of a hologram, 0.4 µm, are two of these pixels wide. A lens keeps its symmetry.
    same = (levels[::2, ::2], levels[1::2, 1::2]) if task[0] == "hoe" else (levels, levels[::-1].T)
    assert np.array_equal(*same)


def test_a_model_that_changes_itself_is_refused_and_leaves_no_design(
    tmp_path, affine_folder, monkeypatch, capsys
):
    simulator_class = model_class("affine")
    prints = simulator_class.interior

    def interior(self, *arguments, **settings):
        next(self.parameters()).data.add_(1e-6)
        return prints(self, *arguments, **settings)

    monkeypatch.setattr(simulator_class, "interior", interior)
    arguments = ("hoe", "--model", str(affine_folder), "--target", "ring", "--out", str(tmp_path / "d"))
    monkeypatch.setattr(sys, "argv", ["litho-design", *arguments, *SMALL[:4], "--iterations", "1"])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 2
    *_, said = capsys.readouterr().err.splitlines()
    assert "model affine, got weights or buffers that changed" in said
    assert not (tmp_path / "d" / "design.json").exists()


@pytest.mark.usefixtures("no_report")
def test_a_picture_of_another_shape_is_adapted_and_the_adaptation_is_reported(tmp_path, capsys, monkeypatch):
    picture = np.zeros((40, 90), np.uint8)
    picture[10:30, 20:70] = 200
    cv2.imwrite(str(tmp_path / "wide.png"), picture)
    arguments = (
        "hoe",
        "--model",
        "none",
        "--target",
        str(tmp_path / "wide.png"),
        "--out",
        str(tmp_path / "d"),
    )
    monkeypatch.setattr(sys, "argv", ["litho-design", *arguments, *SMALL[:4], "--iterations", "2", *FEW])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    told = "40 x 90 px centred on a black square; resampled from 90 to 128 px"
    assert told in capsys.readouterr().err
    assert Design.read(tmp_path / "d").notes == [f"target {told}"]
    # The picture keeps its proportions: 90 px become 128, and 50 px of light become 71.
    lit = np.load(tmp_path / "d" / "target.npy") > 0.5
    assert abs(lit.any(0).sum() - 50 * 128 / 90) <= 1
    assert abs(lit.any(1).sum() - 20 * 128 / 90) <= 1


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("hoe", "--model", "nowhere", "--out", "out"), "nowhere"),
        (("hoe", "--model", "none", "--target", "note.txt", "--out", "out"), "an image"),
        (("hoe", "--model", "none", "--size-px", "1022", "--out", "out"), "cell_um"),
        (("hoe", "--model", "none", "--levels", "1", "--out", "out"), "levels"),
        (
            ("hoe", "--model", "none", *SMALL[:2], "--distance-um", "0.01", "--out", "out"),
            "propagation distance",
        ),
        (("score", "nowhere", "--judge", "none", "--out", "out"), "nowhere"),
        (("compare", "--models", "none,none", "--out", "out"), "twice"),
        (("compare", "--models", "none", *SMALL[:2], "--seeds", "0", "--out", "out"), "at least one"),
        (("hoe", "--model", "none", "--target", "black.png", "--out", "out"), "without any light"),
        (("hoe", "--model", "none", "--target", "nan.tif", "--out", "out"), "not numbers"),
        (("hoe", "--model", "coarse", "--out", "out"), "got 0.1 µm, wanted 0.2 µm, with which"),
        (
            ("hoe", "--model", "affine", "--levels", "16", "--out", "out"),
            "up to which the model was calibrated",
        ),
        (
            ("hoe", "--model", "affine", "--level-height-um", "0.13", "--out", "out"),
            "with which the model was",
        ),
        (("hoe", "--model", "none", "--start", "fresnel", "--size-px", "64", "--out", "out"), "'fresnel'"),
        (("hoe", "--model", "none", "--risk-tail", "0", "--out", "out"), "tail"),
        (("hoe", "--model", "none", "--spread-of", "no.zarr", "--out", "out"), "no.zarr"),
        (("hoe", "--model", "none", "--judge", "b=nowhere", "--out", "out"), "nowhere"),
        (
            ("lens", "--model", "none", *SMALL[:2], "--focal-length-um", "0.02", "--out", "out"),
            "propagation distance",
        ),
        (("hoe", "--model", "none", "--device", "abacus", "--out", "out"), "'abacus'"),
        (("hoe", "--model", "none", "--device", "cuda:99", "--out", "out"), "'cuda:99'"),
        (("lens", "--model", "none", "--size-px", "127", "--out", "out"), "even number"),
        (("lens", "--model", "none", "--start", "gs", "--out", "out"), "'gs'"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, monkeypatch, refused, arguments, words):
    (tmp_path / "note.txt").write_text("words")
    black = np.zeros((64, 64), np.uint8)
    cv2.imwrite(str(tmp_path / "black.png"), black)
    tifffile.imwrite(tmp_path / "nan.tif", np.full((64, 64), np.nan, np.float32))
    for name, pitch_um in (("affine", 0.1), ("coarse", 0.2)):
        simulator_class = model_class("affine")
        save_frozen(simulator_class(simulator_class.Config(pitch_um=pitch_um)), tmp_path / name)
    monkeypatch.chdir(tmp_path)
    assert words in refused(*arguments)
    assert not (tmp_path / "out").exists()
