"""Work in several processes."""

from __future__ import annotations

import importlib
import multiprocessing
import os
from pathlib import Path
from typing import Any

import pytest

from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.workers import ONE_THREAD, WorkerDiedError, WorkerPool

SOURCE = """
import os
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.workers import ONE_THREAD

def work(task, log, progress):
    log(f"task {task}")
    progress(0.5)
    if task == 3:
        os._exit(9)
    if task == 6:
        raise BagError("a.mcap", "is no mcap file")
    return task * task, os.getpid(), [os.environ.get(name) for name in ONE_THREAD]
"""
BEFORE = {name for name in ONE_THREAD if name in os.environ}


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return work of a module that other processes find too: square a number; 3 ends the process, 6 raises."""
    name = f"work_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(str(tmp_path))
    return importlib.import_module(name).work


def test_each_task_is_done_once_and_a_process_that_dies_takes_only_its_own_with_it(work: Any):
    said: list[str] = []
    shares: list[float] = []
    with WorkerPool(work, 2) as pool:
        results = dict(pool.run([1, 2, 3, 4, 5], log=said.append, progress=shares.append))
    assert isinstance(results.pop(2), WorkerDiedError)
    assert {index: square for index, (square, _, _) in results.items()} == {0: 1, 1: 4, 3: 16, 4: 25}
    assert all(threads == ["1"] * len(ONE_THREAD) for _, _, threads in results.values())
    assert sorted(said) == [f"task {n}" for n in (1, 2, 3, 4, 5)]
    assert shares[-1] == pytest.approx(1.0)
    assert not any(os.environ.get(name) == "1" for name in ONE_THREAD if name not in BEFORE)


@pytest.mark.parametrize("workers", [1, 3])
def test_what_ends_the_call_ends_the_processes(work: Any, workers: int):
    def interrupt(text: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), WorkerPool(work, workers) as pool:
        list(pool.run([1, 2, 4], log=interrupt))
    assert not multiprocessing.active_children()


def test_one_task_needs_no_process_of_its_own(work: Any):
    with WorkerPool(work, 8) as pool:
        ((index, result),) = pool.run([2])
    assert (index, *result[:2]) == (0, 4, os.getpid())


def test_processes_serve_again_and_an_error_of_a_task_is_raised_here(work: Any):
    with WorkerPool(work, 2) as pool:
        first, second = dict(pool.run([1, 2])), dict(pool.run([4, 5]))
        assert {process for _, process, _ in second.values()} <= {process for _, process, _ in first.values()}
        with pytest.raises(TypeError):
            list(pool.run(["no number", 1]))


def test_an_error_of_this_package_is_raised_as_it_is(work: Any):
    with WorkerPool(work, 2) as pool, pytest.raises(BagError, match=r"^a\.mcap: is no mcap file$") as raised:
        list(pool.run([1, 6]))
    assert (raised.value.path, raised.value.problem) == ("a.mcap", "is no mcap file")
