"""Tasks in processes of this machine."""

from __future__ import annotations

import importlib
import multiprocessing
import os
from pathlib import Path
from typing import Any

import pytest

from magnetosuture_thread.evaluation.workers import ONE_THREAD, TaskRunner, WorkerDiedError
from magnetosuture_thread.settings.errors import BagError

SOURCE = """
import os
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.evaluation.workers import ONE_THREAD

def work(task, log, progress):
    log(f"task {task}")
    progress(0.5)
    if task == "die":
        os._exit(9)
    if task == "raise":
        raise BagError("a.mcap", "is no mcap file")
    return task * task, os.getpid(), [os.environ.get(name) for name in ONE_THREAD]
"""


@pytest.fixture
def work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the work of `SOURCE`, of a module that other processes find too."""
    name = f"work_{tmp_path.name.replace('-', '_')}"
    (tmp_path / f"{name}.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(str(tmp_path))
    return importlib.import_module(name).work


def test_a_process_that_dies_takes_only_its_own_task_with_it(work: Any):
    lines: list[str] = []
    shares: list[float] = []
    before = dict(os.environ)
    with TaskRunner(work, 2) as runner:
        results = dict(runner.run([1, "die", 3, 4, 5], lines.append, shares.append))
    assert isinstance(results.pop(1), WorkerDiedError)
    assert {index: square for index, (square, _, _) in results.items()} == {0: 1, 2: 9, 3: 16, 4: 25}
    assert all(threads == ["1"] * len(ONE_THREAD) for _, _, threads in results.values())
    assert sorted(lines) == [f"task {n}" for n in (1, 3, 4, 5)]
    assert shares == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0])
    assert dict(os.environ) == before


def test_what_ends_the_call_ends_the_processes(work: Any):
    def interrupt(text: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), TaskRunner(work, 3) as runner:
        list(runner.run([1, 2, 4], interrupt))
    assert not multiprocessing.active_children()


def test_processes_serve_again_and_an_error_of_this_package_is_raised_as_it_is(work: Any):
    with TaskRunner(work, 2) as runner:
        first, second = dict(runner.run([1, 2])), dict(runner.run([4, 5]))
        # One of both may have done all of the first tasks.
        assert len({process for _, process, _ in (*first.values(), *second.values())}) <= 2
        with pytest.raises(BagError, match=r"^a\.mcap: is no mcap file$") as raised:
            list(runner.run([1, "raise"]))
    assert (raised.value.path, raised.value.problem) == ("a.mcap", "is no mcap file")
