"""Check that each job runs once on any worker, that few jobs wait at a time, and that an error is one line.

The tests on a cluster are in tests/laws/test_cluster.py.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import running_command
from litho_data.making.build import build_dataset
from litho_data.sharing import workers as module
from litho_data.sharing.sending import Known, sent
from litho_data.sharing.workers import Workers, _windowed, run_jobs
from litho_data.store import open_store
from litho_data.store.partial import PartialStore
from tests.jobs import die_at_first, large, refuse, told
from tests.litho_data.campaigns import write_campaign

NOBODY = "tcp://127.0.0.1:9"


def double(number: int) -> int:
    return 2 * number


@pytest.mark.parametrize(("processes", "apart"), [(1, False), (2, False), (2, True)])
def test_jobs_run_once_in_the_same_folder_for_the_same_command(
    processes: int, apart: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = dict(os.environ)
    known = Known(partial(large, 10**5), large(10**5))
    jobs = [(number, known.objects["all"]) for number in range(9)]
    with running_command("litho-data build card.toml"):
        done = list(run_jobs(told, jobs, Workers(processes, known=known), apart=apart))
    assert sorted(job[0] for job, _ in done) == list(range(9))
    threads = before.get("OMP_NUM_THREADS", "1" if processes > 1 else None)
    for job, (whole, entry, facts) in done:
        # The returned job refers to the object of this process, although other processes have their own copy.
        assert whole is job[1]
        assert entry == job[0]
        assert facts == ("litho-data build card.toml", str(tmp_path), threads)
    assert dict(os.environ) == before
    assert len(sent(jobs, {id(known.objects["all"]): "all"})) < 200


@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 17])
def test_every_job_is_submitted_once(count: int) -> None:
    with ThreadPoolExecutor(2) as executor:
        done = _windowed(lambda job: executor.submit(double, job), range(count), lambda: 2)
        assert sorted(future.result() for _, future in done) == [2 * number for number in range(count)]


def test_jobs_are_taken_only_as_results_are_and_by_workers_that_come_later() -> None:
    taken: list[int] = []
    present = 2

    def jobs() -> Iterator[int]:
        for number in range(100):
            taken.append(number)
            yield number

    with ThreadPoolExecutor(1) as executor:
        results = _windowed(lambda job: executor.submit(double, job), jobs(), lambda: present)
        next(results)
        # Four jobs are in progress, and at most four more were submitted because others had finished.
        assert len(taken) <= 8
        present = 5
        next(results)
        next(results)
        # Three results were taken, and ten jobs are running or finished.
        assert len(taken) >= 13
        results.close()


@pytest.mark.parametrize("processes", [1, 2])
def test_an_input_error_of_a_worker_is_raised_in_the_main_process(processes: int) -> None:
    with pytest.raises(InputError, match=r"^job \d, got nothing, wanted something$"):
        list(run_jobs(refuse, range(3), Workers(processes), apart=True))


def test_a_job_that_always_kills_its_worker_is_named_and_no_other(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    jobs = [(number, 3 if number == 7 else 0, tmp_path) for number in range(12)]
    done = run_jobs(die_at_first, jobs, Workers(2), name=lambda job: f"scan {job[0]}")
    with pytest.raises(
        InputError, match=r"^the worker of scan 7 died 3 times; run the command again"
    ) as said:
        list(done)
    assert "\n" not in str(said.value)
    assert capsys.readouterr().err.count("\n") == 2


def test_a_worker_that_dies_while_jobs_wait_costs_a_line_and_no_job(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Check that one call completes each job once, although two of the jobs kill their worker."""
    jobs = [(number, 1 if number in (3, 20) else 0, tmp_path) for number in range(40)]
    done = list(run_jobs(die_at_first, jobs, Workers(2), name=lambda job: f"scan {job[0]}"))
    assert sorted(answer for _, answer in done) == list(range(40))
    said = capsys.readouterr().err
    assert said.count("a worker died") == said.count("\n") <= 2
    assert {"3", "20"} <= set(re.findall(r"scan (\d+)", said))


def test_an_address_without_scheduler_is_one_line_in_a_few_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    assert module._CONNECT_S <= 5
    monkeypatch.setattr(module, "_CONNECT_S", 0.3)
    for wrong in (NOBODY, "nonsense://"):
        with pytest.raises(
            InputError, match=r"^Dask scheduler, got none at \S+ .*wanted the address of a running scheduler"
        ) as said:
            list(run_jobs(double, [1], Workers(dask=wrong)))
        assert "\n" not in str(said.value)


def test_another_program_at_the_address_is_one_line_without_a_traceback(tmp_path: Path) -> None:
    """Check a program that says nothing, and then one that answers as a web server does.

    The command runs in a separate process, because Dask prints unwanted lines when the process exits.
    """
    pytest.importorskip("distributed")
    answers = iter([b"", b"HTTP/1.1 400 Bad Request\r\n\r\n"])
    with contextlib.ExitStack() as stack:
        others: list[socket.socket] = []

        def address_of_a_server() -> str:
            words, server = next(answers), stack.enter_context(socket.create_server(("127.0.0.1", 0)))

            def answer() -> None:
                with contextlib.suppress(OSError):
                    while True:
                        others.append(server.accept()[0])
                        others[-1].sendall(words)

            threading.Thread(target=answer, daemon=True).start()
            return "tcp://{}:{}".format(*server.getsockname())

        addresses = [address_of_a_server(), address_of_a_server()]
        card = write_campaign(tmp_path, count=1)
        words = ["litho-data", "build", str(card), "--out", str(tmp_path / "prints.zarr"), "--dask"]
        program = f"""
import sys
from litho_data.sharing import workers
workers._CONNECT_S = 0.5
from litho_data.cli.app import main
for address in {addresses}:
    sys.argv = [*{words}, address]
    try:
        main()
    except SystemExit as end:
        assert end.code == 2
    else:
        raise AssertionError(address)
"""
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
        for other in others:
            other.close()
    assert done.returncode == 0, done.stderr
    # On a busy machine, a line may say that the command is at work.
    lines = [line for line in done.stderr.splitlines() if line != "litho-data is at work"]
    assert len(lines) == 4
    for begun, said, address in zip(lines[::2], lines[1::2], addresses, strict=True):
        assert begun == "building test-prints: 1 of 1 scans to do"
        assert f"got none at {address} (" in said


def test_without_dask_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(
        InputError, match=r"^dask is not installed; install it with pip install 'litholoop\[cluster\]'$"
    ):
        list(run_jobs(double, [1], Workers(dask=NOBODY)))


def test_zero_workers_is_bad_input() -> None:
    with pytest.raises(InputError, match="workers"):
        Workers(0)


def test_a_build_without_its_cluster_keeps_what_is_finished(
    campaign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, without_report: None
) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(module, "_CONNECT_S", 0.3)
    out, add = tmp_path / "prints.zarr", PartialStore.add
    card = write_campaign(tmp_path, count=3)

    def add_one(partial: PartialStore, *given: object) -> None:
        add(partial, *given)
        raise KeyboardInterrupt

    monkeypatch.setattr(PartialStore, "add", add_one)
    with pytest.raises(KeyboardInterrupt):
        build_dataset(card, out)
    monkeypatch.setattr(PartialStore, "add", add)
    with pytest.raises(InputError, match="Dask scheduler"):
        build_dataset(card, out, dask=NOBODY)
    result = build_dataset(card, out)
    assert result.reused == 1
    assert result.dataset.sha256 == open_store(campaign / "prints.zarr").sha256
