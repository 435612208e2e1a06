"""Jobs on a Dask cluster: the same results to the last bit, and what is lost with a worker."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import cast

import pytest

from magnetosuture_thread import cli
from magnetosuture_thread.commands.evaluate import evaluate_bags
from magnetosuture_thread.evaluation import workers
from magnetosuture_thread.evaluation.workers import TaskRunner, Work, WorkerDiedError
from magnetosuture_thread.settings.errors import ConfigurationError
from test.evaluation.runs import TIMES

pytestmark = pytest.mark.slow

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
ENDED_WORKERS = 3  # one by the task that ends its first worker, and one by each of two tries of a fatal one


@contextmanager
def cluster_of(workers: int, folder: Path) -> Iterator[str]:
    """Give the address of a cluster of some processes, which find the module `work_of_tests`.

    Nothing starts a worker again: Dask's nannies may fail at that where another one ends meanwhile.
    """
    (folder / "work_of_tests.py").write_text(SOURCE)
    paths = filter(None, [str(folder), os.environ.get("PYTHONPATH")])
    never = {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "0"}  # the runner repeats a task that lost its worker
    environment = {**os.environ, **never, "PYTHONPATH": os.pathsep.join(paths)}
    with (folder / "dask.log").open("wb") as log, ExitStack() as stack:
        stack.enter_context(pytest.MonkeyPatch.context()).syspath_prepend(str(folder))

        def start(name: str, *options: str) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", f"distributed.cli.{name}", *options, "--no-dashboard"]
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            stack.callback(process.wait)
            stack.callback(process.kill)
            return process

        # Should this process be killed, they end by themselves.
        where = ("--host", "127.0.0.1", "--port", "0", "--idle-timeout", "10 minutes")
        scheduler = start("dask_scheduler", *where, "--scheduler-file", str(folder / "scheduler"))
        address = ""
        while not address:
            assert scheduler.poll() is None, (folder / "dask.log").read_text()
            time.sleep(0.05)
            with suppress(OSError, ValueError):  # not there yet, or only a part of it
                address = str(json.loads((folder / "scheduler").read_text())["address"])
        beside = ("--no-nanny", "--nthreads", "2", "--death-timeout", "60", "--local-directory", str(folder))
        for _ in range(workers):
            start("dask_worker", address, *beside)
        yield address


def work() -> Work:
    """Return the function of `SOURCE`, by the name that workers find it by."""
    return cast(Work, importlib.import_module("work_of_tests").work)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a cluster of which two workers are left when the tests have ended the others."""
    with cluster_of(ENDED_WORKERS + 2, tmp_path_factory.mktemp("cluster")) as address:
        yield address


def test_tasks_are_done_on_the_workers_and_one_that_loses_its_worker_is_repeated(cluster: str, tmp_path: Path):
    lines: list[str] = []
    shares: list[float] = []
    tasks = [1, 2, tmp_path / "begun", 4]
    with TaskRunner(work(), 1, cluster) as runner:
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


def test_bags_are_evaluated_alike(cluster: str, short_bag: Path, tmp_path: Path):
    bags = [short_bag, tmp_path / "broken.mcap"]
    bags[1].write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    here, there = (
        evaluate_bags(bags, tmp_path / f"out{name[:3]}", duration=0.4, scheduler=name) for name in ("", cluster)
    )
    assert [{**row, **dict.fromkeys(TIMES)} for row in here] == [{**row, **dict.fromkeys(TIMES)} for row in there]
    assert [bool(row["problem"]) for row in there] == [False, True]
    names = [sorted(path.name for path in (tmp_path / name).iterdir()) for name in ("out", "outtcp")]
    assert names[0] == names[1]


def test_a_worker_that_has_other_software_later_is_refused_too(tmp_path: Path):
    with cluster_of(1, tmp_path) as address, TaskRunner(work(), 1, address) as runner:
        # On the path of the workers, before the NumPy that is there, as if it had been replaced.
        (tmp_path / "numpy-0.9.dist-info").mkdir()
        (tmp_path / "numpy-0.9.dist-info" / "METADATA").write_text("Name: numpy\nVersion: 0.9\n")
        with pytest.raises(ConfigurationError, match=r"^numpy of worker tcp://.*: got '0\.9', expected "):
            list(runner.run([1]))


def test_an_absent_scheduler_gives_one_line(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, short_bag: Path
):
    monkeypatch.setattr(workers, "CONNECT_TIMEOUT", 0.2)
    options = ["--output", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:1"]
    assert cli.main(["evaluate", str(short_bag), *options]) == 2
    assert "the address of a running Dask scheduler" in capfd.readouterr().err
    assert not (tmp_path / "out").exists()
