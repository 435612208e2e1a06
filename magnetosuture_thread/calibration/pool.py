"""Replays on several processors, with the same numbers whichever process computes them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial

from magnetosuture_thread.calibration.recorded_run import RecordedRun
from magnetosuture_thread.calibration.residuals import RunTasks, Task, replay_with_parameters
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.workers import WorkerDiedError, make_runner


@contextmanager
def pool(passages: Sequence[RecordedRun], workers: int, scheduler: str = "") -> Iterator[RunTasks]:
    """Give a function that runs tasks, here or in processes of their own; see `make_runner`.

    Args:
        passages: that tasks name by their index.
        workers: number of processes; with one, no other process is started.
        scheduler: address of a Dask scheduler, whose workers replay in place of those; empty for none.

    Raises:
        GraphError: a process died.
    """
    with make_runner(partial(_replay, tuple(passages)), workers, scheduler) as runner:

        def run(tasks: Sequence[Task]) -> list[Points]:
            results = dict[int, Points]()
            for index, result in runner.run(tasks):
                if isinstance(result, WorkerDiedError):
                    raise GraphError("a process that replayed a bag died; is there enough memory for --workers?")
                results[index] = result
            return [results[index] for index in range(len(tasks))]

        yield run


def _replay(
    passages: Sequence[RecordedRun], task: Task, log: Callable[[str], None], progress: Callable[[float], None]
) -> Points:
    index, settings = task
    return replay_with_parameters(passages[index], settings)
