"""Provide a small closed-form printer and settings with which a design takes a second."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import pytest
import torch
import torch.nn.functional as F
from torch import nn

from litho_design.cli.app import main
from litho_design.holograms.settings import HologramSettings, hologram_settings
from litho_design.optics import Optics
from litho_design.optimisation.process_window import ProcessWindow
from litho_design.printers.layout import LayoutSettings
from litho_design.printers.printer import Printer


class BlurPrinter(nn.Module):
    """Predict ``gain * blurred + offset_um``, where ``blurred`` is the layout convolved with a Gaussian. The
    interface is that of a frozen model.
    """

    def __init__(self, sigma_um=0.2, gain=0.62, offset_um=0.164, pitch_um=0.1, name="blur"):
        super().__init__()
        self.name = name
        self.gain = nn.Parameter(torch.tensor(gain))
        self.offset_um = nn.Parameter(torch.tensor(offset_um))
        half = math.ceil(4 * sigma_um / pitch_um)
        self.reach_um, self.guard_px = half * pitch_um, half
        x = torch.arange(-half, half + 1) * pitch_um
        kernel = torch.exp(-(x**2) / (2 * sigma_um**2))
        self.register_buffer("kernel", kernel / kernel.sum())

    def forward(self, layout_um, pitch_um=0.1):
        half = len(self.kernel) // 2
        padded = F.pad(layout_um, (half,) * 4, mode="replicate")
        rows = F.conv2d(padded, self.kernel.view(1, 1, 1, -1))
        return self.gain * F.conv2d(rows, self.kernel.view(1, 1, -1, 1)) + self.offset_um


@pytest.fixture(scope="session")
def make_printer():
    def make(layout: LayoutSettings, **arguments) -> Printer:
        return Printer(BlurPrinter(**arguments), layout, source="closed form")

    return make


@pytest.fixture(scope="session")
def small_settings() -> HologramSettings:
    """Return settings for a hologram that is 12.8 µm wide and has its image at a distance of 30 µm. The
    search has 30 iterations and starts at random.

    The start is far from the optimum. The yield uses ten prints, because a hundred would take too long.
    """
    default = hologram_settings("default")
    return default.model_copy(
        update={
            "layout": LayoutSettings(size_px=128),
            "optics": Optics(distance_um=30.0),
            "search": default.search.model_copy(
                update={"start": "random", "iterations": 30, "checkpoint_every": 10, "polish_rounds": 3}
            ),
            "window": ProcessWindow(yield_draws=10),
        }
    )


@contextmanager
def unreported() -> Iterator[None]:
    """Leave reports of designs unwritten. They take longer than small designs and have their own tests."""

    def unwritten(folder, *_):
        (folder / "report.html").write_text("")

    place = "litho_design.workflows.{}.write_design_report"
    with patch(place.format("design"), unwritten), patch(place.format("compare"), unwritten):
        yield


@pytest.fixture
def no_report():
    with unreported():
        yield


@pytest.fixture(autouse=True)
def one_thread():
    """Use one thread, because results are bit-identical only for a fixed number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def refused(monkeypatch, capsys):
    """Return a function that runs ``litho-design`` with bad arguments and returns its one-line error."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["litho-design", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        assert stop.value.code == 2
        # On a busy machine, a command reports after some seconds that it is at work.
        lines = [line for line in capsys.readouterr().err.splitlines() if "is at work" not in line]
        said = "\n".join(lines).strip()
        assert len(said.splitlines()) == 1
        return said

    return call
