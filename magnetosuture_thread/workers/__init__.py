"""Many independent tasks on several processors: processes of this machine, or the workers of a Dask cluster.

Without a scheduler's address the process pool runs them, not a local Dask cluster: it takes less processor time to
start, needs no further packages, and its processes end with this one however that ends. A process that dies takes only
its own task with it.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, Protocol

Log = Callable[[str], None]
Progress = Callable[[float], None]
Work = Callable[[Any, Log, Progress], Any]

# A worker is one of as many as there are processors for: what it uses must not start a thread for each of them.
ONE_THREAD = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"),
    "OPENCV_FOR_THREADS_NUM",
)
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # meant for the parent, which ends its workers itself


class WorkerDiedError(Exception):
    """A worker's process ended in the middle of a task, as when memory runs out."""


class TaskRunner(Protocol):
    """Runs tasks, each by one call of the same function; used as a context."""

    def __enter__(self) -> TaskRunner:
        """Return the runner."""

    def __exit__(self, *_: object) -> None:
        """End what still runs, whatever ended the context."""

    def run(
        self, tasks: Sequence[Any], log: Log = lambda text: None, progress: Progress = lambda share: None
    ) -> Iterator[tuple[int, Any]]:
        """Run tasks; yield the index and the result of each, or a `WorkerDiedError`, in the order in which they end.

        An exception that a task raises is raised here.

        Args:
            tasks: can be pickled, like their results.
            log: called with a line for a person.
            progress: called with the share of all tasks done, 0 to 1.
        """


class WorkerPool:
    """Processes of this machine that run tasks; implements `TaskRunner`.

    With one worker or one task everything runs in this process. Else processes are started afresh (`spawn`): a fork
    would take along threads and locks of numba and OpenCV. Whatever ends the context, as Ctrl-C, ends the processes at
    once, and they end with this process however it ends.

    Args:
        work: called with task, log and progress; can be pickled, and is sent to each process once.
        workers: maximum number of processes.
    """

    def __init__(self, work: Work, workers: int) -> None:
        self._work = work
        self._workers = workers
        self._processes: dict[Connection, BaseProcess] = {}

    def __enter__(self) -> WorkerPool:
        """Return the pool; its processes start with the first tasks."""
        return self

    def __exit__(self, *_: object) -> None:
        """End the processes, whatever they are doing."""
        for line, process in self._processes.items():
            process.kill()
            process.join()
            line.close()

    def run(
        self, tasks: Sequence[Any], log: Log = lambda text: None, progress: Progress = lambda share: None
    ) -> Iterator[tuple[int, Any]]:
        """Run tasks; see `TaskRunner`."""
        shares = [0.0] * len(tasks)

        def set_share(index: int, share: float) -> None:
            shares[index] = share
            progress(sum(shares) / len(tasks))

        if min(self._workers, len(tasks)) <= 1:
            for index, task in enumerate(tasks):
                result = self._work(task, log, partial(set_share, index))
                set_share(index, 1.0)
                yield index, result
            return
        waiting, busy, idle = deque(enumerate(tasks)), dict[Connection, int](), list(self._processes)
        while waiting or busy:
            while waiting and len(busy) < self._workers:
                line = idle.pop() if idle else self._start()
                busy[line], task = waiting.popleft()
                with suppress(OSError):  # it is dead already, as recv will find
                    line.send(task)
            for ready in wait(list(busy)):
                assert isinstance(ready, Connection)
                kind, content = self._receive(ready)
                if kind == "log":
                    log(content)
                elif kind == "progress":
                    set_share(busy[ready], content)
                elif kind == "error":
                    raise content
                else:
                    index = busy.pop(ready)
                    if kind == "done":
                        idle.append(ready)
                    set_share(index, 1.0)
                    yield index, content

    def _receive(self, line: Connection) -> tuple[str, Any]:
        try:
            kind, content = line.recv()
        except (EOFError, OSError):
            process = self._processes.pop(line)
            process.join()
            return "died", WorkerDiedError(f"its process ended with {process.exitcode}, as when memory runs out")
        return kind, content

    def _start(self) -> Connection:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_serve, args=(self._work, theirs), daemon=True)
        with _environment_of_workers():
            process.start()
        theirs.close()  # so that the line ends with the process
        self._processes[ours] = process
        return ours


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Block `STOPS` and set `ONE_THREAD`; a process keeps both as they are when it starts."""
    before = dict(os.environ)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _serve(work: Work, line: Connection) -> None:
    """Run tasks as they come, until the parent ends."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        task = line.recv()
        try:
            result = work(task, lambda text: line.send(("log", text)), lambda share: line.send(("progress", share)))
        except Exception as error:
            line.send(("error", error))
        else:
            line.send(("done", result))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)


def make_runner(work: Work, workers: int, scheduler: str = "") -> TaskRunner:
    """Return what runs tasks, each by one call of the same function.

    Args:
        work: called with task, log and progress; can be pickled, and is sent to each process once.
        workers: maximum number of processes; with one, everything runs in this process. A cluster has its own.
        scheduler: address of a Dask scheduler, for example `tcp://127.0.0.1:8786`; empty for processes of this machine.
    """
    if scheduler:
        from magnetosuture_thread.workers.cluster import ClusterRunner  # which needs the extra `cluster`

        return ClusterRunner(work, scheduler)
    return WorkerPool(work, workers)
