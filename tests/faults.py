"""Put small faults into a copy of the project, one at a time, and check that the named tests catch each of
them.

``python -m tests.faults [WORDS]`` tries the faults whose name contains one of the words; without words it
tries all. It exits with 1 if any fault is not caught. It takes minutes, so the test suite does not run it.
Each fault is tried in a fork of a process that has already loaded the libraries of the project.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
PARTS = (
    "litho_data",
    "litho_models",
    "litho_design",
    "tests",
    "benchmarks",
    "datasets",
    "docs",
    "pyproject.toml",
)
_MYPY = [sys.executable, "-m", "mypy", *(word for part in PARTS[:3] for word in ("-p", part))]
PRELOADED = ["torch", "scipy.optimize", "scipy.stats", "xarray", "zarr", "pandas", "matplotlib.figure"]


class Fault(NamedTuple):
    """Describe a fault: the changed file, its right and wrong text, and the tests that must notice."""

    name: str
    file: str
    right: str
    wrong: str
    tests: str


AXES, WHOLE = "tests/litho_data/test_axes.py", "tests/litho_data/test_whole_store.py"
BEGUN, OPTICS = "tests/litho_data/test_begun.py", "tests/litho_design/test_propagation_laws.py"
CHECK = "tests/litho_models/test_check.py -k small"
RUN, NEXT = "tests/litho_models/test_loop_run.py", "tests/litho_models/test_next_print.py"
FAULTS = [
    # Axes and half pixels.
    Fault("a canvas half a pixel off", "litho_data/virtual_fab/canvas.py",
          "shape[1]) - GUARD_PX + 0.5)", "shape[1]) - GUARD_PX)", AXES),
    Fault("a canvas with its height as width", "litho_data/virtual_fab/canvas.py",
          "self.x_um - width_um / 2", "self.x_um - height_um / 2", AXES),
    Fault("pitch of a bent scan transposed", "litho_data/register/scan.py",
          "nx * self.scan_pitch_um[1], ny * self.scan_pitch_um[0]",
          "nx * self.scan_pitch_um[0], ny * self.scan_pitch_um[1]", AXES),
    Fault("frame of a stored bend transposed", "litho_data/register/bend.py",
          "scan_shape[1] * scan_pitch_um[1], scan_shape[0] * scan_pitch_um[0]",
          "scan_shape[1] * scan_pitch_um[0], scan_shape[0] * scan_pitch_um[1]", AXES),
    Fault("band of a target of another size", "litho_design/optics/angular_spectrum.py",
          "(there - here) * pitch / 2", "(here - there) * pitch / 2", f"{OPTICS} -k band"),
    Fault("room of a target of another size", "litho_design/optics/angular_spectrum.py",
          "(length - (here + there) / 2)", "(length - here)", f"{OPTICS} -k band"),
    Fault("separations of a target of another size", "litho_design/optics/convolution.py",
          "torch.where(index < there, index, index - length)",
          "torch.where(index < here, index, index - length)", f"{OPTICS} -k separation"),
    Fault("a decimetre", "litho_data/foundation/units.py", '"dm": 1e5', '"dm": 1e4', AXES),
    # Cache keys.
    Fault("the key of a layout is its shape", "litho_data/virtual_fab/simulate.py",
          'array_sha256(job.level, "level", ("y", "x"))', "list(job.level.shape)",
          "tests/litho_data/test_scan_key.py"),
    Fault("a key of pairs without the card", "litho_data/exchange/pairs.py",
          "self.order, card, operation", "self.order, operation", "tests/litho_data/test_pairs.py -k begun"),
    Fault("a key of a scan by its arrays only", "litho_data/store/printed_scan.py",
          "return {one.name: _hashed(getattr(value, one.name)) for one in fields(value)}",
          "return [_hashed(value.mask_level), _hashed(value.height_um), _hashed(value.valid)]",
          "tests/litho_data/test_scan_key.py"),
    # Checks that refuse input or leave scans out.
    Fault("an error that the fit has made small is judged", "litho_models/monitoring/check.py",
          'if figure.name != "error" or not optimistic]', "if figure.name]", CHECK),
    Fault("a path that leaves its folder by a/../../b", "litho_data/cards/card.py",
          '".." in parts', 'parts[0] == ".."', "tests/litho_data/test_card.py"),
    Fault("a scan without its order is accepted", "litho_data/cards/listing.py",
          'any("order" in row for row in table.values()):\n        return', "False:\n        return",
          "tests/litho_data/test_listing.py"),
    Fault("a store's name may be a path", "litho_data/store/contract.py",
          'require_plain_name(f"name of {path}", name)', "name", "tests/litho_data/test_release.py"),
    Fault("a level above the highest is accepted", "litho_data/store/contract.py",
          "if highest >= levels", "if highest > levels", WHOLE),
    Fault("the stated hash in place of the computed one", "litho_data/store/read.py",
          "return self.computed_sha256()\n\n    @property",
          'return str(self.root.attrs["dataset_sha256"])\n\n    @property', f"{WHOLE} -k hash"),
    Fault("chunks of zeros without a file", "litho_data/store/write.py",
          '"write_empty_chunks": True', '"write_empty_chunks": False', f"{WHOLE} -k every_chunk"),
    Fault("a gain is judged by the upper end of its interval", "litho_models/loop/judging.py",
          "low, _ = bootstrap_interval", "_, low = bootstrap_interval",
          "tests/litho_models/test_loop_search.py -k reason"),
    Fault("the inverse of the prints' information", "litho_models/planning/open_questions.py",
          "information = stands_for * ", "information = 1 / stands_for * ", f"{NEXT} -k know"),
    # Folders whose writing was begun but not finished.
    Fault("no mark of a begun folder", "litho_data/foundation/begun.py",
          "mark = Path(out), Path(out) / BEGUN", 'mark = Path(out), Path(out) / "other"', BEGUN),
    Fault("an older folder is not put back", "litho_data/foundation/files.py",
          "        old.replace(target)\n    shutil", "        pass\n    shutil",
          f"{BEGUN} tests/litho_data/test_files.py"),
    Fault("leftovers remain", "litho_data/foundation/begun.py", "clear_leftovers(folder)", "pass", BEGUN),
    Fault("a loop's settings lack the further prints", "litho_models/loop/run.py",
          '"new_prints": list(decided_by)', '"new_prints": []', f"{RUN} -k other_settings"),
    Fault("kept tiles of another seed are used", "litho_models/planning/run.py",
          "**asked})[:16]", "**(asked | {'seed': 0})})[:16]", f"{NEXT} -k resumes"),
    # Leaks of held-out data.
    Fault("lines from the scan's own fold", "litho_models/loop/single_scans.py",
          "for others, own in self.study.folds:", "for own, others in [(range(len(found)),) * 2]:",
          "tests/litho_models/test_single_scans.py -k other_folds"),
    Fault("a rival judged on scans that it was fitted on", "litho_models/loop/fits.py",
          "prediction = per_fold[fold].height(window)", "prediction = common.height(window)",
          "tests/litho_models/test_loop_model.py -k not_seen"),
    Fault("a measurement learned on held-out scans too", "litho_models/evaluation/fit_cache.py",
          "learn_background(fold.training, own)",
          "learn_background([*fold.training, *fold.held_out], [*own, *held_out])",
          "tests/litho_models/test_benchmark.py -k moves_what"),
    Fault("shared terms learned from the scan itself", "litho_models/loop/closing.py",
          "for own, held_out in study.folds:", "for own, held_out in [(list(range(len(scans))),) * 2]:",
          f"{RUN} -k others_say"),
    Fault("a choice made with the print that is judged", "litho_models/loop/errors.py",
          "closed = close_again(known)", "closed = close_again([*known, *left_out])",
          f"{RUN} -k judged_on"),
    # Reports.
    Fault("a coverage stands under another level", "litho_models/noise/report.py",
          "zip(one.levels, row.coverage, strict=True)", "zip(one.levels, row.coverage[::-1], strict=True)",
          "tests/litho_models/test_noise_results.py -k coverage"),
    Fault("two columns swapped", "litho_models/evaluation/tables.py",
          '"mae_abs_nm": s.mae_abs_nm', '"mae_abs_nm": s.mae_datum_free_nm',
          "tests/litho_models/test_benchmark.py -k complete_on_disk"),
    Fault("waves not counted from level 0", "litho_design/reports/tables.py",
          "(height - printed[0]) / wave_um", "height / wave_um", "tests/test_tables.py -k waves"),
    Fault("the wrong interval at a bar", "litho_models/evaluation/plots.py",
          'getattr(s, f"{error}_ci95_nm")', 's.mae_abs_ci95_nm',
          "tests/test_tables.py -k bar"),
    Fault("the interval of another figure", "litho_models/loop/results.py",
          "over_scans=over_units(gains, seed=",
          "over_scans=over_units(list(after.by_scan_nm.values()), seed=", f"{RUN} -k errors_are_means"),
    Fault("a dead worker takes all jobs with it", "litho_data/sharing/workers.py",
          "_TRIES = 3", "_TRIES = 1", "tests/litho_data/test_workers.py -k dies"),
    # Sixty faults were drawn at random. No test of their room noticed the following ones.
    Fault("an interval only for too few units", "litho_models/scoring/statistics.py",
          "seed=seed) if enough else None", "seed=seed) if not enough else None",
          "tests/litho_models/test_metrics.py -k enough"),
    Fault("a grating's mean added, not subtracted", "litho_data/roughness/grating.py",
          "height_um - np.nanmean(height_um)", "height_um + np.nanmean(height_um)",
          "tests/litho_data/test_gratings.py -k zero"),
    Fault("a scanner without a bow", "litho_data/roughness/grating.py",
          "constant, (x_um - x_um.mean()) / width_um * constant]", "constant]",
          "tests/litho_data/test_calibration.py -k period_of_its"),
    Fault("a step standard without a bow", "litho_data/roughness/step_height.py",
          "[along, along**2]", "[along]", "tests/litho_data/test_calibration.py -k height_of_its"),
    Fault("light beside the target counts as in it", "litho_design/holograms/bench.py",
          "share[wanted > 0]", "share[wanted >= 0]", "tests/litho_design/test_hologram.py -k speckle"),
    Fault("a contrast by the sample's deviation", "litho_design/images/similarity.py",
          "lit.std(correction=0)", "lit.std(correction=1)",
          "tests/litho_design/test_hologram.py -k four_pixels"),
    Fault("a column without a name", "litho_data/reports/page.py",
          "frame.to_csv(temporary, index=False)", "frame.to_csv(temporary, index=True)",
          "tests/litho_models/test_noise_results.py -k column"),
    Fault("folder and target of pairs exchanged", "litho_data/cli/app.py",
          "        folder,\n        target,\n        pitch",
          "        target,\n        folder,\n        pitch",
          "tests/litho_data/test_data_cli.py -k commands_on"),
    Fault("all that scans may share is taken", "litho_models/scan_terms/measurement_fit.py",
          "gain = left - rest", "gain = left + rest",
          "tests/litho_models/test_measurement_model.py -k nothing"),
    Fault("four cells are refused as too few", "litho_data/level/plane.py",
          "slopes.shape[1] < _FEWEST_CELLS", "slopes.shape[1] <= _FEWEST_CELLS",
          "tests/litho_data/test_level_laws.py -k four_cells"),
    Fault("scars of exactly the given width stay", "litho_data/level/scars.py",
          "min(max_width_px, ny - 2) + 1", "min(max_width_px, ny - 2)",
          "tests/litho_data/test_level_beyond.py -k stay"),
    Fault("files that others may execute", "litho_data/foundation/files.py",
          "chmod(0o666", "chmod(0o667", "tests/litho_data/test_files.py -k umask"),
    Fault("the smallest difference of tiles", "litho_design/printers/printer.py",
          "max_nm=float(nm.abs().max())", "max_nm=float(nm.abs().min())",
          "tests/litho_design/test_ensemble.py -k whole_image"),
    Fault("a layout levelled by its print", "litho_data/making/suggest.py",
          'arrays["raw_height_um"].astype(float), arrays["layout_in_scan"]',
          'arrays["layout_in_scan"], arrays["raw_height_um"].astype(float)',
          "tests/litho_data/test_own_lab.py -k following"),
    Fault("a warning among the results", "litho_data/cli/scan.py",
          'f"warning: {message}", err=True', 'f"warning: {message}", err=False',
          "tests/litho_data/test_cli_scan.py -k stderr"),
    Fault("an unknown distance of layouts without levels", "litho_design/reports/advice.py",
          "LEVELS_FILE not in design.files", "LEVELS_FILE in design.files",
          "tests/litho_design/test_fabrication.py -k unknown_distance"),
    Fault("every process takes the same crops", "litho_models/fitting/stochastic.py",
          "batch[rank::count]", "batch[::count]",
          "tests/litho_models/test_training.py -k any_number_of_processes"),
    Fault("errors and spread exchanged", "litho_models/noise/calibration.py",
          "ence=normalised_calibration_error(residual[mine], sigma[mine])",
          "ence=normalised_calibration_error(sigma[mine], residual[mine])",
          "tests/litho_models/test_noise.py -k larger_than_stated"),
    Fault("noise along a difference by the inverse transform", "litho_models/planning/questions.py",
          "torch.fft.fft2(change)", "torch.fft.ifft2(change)", f"{NEXT} -k white_noise"),
    Fault("the worst model called the best", "litho_models/evaluation/wording.py",
          "key=lambda one: one.leading_nm)", "key=lambda one: -one.leading_nm)",
          "tests/test_tables.py -k best_model"),
    Fault("splines of an axis from one end", "litho_models/loop/learner.py",
          "[first, size - 1 - first]", "[first, size - 1 + first]",
          "tests/litho_models/test_learner.py -k from_both_ends"),
    Fault("lines along the other axis", "litho_models/loop/prepared.py",
          'write.get("slow_axis", "y")', 'write.get("y", "slow_axis")',
          f"{NEXT} -k written_lines"),
    Fault("advice on a full wave only where it is unknown", "litho_design/reports/advice.py",
          "level_height_for_one_wave_um is None:", "level_height_for_one_wave_um is not None:",
          "tests/litho_design/test_fabrication.py -k full_wave"),
    Fault("dirt without its surroundings", "litho_data/making/contour.py",
          "return binary_dilation(wrong, iterations=depth_px) if wrong.any() else wrong", "return wrong",
          "tests/litho_data/test_micrographs.py -k dirt"),
    Fault("one error compared with a missing one", "litho_models/boards/judging.py",
          "before_nm is not None and answer", "before_nm is not None or answer",
          "tests/litho_models/test_boards.py -k compares_names"),
    Fault("treads narrower than the limit", "litho_models/noise/staircase.py",
          "stop - narrowest + 1)", "stop - narrowest + 2)",
          "tests/litho_models/test_noise.py -k narrower"),
    Fault("a recipe suggested for a folder", "litho_data/cli/app.py",
          "suggest_recipe(card, folder,", "suggest_recipe(folder, card,",
          "tests/litho_data/test_data_cli.py -k suggested_for"),
    Fault("a tip of another height", "litho_design/judging/measured.py",
          "replace(scan, height_um=surface), radius_um", "scan, radius_um",
          "tests/litho_design/test_measured_judges.py -k pillar"),
    Fault("lines that vary together up to the second place", "litho_data/roughness/step_height.py",
          "int(negative[0])", "int(negative[1])", "tests/litho_data/test_calibration.py -k vary_together"),
    Fault("a layout that is drawn with no line", "litho_models/evaluation/plots.py",
          'color="#c9d1da", lw=1,', 'color="#c9d1da", lw=0,', "tests/test_tables.py -k profiles"),
    Fault("a plane that ends before what is measured", "litho_data/register/topography.py",
          "height.shape[0] - 1)", "height.shape[0] - 2)",
          "tests/litho_data/test_register_resample.py -k gap_continues"),
    Fault("an estimate of all fits where each has its own", "litho_models/evaluation/benchmark.py",
          "len(jobs) if places.elsewhere else 0", "0 if places.elsewhere else len(jobs)",
          "tests/litho_models/test_benchmark_messages.py -k one_estimate"),
    Fault("a long table that is not folded", "litho_models/planning/report.py",
          'page.heading("Scans", folded=True)', 'page.heading("Scans", folded=False)', f"{NEXT} -k waiting"),
    Fault("a window at the place of the other axis", "litho_models/fitting/small_models.py",
          "Window(0, y, x, size)", "Window(0, y, y, size)",
          "tests/litho_models/test_training.py -k four_corners"),
    Fault("a model's name taken for a loaded one", "litho_design/printers/source.py",
          "if isinstance(item, str):\n            first", "if isinstance(str, item):\n            first",
          "tests/litho_design/test_frozen_printer.py -k by_name"),
    Fault("one flat scan counts as all flat", "litho_models/loop/search.py",
          "one_level = all(", "one_level = any(", "tests/litho_models/test_loop_search.py -k cannot_test"),
    Fault("outcomes of the rivals in another order", "litho_models/planning/outcomes.jinja",
          "for rival in question.rivals", "for rival in question.rivals[::-1]", f"{NEXT} -k waiting"),
    Fault("a meaning stands before its name", "litho_data/reports/page.py",
          '[(column["name"], column["meaning"])', '[(column["meaning"], column["name"])',
          "tests/test_tables.py -k meaning"),
    Fault("the axes of frequency and power exchanged", "litho_data/layouts/statistics_report.py",
          "step(statistics.frequency_per_um, statistics.power_share,",
          "step(statistics.power_share, statistics.frequency_per_um,", "tests/test_tables.py -k graphs"),
]  # fmt: skip


def catches(fault: Fault, copy: Path, typed: bool = False) -> str:
    """Return the name of the check that fails because of a fault: a test or "mypy". Return "" if no check
    fails.
    """
    with _put_in(fault, copy):
        if typed and subprocess.run([*_MYPY], cwd=copy, capture_output=True).returncode:
            return "mypy"
        words, _, chosen = fault.tests.partition(" -k ")
        arguments = ["-qx", "-p", "no:cacheprovider", *words.split(), *(["-k", chosen] if chosen else [])]
        with tempfile.TemporaryFile("w+") as said:
            child = os.fork()
            if child == 0:
                _run(copy, arguments, said.fileno())
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            said.seek(0)
            failed = re.search(r"^(?:FAILED|ERROR) (\S+)", said.read(), re.MULTILINE)
    # 0: the tests passed; 1: a test failed; 2: a module that the tests import could not be loaded.
    assert code in (0, 1, 2), f"{fault.name}: {fault.tests} could not be run"
    return failed[1] if failed else ""


@contextmanager
def _put_in(fault: Fault, copy: Path) -> Iterator[None]:
    file = copy / fault.file
    text = file.read_text(encoding="utf-8")
    assert text.count(fault.right) == 1, f"{fault.name}: {fault.file} does not hold {fault.right!r} once"
    file.write_text(text.replace(fault.right, fault.wrong), encoding="utf-8")
    try:
        yield
    finally:
        file.write_text(text, encoding="utf-8")


def _run(copy: Path, arguments: list[str], said: int) -> None:
    """Run tests of the copy in this process, after unloading every module of the project."""
    os.chdir(copy)
    os.dup2(said, 1)
    os.dup2(said, 2)
    os.environ["PYTHONPATH"] = sys.path[0] = str(copy)
    sys.dont_write_bytecode = True
    for name in [name for name in sys.modules if name.partition(".")[0] in PARTS]:
        del sys.modules[name]
    code = 70
    try:
        code = pytest.main(arguments)
    finally:
        sys.stdout.flush()
        os._exit(code)


def try_all(faults: list[Fault], typed: bool = False) -> int:
    """Put the faults into a copy of the project one after the other; return how many were not caught.

    Args:
        typed: whether to run mypy before the tests, as CI does.
    """
    missed = 0
    for name in PRELOADED:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as folder:
        for part in PARTS:
            copy = shutil.copytree if (ROOT / part).is_dir() else shutil.copy
            copy(ROOT / part, Path(folder) / part)
        if typed:
            subprocess.run([*_MYPY], cwd=folder, check=True)
        for fault in faults:
            began_s = time.monotonic()
            test = catches(fault, Path(folder), typed)
            seconds = f"{time.monotonic() - began_s:.0f} s"
            print(f"{'caught' if test else 'MISSED'}  {seconds}  {fault.name}  {test}", flush=True)
            missed += not test
    return missed


if __name__ == "__main__":
    words = sys.argv[1:]
    chosen = [fault for fault in FAULTS if not words or any(word in fault.name for word in words)]
    raise SystemExit(1 if try_all(chosen) else 0)
