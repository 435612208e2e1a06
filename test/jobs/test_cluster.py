"""Jobs on a Dask cluster: the same results to the last bit, and what is lost with a worker."""

from __future__ import annotations

import importlib
import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from unittest import mock

import dask
import pytest
from distributed import LocalCluster

from magnetosuture_thread import cli
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.errors import BagError, ConfigurationError
from magnetosuture_thread.evaluation.tables import TIMES
from magnetosuture_thread.jobs.calibrate import calibrate_bags
from magnetosuture_thread.jobs.campaign import simulate_campaign
from magnetosuture_thread.jobs.evaluate import evaluate_bags
from magnetosuture_thread.jobs.render import render_bag
from magnetosuture_thread.setups import read_setup
from magnetosuture_thread.workers import WorkerDiedError, cluster, make_runner
from test.jobs.test_calibrate import SETUP, trajectory

SOURCE = """
import os
from pathlib import Path

def work(task, log, progress):
    log(f"task {task}")
    if task == "fatal":
        os._exit(9)
    if task == "wrong":
        raise ValueError("a task that cannot be done")
    if isinstance(task, Path) and not task.exists():
        task.touch()  # so that only the first try ends its worker
        os._exit(9)
    return str(task), os.getpid()
"""
PROCEDURE = """\
setup: hernia_ring
goals:
  - go_to: {position: [0.008, -0.0145], tolerance: 1.0e-3}
"""


@contextmanager
def cluster_of_two(folder: Path) -> Iterator[str]:
    """Give the address of a cluster of two processes, which find the module `work_of_tests`."""
    (folder / "work_of_tests.py").write_text(SOURCE)
    once = dask.config.set({"distributed.scheduler.allowed-failures": 1})
    # Dask leaves the environment of its workers in this process.
    with mock.patch.dict(os.environ), pytest.MonkeyPatch.context() as patch, once:
        patch.syspath_prepend(str(folder))
        patch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
        with LocalCluster(n_workers=2, threads_per_worker=2, processes=True, dashboard_address="127.0.0.1:0") as local:
            yield local.scheduler_address


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Return the address of a cluster whose workers nothing ends."""
    with cluster_of_two(tmp_path_factory.mktemp("work")) as address:
        yield address


@pytest.fixture
def mortal(tmp_path: Path) -> Iterator[str]:
    """Return the address of a cluster whose workers tasks end; Dask may start no others after several of them."""
    with cluster_of_two(tmp_path) as address:
        yield address


def test_tasks_are_done_on_the_workers_and_one_that_loses_its_worker_is_repeated(mortal: str, tmp_path: Path):
    work = importlib.import_module("work_of_tests").work
    lines: list[str] = []
    shares: list[float] = []
    tasks = [1, 2, tmp_path / "begun", 4]
    with make_runner(work, 1, mortal) as runner:
        results = dict(runner.run(tasks, lines.append, shares.append))
        assert [results[index][0] for index in range(4)] == [str(task) for task in tasks]
        assert os.getpid() not in {process for _, process in results.values()}
        assert sorted(lines) == sorted(f"task {task}" for task in tasks)
        assert shares == [0.25, 0.5, 0.75, 1.0]
        with pytest.raises(ValueError, match="a task that cannot be done"):
            list(runner.run([1, "wrong"]))
        fatal = dict(runner.run(["fatal", 5]))
    assert isinstance(fatal[0], WorkerDiedError)
    assert fatal[1][0] == "5"


def test_bags_are_evaluated_alike(scheduler: str, short_bag: Path, tmp_path: Path):
    bags = [short_bag, tmp_path / "broken.mcap"]
    bags[1].write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    here, there = (
        evaluate_bags(bags, tmp_path / f"out{address[:3]}", duration=0.4, scheduler=address)
        for address in ("", scheduler)
    )
    assert [{**row, **dict.fromkeys(TIMES)} for row in here] == [{**row, **dict.fromkeys(TIMES)} for row in there]
    assert [bool(row["problem"]) for row in there] == [False, True]
    names = [sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("out", "outtcp")]
    assert names == 2 * [["pull.html", "table.csv", "table.json"]]


def test_a_calibration_is_the_same_file(scheduler: str, tmp_path: Path):
    (tmp_path / "lab.yaml").write_text(SETUP)
    setup = read_setup(str(tmp_path / "lab.yaml"))
    bag = tmp_path / "bag"
    render_bag(trajectory(), setup, bag, rate=15.0, poses=True, noise=2e-5)
    texts = []
    for address in ("", scheduler):
        output = tmp_path / f"found{address[:3]}.yaml"
        calibrate_bags(
            [bag], output, parameters=("elastic_modulus",), scheduler=address, setup_name=str(tmp_path / "lab.yaml")
        )
        texts.append(output.read_bytes())
    assert texts[0] == texts[1]


def test_a_campaign_gives_the_same_runs_and_bags(scheduler: str, tmp_path: Path):
    (tmp_path / "near.yaml").write_text(PROCEDURE)
    found = []
    for address in ("", scheduler):
        output = tmp_path / f"out{address[:3]}"
        simulate_campaign(str(tmp_path / "near.yaml"), range(2), output, bags=[1], scheduler=address)
        bag = Bag(output / "bags" / "seed_1")
        found.append((json.loads((output / "campaign.json").read_text()), [r.data for r in bag.records()], bag.notes))
    assert found[0] == found[1]
    assert found[0][0]["successes"] == 2


def test_a_worker_without_the_folder_of_the_output_refuses_to_record(
    scheduler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "near.yaml").write_text(PROCEDURE)
    monkeypatch.setattr("magnetosuture_thread.jobs.campaign.BAGS", "elsewhere/bags")
    with pytest.raises(BagError, match="this worker does not have the output's folder"):
        simulate_campaign(str(tmp_path / "near.yaml"), range(1), tmp_path / "out", bags=[0], scheduler=scheduler)
    assert not (tmp_path / "out").exists()


def test_workers_with_other_software_are_refused(scheduler: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cluster, "version", lambda name: "0.9" if name == "numpy" else version(name))
    with pytest.raises(ConfigurationError, match=r"workers with numpy 0\.9, as here"):
        make_runner(print, 1, scheduler).__enter__()


def test_a_worker_that_has_other_software_later_is_refused_too(mortal: str, tmp_path: Path):
    work = importlib.import_module("work_of_tests").work
    with make_runner(work, 1, mortal) as runner:
        # On the path of the workers, before the NumPy that is there, as if it had been replaced.
        (tmp_path / "numpy-0.9.dist-info").mkdir()
        (tmp_path / "numpy-0.9.dist-info" / "METADATA").write_text("Name: numpy\nVersion: 0.9\n")
        with pytest.raises(ConfigurationError, match=r"workers with numpy .*, as here \(worker tcp://.* has 0\.9\)"):
            list(runner.run([1]))


def test_workers_with_another_python_are_refused(scheduler: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("platform.python_version_tuple", lambda: ("3", "9", "1"))
    with pytest.raises(ConfigurationError, match=r"workers with Python 3\.9, as here"):
        make_runner(print, 1, scheduler).__enter__()


def test_an_absent_scheduler_gives_one_line(capfd: pytest.CaptureFixture[str], tmp_path: Path, short_bag: Path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    options = ["--output", str(tmp_path / "out"), "--scheduler", address]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cluster, "CONNECT_TIMEOUT", 0.2)
        assert cli.main(["evaluate", str(short_bag), *options]) == 2
    assert "the address of a running Dask scheduler" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()
