"""Check that a Dask cluster gives the same bits as a local run, even if a worker dies half-way."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from multiprocessing import forkserver, get_context
from pathlib import Path
from typing import Any

import pytest

from benchmarks.blind_trials import campaign
from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import running_command
from litho_data.making.build import build_dataset
from litho_data.sharing import workers as module
from litho_data.sharing.sending import Known
from litho_data.sharing.workers import Workers, run_jobs
from litho_data.store import open_store
from litho_design import hologram_settings
from litho_design.judging.gap import design_folder
from litho_design.tasks.design import Design
from litho_design.workflows.compare import compare
from litho_models.boards.board import make_draws
from litho_models.evaluation.benchmark import benchmark
from litho_models.evaluation.fit_cache import fit_folder, kept_fit
from litho_models.fitting.fit import common_geometry
from litho_models.loop.bases import bases_for
from litho_models.loop.errors import HeldOut, nested_errors
from litho_models.loop.run import close_again
from litho_models.models import build_model
from tests.jobs import die, die_once, large, new_pages, refuse, told
from tests.litho_data.campaigns import write_campaign
from tests.litho_models.loop_scans import bare_state, planted, study_of
from tests.litho_models.prints import make_scans, write_store

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")
_START = "distributed.worker.multiprocessing-method"


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    """Start a cluster of two one-thread workers. A job that kills one worker is retried, but only once.

    The workers are forked from a process that has imported what they need.
    """
    get_context("forkserver").set_forkserver_preload(["distributed", campaign.__name__])
    forkserver.ensure_running()
    with (
        dask.config.set({_START: "forkserver"}),
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            dashboard_address=None,
            scheduler_kwargs={"allowed_failures": 1},
        ) as cluster,
    ):
        yield cluster.scheduler_address


def test_jobs_know_command_folder_and_large_objects(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    known = Known(partial(large, 10**5), large(10**5))
    jobs = [(number, known.objects["all"]) for number in range(9)]
    with running_command("litho-data build card.toml"):
        done = list(run_jobs(told, jobs, Workers(dask=address, known=known)))
    assert sorted(job[0] for job, _ in done) == list(range(9))
    for job, (whole, entry, facts) in done:
        assert whole is job[1]
        assert entry == job[0]
        # Dask gives its workers one thread unless an environment variable sets another number.
        assert facts == ("litho-data build card.toml", str(tmp_path), os.environ.get("OMP_NUM_THREADS", "1"))


@pytest.mark.skipif(sys.platform != "linux", reason="these settings exist only in Linux")
def test_a_worker_uses_freed_memory_again() -> None:
    """Check that workers keep freed memory. By default, Dask returns it, which costs 256 new pages for each
    MiB.
    """
    with (
        dask.config.set({_START: "spawn"}),  # a forked process has the memory settings of its parent
        distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=":0") as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        before = client.submit(new_pages, 1, pure=False).result()
        after = [pages for _, pages in run_jobs(new_pages, [1] * 3, Workers(dask=cluster.scheduler_address))]
    assert before >= 20 * 250
    assert max(after) <= 2 * 256  # pages for the first array, and some for other objects


def test_an_error_of_a_worker_has_the_same_message_in_the_main_process(address: str) -> None:
    with pytest.raises(InputError, match=r"^job \d, got nothing, wanted something$"):
        list(run_jobs(refuse, range(3), Workers(dask=address)))


def test_a_worker_of_other_software_or_other_files_is_refused(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = module.software_record()
    monkeypatch.setattr(
        module, "software_record", lambda: {**own, "versions": {**own["versions"], "numpy": "0"}}
    )
    with pytest.raises(
        InputError, match=r"^numpy of Dask worker tcp://\S+, got \S+, wanted 0, as on this machine"
    ):
        list(run_jobs(refuse, [1], Workers(dask=address)))
    monkeypatch.setattr(module.os, "getcwd", lambda: "/nowhere")
    with pytest.raises(InputError, match=r"^Dask worker tcp://\S+, got no folder /nowhere"):
        list(run_jobs(refuse, [1], Workers(dask=address)))


def test_a_build_that_loses_a_worker_has_the_same_hash(address: str, tmp_path: Path) -> None:
    card = write_campaign(tmp_path, count=2)
    killed: list[int] = []

    def and_kill(*given: Any, **named: Any) -> Iterator[Any]:
        for one in run_jobs(*given, **named):
            if not killed:
                with distributed.Client(address, set_as_default=False) as client:
                    killed.append(client.run(os.getpid).popitem()[1])
                os.kill(killed[0], signal.SIGKILL)
            yield one

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("litho_data.making.build.write_report", lambda *_: None)
        alone = build_dataset(card, tmp_path / "alone.zarr")
        patched.setattr("litho_data.making.build.run_jobs", and_kill)
        result = build_dataset(card, tmp_path / "prints.zarr", dask=address)
    assert killed
    assert result.dataset.sha256 == alone.dataset.sha256
    attributes = [open_store(tmp_path / name).root.attrs for name in ("alone.zarr", "prints.zarr")]
    assert attributes[0]["manifest_sha256"] == attributes[1]["manifest_sha256"]


def test_a_job_whose_worker_dies_is_run_again(address: str, tmp_path: Path) -> None:
    jobs = [(number, tmp_path / "mark") for number in range(4)]
    assert sorted(result for _, result in run_jobs(die_once, jobs, Workers(dask=address))) == list(range(4))
    assert (tmp_path / "mark").exists()


def test_a_job_that_kills_every_worker_is_named_in_one_line(address: str) -> None:
    with pytest.raises(InputError, match=r"^the worker of scan 7 died, .*; run the command again") as said:
        list(run_jobs(die, [7], Workers(dask=address), name=lambda number: f"scan {number}"))
    assert "\n" not in str(said.value)


@pytest.mark.long
def test_a_benchmark_is_the_same_to_the_bit(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("litho_models.evaluation.benchmark.write_benchmark_report", lambda *_: None)
    store = write_store(tmp_path / "made.zarr", make_scans(6, size_px=64))
    wanted = {"models": ("affine", "linear"), "folds": 2, "settings": {"nuisance": "offset"}}
    here, there = (
        benchmark(store, tmp_path / name, **wanted, dask=dask) for name, dask in (("a", None), ("b", address))
    )
    assert here.scores == there.scores
    assert [(fit.model, fit.fold) for fit in there.fits] == [
        (model, fold) for model in wanted["models"] for fold in (0, 1)
    ]
    for fit in here.fits:
        pair = [kept_fit(fit_folder(tmp_path / name / "cache", fit.model, fit.key))[1] for name in "ab"]
        assert all((one == other).all() for one, other in zip(*pair, strict=True))


@pytest.mark.long
def test_fits_and_searches_without_folds_are_the_same_to_the_bit(address: str, tmp_path: Path) -> None:
    here = study_of(planted(count=6), folds=2)
    studies = here, replace(here, workers=Workers(dask=address))
    state = bare_state(here)
    maps = [HeldOut(study).maps_um(state) for study in studies]
    assert all((own == its).all() for own, its in zip(*maps, strict=True))
    again = partial(close_again, {"affine": build_model("affine", **common_geometry(here.scans))}, 2, 0)
    one, other = (nested_errors(study, "folds", again) for study in studies)
    assert one == other
    bases = [
        bases_for("features", study, cache=tmp_path / name)["features"]
        for name, study in zip("ab", studies, strict=True)
    ]
    assert len(bases[0].models) == len(bases[1].models) == len(here.folds) + 1
    for own, its in zip(*(base.state_dict().values() for base in bases), strict=True):
        assert (own == its).all()


@pytest.mark.long
def test_designs_are_the_same_to_the_bit(
    address: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    tiny = {"layout.size_px": 48, "optics.distance_um": 8, "search.iterations": 4, "search.polish_rounds": 1}
    settings = hologram_settings(changes={**tiny, "window.yield_draws": 2, "window.defocus_sd_um": 0.5})
    arms = {"none": "none", "physics": "zoo:physics"}
    here, there = (
        compare(settings, arms, name, target="ring", seeds=(0,), announce=False, dask=dask)
        for name, dask in (("a", None), ("b", address))
    )
    assert (here.entries, here.arms) == (there.entries, there.arms)
    for arm in arms:
        one, other = (Design.read(design_folder(tmp_path / name, arm, 0)) for name in "ab")
        assert one.fingerprint == other.fingerprint
        # These are the hashes of levels, height, image and target.
        assert one.files == other.files != {}
        assert one.predicted == other.predicted


@pytest.mark.long
def test_blind_trials_are_the_same_to_the_bit(address: str, tmp_path: Path) -> None:
    # Fields smaller than these cannot be registered.
    draws = make_draws(board="singles", seed=0, n_scans=12, size_px=128, base="physics")
    records = []
    for name, dask in (("a", None), ("b", address)):
        (tmp_path / name).mkdir()
        campaign.open_campaign(tmp_path / name, draws)
        settings = {"workers": Workers(dask=dask), "timeout_s": 3600.0}
        campaign.run_campaign(tmp_path / name, draws, numbers=[1, 3], **settings)
        trials = campaign.finished(tmp_path / name, draws)
        assert not any(trial.failure for trial in trials)
        # Only the processor time depends on the machine.
        records.append([trial.model_dump(exclude={"dataset_cpu_s"}) for trial in trials])
    assert records[0] == records[1]


def test_a_trial_runs_in_a_process_of_its_own_on_a_worker(address: str, tmp_path: Path) -> None:
    draws = make_draws(board="singles", seed=0, n_scans=12, size_px=64, base="physics")
    campaign.open_campaign(tmp_path, draws)
    # The time limit is long enough for a process to start, but too short for a trial.
    settings = {"workers": Workers(dask=address), "timeout_s": 0.3}
    campaign.run_campaign(tmp_path, draws, numbers=[0], **settings)
    assert [trial.failure for trial in campaign.finished(tmp_path, draws)] == ["not finished after 0.3 s"]
