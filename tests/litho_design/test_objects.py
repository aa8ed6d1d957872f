"""Test objects that the user provides for a lens: conversion, split, identity and refusals."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest
import torch

from litho_data.foundation.errors import InputError
from litho_data.foundation.hashes import file_sha256
from litho_design.cli.app import main
from litho_design.images.targets import draw_target, object_name
from litho_design.judging.gap import GapResult
from litho_design.lenses.objects import PICTURES, object_stack, read_object, with_objects
from litho_design.lenses.settings import lens_settings
from litho_design.lenses.task import LensTask, lens_task
from litho_design.optics import Optics
from litho_design.printers.layout import LayoutSettings
from litho_design.tasks.design import HEIGHT_FILE, Design, read_array
from litho_design.workflows.design import design_lens
from litho_design.workflows.score import score as score_design

pytestmark = pytest.mark.usefixtures("no_report")
SMALL = (
    *("--size-px", "128", "--window-px", "64", "--object-px", "32", "--iterations", "2"),
    *("--model", "none", "--task", "computational", "--focal-length-um", "40", "--yield-draws", "5"),
)


@pytest.fixture
def settings():
    default = lens_settings("computational")
    return default.model_copy(
        update={
            "layout": LayoutSettings(size_px=128, cell_um=0.1, symmetry="radial"),
            "optics": Optics(distance_um=40.0),
            "search": default.search.model_copy(
                update={"iterations": 3, "checkpoint_every": 1, "polish_rounds": 0}
            ),
            "view": default.view.model_copy(update={"window_px": 64}),
            "imaging": default.imaging.model_copy(update={"object_px": 32, "iterations": 5}),
            "window": default.window.model_copy(update={"yield_draws": 5}),
        }
    )


@pytest.fixture
def folder(tmp_path):
    """Write five pictures. Their alphabetical order differs from the order in which they are written."""
    place = tmp_path / "pictures"
    place.mkdir()
    for seed, name in enumerate("cebda"):
        picture = np.random.default_rng(seed).integers(20, 200, (24, 24)).astype(np.uint8)
        cv2.imwrite(str(place / f"{name}.png"), picture)
    (place / ".hidden").write_text("not a picture")
    return place


def test_drawings_and_pictures_have_a_dark_border(folder, settings):
    brought, inputs = with_objects(settings, [folder / "a.png"], [folder / "b.png", folder / "c.png"])
    ring, picture = object_stack(("ring", *brought.imaging.objects), 32, inputs[PICTURES])
    inside = slice(4, 28)
    assert torch.equal(ring[inside, inside], torch.from_numpy(draw_target("ring", 24)))
    grey = cv2.imread(str(folder / "a.png"), cv2.IMREAD_GRAYSCALE).astype(np.float32)
    assert torch.equal(picture[inside, inside], torch.from_numpy(grey / grey.max()))
    for whole in (ring, picture):
        assert torch.count_nonzero(whole) == torch.count_nonzero(whole[inside, inside])


def test_a_picture_is_converted_as_its_record_says(tmp_path, settings):
    # The picture is red and twice as wide as high. It becomes a square of 48 px with dark bands above and
    # below, and then one of 24 px.
    colour = np.zeros((24, 48, 3), np.uint8)
    colour[:, :24, 2], colour[:, 24:, 2] = 200, 100
    cv2.imwrite(str(tmp_path / "wide.png"), colour)
    grey = np.full((24, 24), 7, np.uint16)
    grey[0, 0] = 70
    cv2.imwrite(str(tmp_path / "deep.png"), grey)
    brought, inputs = with_objects(settings, [], [tmp_path / "wide.png", tmp_path / "deep.png"])
    wide, deep = brought.imaging.test_objects
    assert brought.imaging.objects == settings.imaging.objects
    assert (wide.name, wide.sha256) == ("wide.png", file_sha256(tmp_path / "wide.png"))
    assert wide.adaptation == (
        "colour to grey (ITU-R BT.601 luma); 24 x 48 px centred on a black square; resampled from 48 to "
        "24 px; divided by its brightest value; dark border of 4 px"
    )
    assert deep.adaptation == "divided by its brightest value; dark border of 4 px"
    seen, dark = inputs[PICTURES]
    assert seen.shape == (32, 32)
    # In 12 of the 24 rows, the left half is bright and the right half is half as bright: the luma is 59.8 or
    # 29.9. A decoder may round or truncate its counts, by one in 59.
    assert np.allclose(seen[10:22, 4:16], 1)
    assert np.allclose(seen[10:22, 16:28], 0.5, atol=1 / 59)
    assert seen.sum() == pytest.approx(seen[10:22, 4:28].sum())
    assert dark[4, 4] == 1
    assert np.allclose(dark[10:20, 10:20], 0.1)


@pytest.mark.parametrize(("count", "held_out"), [(3, 2), (5, 2), (8, 2), (12, 3)])
def test_the_last_quarter_by_name_is_held_out(tmp_path, settings, count, held_out):
    for index in reversed(range(count)):
        picture = np.random.default_rng(index).integers(0, 255, (24, 24)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"{index:02d}.png"), picture)
    imaging = with_objects(settings, [tmp_path], [])[0].imaging
    names = [f"{index:02d}.png" for index in range(count)]
    assert [object_name(item) for item in imaging.objects] == names[:-held_out]
    assert [object_name(item) for item in imaging.test_objects] == names[-held_out:]


def test_transparent_pixels_are_dark(tmp_path):
    """Check a logo that is white everywhere and has its shape in the alpha channel."""
    shape = np.zeros((40, 40), np.uint8)
    shape[8:16, 4:30] = 255
    logo = np.dstack([np.full((40, 40, 3), 255, np.uint8), shape])
    cv2.imwrite(str(tmp_path / "logo.png"), logo)
    cv2.imwrite(str(tmp_path / "grey.png"), shape)
    np.testing.assert_allclose(*(read_object(tmp_path / f"{name}.png", 20)[0] for name in ("logo", "grey")))


def test_a_design_with_pictures_is_scored_without_their_files(tmp_path, folder, settings, make_printer):
    printer = make_printer(settings.layout)
    design = design_lens(printer, tmp_path / "d", settings=settings, objects=[folder], announce=False)
    assert "the held-out objects are d.png, e.png" in design.notes[-1]
    told = design.settings["imaging"]
    assert [item["name"] for item in told["objects"]] == ["a.png", "b.png", "c.png"]
    assert [item["sha256"] for item in told["test_objects"]] == [
        file_sha256(folder / "d.png"), file_sha256(folder / "e.png")
    ]  # fmt: skip
    for file in folder.iterdir():
        file.unlink()
    own = score_design(tmp_path / "d", tmp_path / "score", judges=[printer]).scores[0]
    assert own.figures == pytest.approx(design.predicted, rel=1e-5)
    # The same print images the built-in drawings with a different error.
    drawn = lens_task(settings, printer).score(torch.from_numpy(read_array(tmp_path / "d", HEIGHT_FILE)))
    assert drawn.mae_calibrated != pytest.approx(design.predicted["mae_calibrated"], rel=0.01)


def test_another_set_of_objects_is_another_design(tmp_path, folder, settings, make_printer, monkeypatch):
    printer = make_printer(settings.layout)
    one_less = [folder / f"{name}.png" for name in "abde"]

    def design(place, objects):
        design_lens(printer, tmp_path / place, settings=settings, objects=objects, announce=False)

    def stop(self, level, height_um):
        raise KeyboardInterrupt

    design("done", [folder])
    with pytest.raises(InputError, match="other settings"):
        design("done", one_less)
    with monkeypatch.context() as cut:
        cut.setattr(LensTask, "arrays", stop)
        with pytest.raises(KeyboardInterrupt):
            design("cut", [folder])
    with pytest.raises(InputError, match="other settings"):
        design("cut", one_less)
    # A picture with the same name but other pixels is another object too.
    cv2.imwrite(str(folder / "a.png"), np.eye(24, dtype=np.uint8))
    with pytest.raises(InputError, match="other settings"):
        design("done", [folder])


def test_pixels_must_belong_to_the_settings(folder, settings, make_printer):
    brought, inputs = with_objects(settings, [folder], [])
    with pytest.raises(InputError, match=r"object a\.png, got no pixels"):
        lens_task(brought, make_printer(settings.layout))
    wider = brought.model_copy(update={"imaging": brought.imaging.model_copy(update={"object_px": 48})})
    with pytest.raises(InputError, match=r"pixels of shape \(32, 32\)"):
        lens_task(wider, make_printer(settings.layout), inputs=inputs)


def test_commands_take_objects(tmp_path, folder, monkeypatch, capsys):
    def run(*words):
        monkeypatch.setattr(sys, "argv", ["litho-design", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 0
        return capsys.readouterr()

    split = ("--objects", folder / "c.png", "--objects", folder / "a.png", "--held-out-objects")
    split = (*split, folder / "b.png", "--held-out-objects", folder / "d.png")
    told = run("lens", *SMALL, *split, "--out", tmp_path / "d")
    assert "design are c.png, a.png; the held-out objects are b.png, d.png" in told.err
    assert "MAE" in told.out
    imaging = Design.read(tmp_path / "d").settings["imaging"]
    run(
        "compare", "--models", "none", "--task", "lens-computational", "--seeds", "1", *SMALL[:8],
        "--distance-um", "40", *split, "--out", tmp_path / "gap",
    )  # fmt: skip
    compared = GapResult.read(tmp_path / "gap").settings.imaging
    assert compared.model_dump(mode="json") == imaging


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (("--objects", "note.txt"), "note.txt"),
        (("--objects", "nowhere"), "nowhere"),
        (("--objects", "empty"), "an empty folder"),
        (("--objects", "mixed"), "note.txt"),
        (("--objects", "pictures/a.png"), "got 0 for the design"),
        (("--objects", "pictures/a.png", "--objects", "pictures/b.png"), "0 for the design and 2 held out"),
        (("--objects", "pictures", "--held-out-objects", "extra.png"), "1 held out"),
        (("--objects", "pictures", "--held-out-objects", "pictures/a.png"), "given twice"),
        (("--objects", "black.png"), "without any light"),
        (("--objects", "pictures", "--task", "direct"), "does not image objects"),
        (("--objects", "pictures", "compare"), "the hoe task"),
    ],
)  # fmt: skip
def test_bad_objects_are_one_line_and_exit_code_2(tmp_path, folder, monkeypatch, refused, words, complaint):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "note.txt").write_text("words")
    (tmp_path / "empty").mkdir()
    (tmp_path / "mixed").mkdir()
    (tmp_path / "mixed" / "note.txt").write_text("words")
    cv2.imwrite("black.png", np.zeros((24, 24), np.uint8))
    cv2.imwrite("extra.png", np.eye(24, dtype=np.uint8) * 200)
    command = ["lens", *SMALL, *words]
    if words[-1] == "compare":
        command = ["compare", "--models", "none", "--size-px", "128", *words[:-1]]
    assert complaint in refused(*command, "--out", "out")
    assert not (tmp_path / "out").exists()
