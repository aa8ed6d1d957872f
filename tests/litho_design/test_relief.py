"""Test the search for a layout whose print is a target relief."""

from __future__ import annotations

import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import tifffile
import torch

from litho_data.foundation.errors import InputError
from litho_design import correct, load_design
from litho_design.cli.app import main
from litho_design.images.measurements import MeasuredSource
from litho_design.judging.measured import measured_print
from litho_design.optimisation.process_window import measure_yield
from litho_design.reliefs.settings import relief_settings
from litho_design.reliefs.targets import load_relief
from litho_design.reliefs.task import ReliefTask
from litho_design.reports.advice import width_sentence
from litho_design.tasks.run import best_layout

TINY = {
    "layout.size_px": 48,
    "layout.cell_um": 0.2,
    "search.iterations": 60,
    "search.polish_rounds": 20,
}


@pytest.mark.usefixtures("no_report")
def test_a_relief_that_a_layout_prints_is_printed(tmp_path, make_printer):
    settings = relief_settings(TINY)
    printer = make_printer(settings.layout, sigma_um=0.15)
    cells = torch.from_numpy(np.random.default_rng(0).integers(2, 11, (24, 24))).float()
    with torch.no_grad():
        printed = printer(cells.repeat_interleave(2, 0).repeat_interleave(2, 1)[None, None])[0, 0].numpy()
    made = correct(printed - 0.4, printer, tmp_path, settings=settings, announce=False)
    # The zero of a relief may shift by whole levels, which are 62 nm high in print.
    levels_off = (made.predicted["offset_nm"] - 400) / 62
    assert levels_off == pytest.approx(round(levels_off), abs=0.1)
    # A cell that is one level off is wrong by 62 nm. For a tenth of the cells, the blurred error is 6 nm.
    assert made.predicted["rms_nm"] < 6
    assert made.baselines["free levels"]["rms_nm"] < 6
    assert made.baselines["best affine"]["rms_nm"] > 3 * made.predicted["rms_nm"]
    assert made.baselines["uncorrected"]["rms_nm"] > made.baselines["best affine"]["rms_nm"]
    # The design can be scored again from its folder, like any other design.
    loaded = load_design(tmp_path)
    assert loaded.score(loaded.expected_um).rms_nm == pytest.approx(made.predicted["rms_nm"], rel=1e-4)
    assert np.abs(np.load(tmp_path / "unprintable_um.npy")).mean() < 0.006


