"""Check what a benchmark says about few scans, too many folds, and a folder with another benchmark."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

import litho_models
from litho_data.foundation.errors import InputError
from litho_models.cli.app import app
from tests.litho_models.prints import make_scans, write_store


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return write_store(tmp_path_factory.mktemp("few") / "few.zarr", make_scans(4, size_px=64))


def test_few_scans_have_no_interval_and_folds_are_not_dropped_silently(store, tmp_path):
    words = ["benchmark", store, "--models", "affine", "--folds", 50, "--out", tmp_path]
    result = CliRunner().invoke(app, list(map(str, words)), catch_exceptions=False)
    assert "no intervals: " in result.stdout
    assert "but at least 6 are needed" in result.stdout
    assert " folds instead of 50: one for each printed field" in result.stderr
    assert "…" not in result.stdout
    assert result.stdout.splitlines()[-2].startswith("affine is")


def test_a_result_without_end_is_refused_before_it_is_read():
    with pytest.raises(InputError, match="a pipe or a device"):
        litho_models.compare("/dev/zero", "/dev/zero")


@pytest.mark.parametrize(("workers", "covered"), [(1, 0), (2, 4)])
def test_one_estimate_covers_all_fits_where_workers_share_them(
    workers, covered, store, tmp_path, monkeypatch
):
    asked = []

    def seen(done, what, total, *, estimate_of, at_once):
        asked.append((total, estimate_of, at_once))
        raise KeyboardInterrupt

    monkeypatch.setattr("litho_models.evaluation.benchmark.progress", seen)
    with pytest.raises(KeyboardInterrupt):
        litho_models.benchmark(store, tmp_path, models=["identity", "affine"], folds=2, workers=workers)
    assert asked == [(4, covered, workers)]


def test_a_benchmark_is_extended_but_not_replaced_by_another(store, tmp_path):
    litho_models.benchmark(store, tmp_path, models=["identity"], folds=2)
    litho_models.benchmark(store, tmp_path, models=["identity", "affine"], folds=2)
    with pytest.raises(InputError, match="holds a benchmark that also contains model identity"):
        litho_models.benchmark(store, tmp_path, models=["affine"], folds=2)
    with pytest.raises(InputError, match="seed = 0, but now 1"):
        litho_models.benchmark(store, tmp_path, models=["identity", "affine"], folds=2, seed=1)
