"""Work on several processors: one process each, none of which takes the others with it."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

# A worker is one of as many as there are processors for: what it uses must not start a thread for each of them.
ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMBA_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
)

Log = Callable[[str], None]
Progress = Callable[[float], None]
Work = Callable[[Any, Log, Progress], Any]


class WorkerDiedError(Exception):
    """A worker's process ended in the middle of a task, as when memory runs out."""


@dataclass
class _Worker:
    process: BaseProcess
    line: Connection
    task: int = -1  # none


def run_all(
    work: Work,
    tasks: Sequence[Any],
    workers: int,
    *,
    done: Callable[[int, Any], None],
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> None:
    """Do tasks, each by one call; `done` gets them as they end.

    With one worker in this process; with several in processes of their own, started afresh (`spawn`): a fork would
    take along threads and locks of numba and OpenCV. A process that dies takes its own task alone with it. Whatever
    ends the call early, as Ctrl-C, ends the processes.

    Args:
        work: called with task, say and progress; a function of a module, so that another process finds it.
        tasks: can be pickled, like what work returns.
        workers: processes.
        done: called with a task's index and what work returned, or a `WorkerDiedError`.
        log: called with a line for a person.
        progress: called with the share of all tasks done, 0 to 1.
    """
    shares = [0.0] * len(tasks)

    def set_share(index: int, share: float) -> None:
        shares[index] = share
        progress(sum(shares) / max(len(tasks), 1))

    if min(workers, len(tasks)) <= 1:
        for index, task in enumerate(tasks):
            done(index, work(task, log, partial(set_share, index)))
            set_share(index, 1.0)
        return
    with _team(work, min(workers, len(tasks))) as team:
        waiting = list(enumerate(tasks))[::-1]
        for worker in team:
            _give(worker, waiting)
        while busy := [worker.line for worker in team if worker.task >= 0]:
            wait(busy)
            for place, worker in enumerate(team):
                if worker.task < 0 or not worker.line.poll():
                    continue
                try:
                    kind, content = worker.line.recv()
                except (EOFError, OSError):
                    worker.process.join()
                    error = WorkerDiedError(
                        f"its process ended with {worker.process.exitcode}, as when memory runs out"
                    )
                    done(worker.task, error)
                    set_share(worker.task, 1.0)
                    team[place] = worker = _started(work)
                    _give(worker, waiting)
                    continue
                if kind == "say":
                    log(content)
                elif kind == "progress":
                    set_share(worker.task, content)
                else:
                    set_share(worker.task, 1.0)
                    done(worker.task, content)
                    _give(worker, waiting)


def _give(worker: _Worker, waiting: list[tuple[int, Any]]) -> None:
    worker.task = -1
    if waiting:
        worker.task, task = waiting.pop()
        with suppress(OSError):  # it is dead already, as will be seen
            worker.line.send(task)


@contextmanager
def _team(work: Work, size: int) -> Iterator[list[_Worker]]:
    team: list[_Worker] = []
    try:
        for _ in range(size):
            team.append(_started(work))
        yield team
    finally:
        for worker in team:
            worker.process.terminate()
        for worker in team:
            worker.process.join(5.0)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()
            worker.line.close()


def _started(work: Work) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(work, theirs), daemon=True)
    with _one_thread(), _without_interrupt():
        process.start()
    theirs.close()  # so that the line ends with the process
    return _Worker(process, ours)


@contextmanager
def _without_interrupt() -> Iterator[None]:
    """Hold Ctrl-C back: it is for who starts processes, who then ends them, and a process keeps what it begins with."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _one_thread() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _serve(work: Work, line: Connection) -> None:
    """Do tasks as they come; ends with the line, so that no process outlives who started it."""
    while True:
        try:
            task = line.recv()
        except EOFError:
            return
        line.send(
            ("done", work(task, lambda text: line.send(("say", text)), lambda share: line.send(("progress", share))))
        )
