"""Replays on several cores: processes that hold the passages and give the same numbers, whoever computes them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection

from magnetosuture_thread.calibration.recorded_run import RecordedRun
from magnetosuture_thread.calibration.residuals import RunTasks, Task, replay_with_parameters
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.geometry.polyline import Points

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # meant for the parent, which ends its workers itself

_passages: tuple[RecordedRun, ...] = ()


@contextmanager
def pool(passages: Sequence[RecordedRun], workers: int) -> Iterator[RunTasks]:
    """Give what runs tasks: here, or in processes of its own.

    Ctrl-C is the parent's, and ends the processes at once, whatever they are at.

    Args:
        passages: that tasks name by their index.
        workers: number of processes; with one, no other process is started.

    Raises:
        GraphError: a process died.
    """
    if workers <= 1:
        yield lambda tasks: [replay_with_parameters(passages[index], settings) for index, settings in tasks]
        return
    others = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(
        workers, multiprocessing.get_context("spawn"), initializer=_begin, initargs=(tuple(passages),)
    )

    def run(tasks: Sequence[Task]) -> list[Points]:
        try:
            # Processes begin with what is blocked here, and keep it.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
            try:
                waiting = [executor.submit(_work, task) for task in tasks]
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            return [future.result() for future in waiting]
        except BrokenProcessPool:
            raise GraphError("a process that replayed a bag died; is there enough memory for --workers?") from None

    try:
        yield run
    except BaseException:
        for process in set(multiprocessing.active_children()) - others:
            process.kill()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _begin(passages: tuple[RecordedRun, ...]) -> None:
    """Take the passages, and end whenever the parent does, however it ends."""
    global _passages
    _passages = passages
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _work(task: Task) -> Points:
    index, settings = task
    return replay_with_parameters(_passages[index], settings)