def test_the_baselines_use_nominal_heights_and_the_best_gain_and_offset(make_printer):
    """Check the baselines of a printer with a gain of 1/2, an offset of 0.1 µm and no blur. They can be
    computed by hand.
    """
    settings = relief_settings({"layout.size_px": 48, "layout.levels": 13})
    printer = make_printer(settings.layout, sigma_um=1e-3, gain=0.5, offset_um=0.1)
    wanted = np.repeat(0.1 * (np.arange(48) // 12), 48).reshape(48, 48).astype(np.float32)
    found = ReliefTask(settings, printer, inputs={"relief_um": wanted}).untouched()
    # Levels 0 to 3 stay as they are, and are not shifted to the middle of the range.
    assert torch.equal(found["uncorrected"], torch.from_numpy(np.rint(wanted / 0.1)).long())
    # Steps of two levels, starting at any level, print the relief to float precision.
    task = ReliefTask(settings, printer, inputs={"relief_um": wanted})
    baselines = {name: task.figures(task.printed_um(level)) for name, level in found.items()}
    assert baselines["best affine"]["rms_nm"] < 1e-3
    assert baselines["uncorrected"]["rms_nm"] == pytest.approx(0.5e3 * wanted.std(), rel=1e-4)
    # A relief on a base of 0.3 µm keeps this base. A relief that extends below 0 is lifted to 0.
    for shift_um, foot in ((0.3, 3), (-0.2, 0)):
        task = ReliefTask(settings, printer, inputs={"relief_um": wanted + np.float32(shift_um)})
        assert int(task.untouched()["uncorrected"].min()) == foot


@pytest.mark.usefixtures("no_report")
def test_no_correction_is_returned_if_the_available_models_prefer_it(tmp_path, make_printer):
    """Check a model with a gain of 0.4, which corrects by a factor of 2.5. Two judges print nearly the
    nominal heights.
    """
    settings = relief_settings({"layout.size_px": 48, "search.iterations": 10, "height_um": 0.4})
    layout = settings.layout
    model = make_printer(layout, sigma_um=0.05, gain=0.4, offset_um=0.0, name="low")
    judges = [
        make_printer(layout, sigma_um=0.05, gain=gain, offset_um=0.0, name=f"j{gain}") for gain in (1.0, 1.1)
    ]
    fit = {"settings": settings, "announce": False}
    alone = correct("staircase", model, tmp_path / "alone", judges=(), **fit)
    assert alone.width.returned == "searched"
    judged = correct("staircase", model, tmp_path / "judged", judges=judges, robust=False, **fit)
    width = judged.width
    assert width.returned == "uncorrected"
    assert list(width.level_heights_um) == ["low", "j1.0", "j1.1"]
    # The steps are between levels, so rounding loses a third of a step. The errors of the judges are at most
    # this and a tenth.
    assert width.values("searched").max() > 3 * np.delete(width.values(), 0).max()
    assert "available models print the layout “uncorrected” better" in judged.notes[-1]
    said = width_sentence(judged)
    assert "3 models of this printer" in said
    assert "level 12 (0.480 to 1.320 µm)" in said
    # If the search minimises the worst error, the layout is a compromise that is better than both.
    robust = correct("staircase", model, tmp_path / "robust", judges=judges, **fit)
    assert robust.width.searched_with == 3
    assert robust.width.values().max() <= min(width.values().max(), width.values("best affine").max()) + 1e-3


def test_the_offset_of_a_print_does_not_affect_the_yield(make_printer):
    changes = {"window.gain_sd": 0.0, "window.blur_sd_um": 0.0, "window.offset_sd_um": 0.5}
    settings = relief_settings(TINY | changes)
    printer = make_printer(settings.layout)
    with torch.no_grad():
        printed = printer(torch.arange(48).float().div(4).floor().repeat(48, 1)[None, None])[0, 0]
    wanted = (printed + 0.01 * torch.cos(torch.arange(48.0))).numpy()

    def passed(window):
        task = ReliefTask(
            settings.model_copy(update={"window": window}), printer, inputs={"relief_um": wanted}
        )
        drawn = task.window_scores(printed, 20)
        return drawn, measure_yield(drawn, task.score(printed).model_dump(), task.errors)

    drawn, found = passed(settings.window)
    assert found.share == 1
    assert {"rms_nm", "mae_nm", "p95_nm"} == set(found.figures)
    # The error is 10 nm / sqrt(2), whatever the offset. Float32 is exact to 1e-4 nm.
    assert [one["rms_nm"] for one in drawn] == pytest.approx(
        [1e3 * (printed.numpy() - wanted).std()] * 20, abs=0.01
    )
    # A gain does matter: 5 % of a staircase of 0.2 µm rms is more than the modelled error.
    assert passed(settings.window.model_copy(update={"gain_sd": 0.05}))[1].share < 0.5


@pytest.mark.usefixtures("no_report")
def test_a_second_round_subtracts_the_error_of_the_first_print(tmp_path, make_printer, refused):
    """Check a second round for a printer whose gain falls by 20 % across the field. The gain of the model is
    constant.
    """
    settings = relief_settings(TINY | {"off_blur_um": 0.2})
    model = make_printer(settings.layout, sigma_um=0.15)
    cells = torch.from_numpy(np.random.default_rng(0).integers(3, 10, (24, 24))).float()
    pixels = cells.repeat_interleave(2, 0).repeat_interleave(2, 1)[None, None]
    side = torch.linspace(1.1, 0.9, 48)

    def printed_um(folder):
        levels = torch.from_numpy(np.load(folder / "layout_level.npy"))[None, None].float()
        with torch.no_grad():
            return (side * model(levels)[0, 0]).numpy()

    with torch.no_grad():
        wanted = model(pixels)[0, 0].numpy()
    first, again = tmp_path / "first", tmp_path / "again"
    correct(wanted, model, first, settings=settings, announce=False)
    np.savetxt(tmp_path / "scan.txt", printed_um(first) * 1e-6)
    scan = MeasuredSource(tmp_path / "scan.txt", "m", (4.8, 4.8), "none", aligned=True)
    made = correct(wanted, model, again, settings=settings, after=first, scan=scan, announce=False)

    def rms_nm(folder):
        return 1e3 * (printed_um(folder) - wanted).std()

    # The error due to levels remains, 62 nm for a tenth of the cells. The tilt of 50 nm rms is removed.
    assert rms_nm(first) > 20
    assert rms_nm(again) < rms_nm(first) / 3
    # The scores compare the expected real print with the target relief, and a measured print likewise.
    expected = np.load(again / "predicted_height_um.npy")
    assert made.predicted["rms_nm"] == pytest.approx(1e3 * (expected - wanted).std(), rel=1e-4)
    assert made.predicted["rms_nm"] == pytest.approx(rms_nm(again), abs=2)
    printed = torch.from_numpy(np.asarray(printed_um(again)))
    assert load_design(again).score(printed).rms_nm == pytest.approx(rms_nm(again), rel=1e-4)
    # Such a small element cannot be registered, and a scan of another size does not match its pixels.
    with pytest.raises(InputError, match="--scan-aligned"):
        measured_print(load_design(first), replace(scan, aligned=False))
    with pytest.raises(InputError, match="pixels of the element"):
        measured_print(load_design(first), replace(scan, size_um=(5.0, 5.0)))
    with pytest.raises(InputError, match="--after and --scan"):
        correct(wanted, model, tmp_path / "no", settings=settings, after=first)
    other = relief_settings(TINY | {"layout.size_px": 44})
    with pytest.raises(InputError, match="another layout"):
        correct(wanted[:44, :44], model, tmp_path / "no", settings=other, after=first, scan=scan)
    words = ["correct", "lens", "--model", "none", "--size-px", "48", "--out", tmp_path / "no"]
    assert "a scan without its element" in refused(*words, "--scan", tmp_path / "scan.txt")


def test_every_model_learns_from_the_first_print(make_printer):
    """Check that every model predicts the first layout as it was printed, apart from its mean height, and
    that scores, width and gain follow from these predictions.
    """
    settings = relief_settings(TINY | {"off_blur_um": 0.0})
    generator = np.random.default_rng(0)
    level = np.repeat(np.repeat(generator.integers(0, 13, (24, 24)), 2, 0), 2, 1).astype(np.uint8)
    printed, wanted = generator.random((2, 48, 48)).astype(np.float32)
    models = [make_printer(settings.layout, gain=gain, name=str(gain)) for gain in (0.5, 0.6, 0.7)]
    inputs = {"relief_um": wanted, "first_level": level, "first_print_um": printed}
    task = ReliefTask(settings, models[0], inputs=inputs, ensemble=models[1:2])
    task.judges = models[2:]
    for one in models:
        off = task.printed_um(torch.from_numpy(level), one).numpy() - printed
        assert off == pytest.approx(off.mean(), abs=1e-6)
    # The models agree on the error of the first layout, which is that of the measured print.
    rms_nm = 1e3 * (printed - wanted).std()
    width = best_layout(task, torch.from_numpy(level).long())[1]
    assert width.values("searched") == pytest.approx([rms_nm] * 3, rel=1e-4)
    assert float(task.objective(torch.from_numpy(level)[None, None].float())[0]) == pytest.approx(
        1e-3 * rms_nm, rel=1e-4
    )
    # Another model in the first place does not change the expectation of any model.
    other = ReliefTask(settings, models[1], inputs=inputs)
    assert torch.equal(*(one.printed_um(torch.from_numpy(level), models[1]) for one in (task, other)))


def test_the_part_of_a_relief_that_no_layout_prints_is_shown(tmp_path, monkeypatch, capsys):
    """Check a relief that cannot be printed: its steps are one pixel wide, and some heights lie beyond the
    levels.
    """
    words = ["correct", "staircase", "--model", "zoo:physics", "--size-px", "48", "--iterations", "10"]
    words += ["--set", "search.polish_rounds=0", "--set", "window.yield_draws=2", "--height-um", "1.5"]
    words += ["--judge", "none", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(sys, "argv", ["litho-design", *words])
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 0
    said = capsys.readouterr()
    assert "the levels print only 0.841 µm" in said.err
    assert "use --height-um 0.84" in said.err
    assert "free levels" in said.out
    assert "nm rms error" in said.out
    rest = np.load(tmp_path / "out" / "unprintable_um.npy")
    assert rest.std() > 0.02
    assert rest.mean() == pytest.approx(0, abs=1e-5)


def test_reliefs_are_read_in_micrometres(tmp_path):
    layout = relief_settings(TINY).layout
    heights = np.random.default_rng(0).random((48, 48)).astype(np.float32)
    tifffile.imwrite(tmp_path / "a.tif", heights)
    assert np.array_equal(load_relief(tmp_path / "a.tif", layout, 0.5)[0], heights)
    cv2.imwrite(str(tmp_path / "a.png"), np.round(60000 * heights / heights.max()).astype(np.uint16))
    grey, record = load_relief(tmp_path / "a.png", layout, 0.5)
    assert grey == pytest.approx(0.5 * heights / heights.max(), abs=1e-5)
    assert "0.5 µm" in record.adaptation
    for name, content in (
        ("other.tif", b"not a TIFF"),
        ("cut.tif", (tmp_path / "a.tif").read_bytes()[:5000]),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match=name):
            load_relief(tmp_path / name, layout, 0.5)
    with pytest.raises(InputError, match="48"):
        load_relief(heights[:40], layout, 0.5)
    with pytest.raises(InputError, match="staircase"):
        load_relief("hill", layout, 0.5)
    with pytest.raises(InputError, match="equal"):
        load_relief(np.zeros((48, 48)), layout, 0.5)
