"""Many independent tasks on several processors: processes of this machine, or the workers of a Dask cluster.

Without a scheduler's address the process pool runs them, not a local Dask cluster: it takes less processor time to
start, needs no further packages, and its processes end with this one however that ends.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import pickle
import platform
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

from magnetosuture_thread.errors import ConfigurationError

Log = Callable[[str], None]
Progress = Callable[[float], None]
Work = Callable[[Any, Log, Progress], Any]

# A worker is one of as many as there are processors for: what it uses must not start a thread for each of them.
ONE_THREAD = (
    *("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"),
    "OPENCV_FOR_THREADS_NUM",
)
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # meant for the parent, which ends its workers itself
CONNECT_TIMEOUT = 20.0  # s to reach the scheduler
# A result has the same bits only where these are the same. OpenCV comes by pip or as Ubuntu's package.
SOFTWARE = ("magnetosuture_thread", "numpy", "scipy", "numba", "opencv-python-headless", "osqp")


class WorkerDiedError(Exception):
    """A worker's process ended in the middle of a task, as when memory runs out."""


class TaskRunner:
    """Runs tasks, each by one call of the same function; used as a context.

    A task whose worker ended is repeated alone, as another task may have ended it, and gives a `WorkerDiedError` only
    where it ends its worker then too. Whatever ends the context, as Ctrl-C, ends what still runs.

    Args:
        work: called with task, log and progress; can be pickled.
        slots: how many tasks are given away at a time.
    """

    def __init__(self, work: Work, slots: float) -> None:
        self._work, self._slots = work, slots

    def __enter__(self) -> TaskRunner:
        """Return the runner."""
        return self

    def __exit__(self, *_: object) -> None:
        """End what still runs, whatever ended the context."""

    def run(
        self, tasks: Sequence[Any], log: Log = lambda text: None, progress: Progress = lambda share: None
    ) -> Iterator[tuple[int, Any]]:
        """Run tasks; yield the index and the result of each, or a `WorkerDiedError`, in the order in which they end.

        An exception that a task raises is raised here.

        Args:
            tasks: can be pickled, like their results.
            log: called with a line for a person, when its task ends.
            progress: called with the share of the tasks done, 0 to 1.
        """
        waiting, lost, done = deque(range(len(tasks))), deque[int](), 0
        running: dict[Future[Any], int] = {}
        ended: SimpleQueue[Future[Any]] = SimpleQueue()
        while waiting or running or lost:
            alone = not waiting and not running
            while (waiting and len(running) < self._slots) or (alone and not running):
                index = lost.popleft() if alone else waiting.popleft()
                future = self._submit(tasks[index])
                running[future] = index
                future.add_done_callback(ended.put)
            future = ended.get()
            index = running.pop(future)
            try:
                result, lines = self._result_of(future)
            except WorkerDiedError as error:
                if not alone:
                    lost.append(index)
                    continue
                result, lines = error, []
            done += 1
            for line in lines:
                log(line)
            progress(done / len(tasks))
            yield index, result

    def _submit(self, task: Any) -> Future[Any]:
        """Begin a task; its future gets the result and the lines that were logged."""
        raise NotImplementedError

    def _result_of(self, future: Future[Any]) -> tuple[Any, list[str]]:
        """Return what became of a task; raise `WorkerDiedError` where its worker ended."""
        try:
            result, lines = future.result()
        except BrokenExecutor:
            raise WorkerDiedError("its process ended, as when memory runs out") from None
        return result, lines


def run_task(work: Work, task: Any) -> tuple[Any, list[str]]:
    """Run a task; return its result and the lines that it logged."""
    lines: list[str] = []
    return work(task, lines.append, lambda share: None), lines


class WorkerPool(TaskRunner):
    """Processes of this machine that run tasks.

    With one worker or one task everything runs in this process. Else processes are started afresh (`spawn`): a fork
    would take along threads and locks of numba and OpenCV. They get the work once, and end with this process however it
    ends.

    Args:
        work: called with task, log and progress; can be pickled.
        workers: maximum number of processes.
    """

    _executor: ProcessPoolExecutor | None = None

    def __init__(self, work: Work, workers: int) -> None:
        super().__init__(work, workers)
        self._theirs, self._ours = multiprocessing.Pipe(duplex=False)  # which ends with this process

    def __exit__(self, *_: object) -> None:
        """End the processes, whatever they are doing."""
        self._ours.close()
        if self._executor is not None:
            self._executor.shutdown(cancel_futures=True)
        self._theirs.close()

    def run(
        self, tasks: Sequence[Any], log: Log = lambda text: None, progress: Progress = lambda share: None
    ) -> Iterator[tuple[int, Any]]:
        """Run tasks; see `TaskRunner`."""
        if min(self._slots, len(tasks)) > 1:
            yield from super().run(tasks, log, progress)
            return
        for index, task in enumerate(tasks):

            def advance(done: float, before: int = index) -> None:
                progress((before + done) / len(tasks))

            result = self._work(task, log, advance)
            progress((index + 1) / len(tasks))
            yield index, result

    def _submit(self, task: Any) -> Future[Any]:
        with _environment_of_workers():  # processes are started as tasks come
            if self._executor is not None:
                with suppress(BrokenExecutor):  # a process has died
                    return self._executor.submit(_run_here, task)
                self._executor.shutdown(wait=False)
            context, given = multiprocessing.get_context("spawn"), (self._work, self._theirs)
            self._executor = ProcessPoolExecutor(int(self._slots), context, _begin, given)
            return self._executor.submit(_run_here, task)


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


_works: list[Work] = []  # of a process of the pool


def _begin(work: Work, parent: Connection) -> None:
    """Keep the work in a process of the pool, which ends with its parent, or where that closes the line."""

    def end() -> None:
        with suppress(EOFError, OSError):
            parent.recv()
        os._exit(1)

    _works.append(work)
    threading.Thread(target=end, daemon=True).start()


def _run_here(task: Any) -> tuple[Any, list[str]]:
    return run_task(_works[0], task)


class ClusterRunner(TaskRunner):
    """Workers of a Dask cluster that run tasks; needs the extra `cluster`.

    Whatever ends the context cancels what has not begun; what a worker has begun it still ends. Each task compares the
    software of its worker with this process's, as a worker may join later or come back with another version.

    Args:
        work: called with task, log and progress; can be pickled.
        address: of the scheduler.

    Raises:
        ConfigurationError: on entering: there is no scheduler, or it has no workers; in `run`: the scheduler is gone,
            or a worker has other software than this process (`SOFTWARE`, or another minor version of Python), so that
            its results may differ.
    """

    def __init__(self, work: Work, address: str) -> None:
        super().__init__(work, float("inf"))
        self._address = address

    def __enter__(self) -> TaskRunner:
        """Connect to the scheduler."""
        import dask
        from distributed import Client

        try:
            self._client = Client(self._address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, asyncio.TimeoutError) as error:
            raise self._refused("the address of a running Dask scheduler", error) from None
        try:
            self._client.wait_for_workers(1, timeout=60.0)  # the first may still start
        except TimeoutError as error:
            self._client.close()
            raise self._refused("a scheduler with workers", error) from None
        # The work is sent once; Dask warns beyond 10 MB, which a few recorded runs have.
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GB"}):
            # A task of its own and not scattered data, which would be lost with the workers that hold it.
            self._loaded = self._client.submit(pickle.loads, pickle.dumps(self._work), pure=False)
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect, which cancels what has not begun."""
        self._client.close()

    def _submit(self, task: Any) -> Future[Any]:
        # Dask's own future, which has what is used of one: it tells of a scheduler that is lost too.
        future: Future[Any] = self._client.submit(_run_there, self._loaded, task, _software(), pure=False)
        return future

    def _result_of(self, future: Future[Any]) -> tuple[Any, list[str]]:
        from distributed import KilledWorker

        try:
            return super()._result_of(future)
        except _OtherSoftwareError as error:
            raise self._refused(*error.args) from None
        except ModuleNotFoundError as error:
            raise self._refused("workers with the same packages as here", error) from None
        except KilledWorker as error:
            raise WorkerDiedError(" ".join(str(error).split())) from None
        except (asyncio.CancelledError, OSError) as error:
            if getattr(future, "status", "") == "error":  # of the task itself
                raise
            raise self._refused("a scheduler that stays", error) from None

    def _refused(self, expectation: str, problem: object) -> ConfigurationError:
        words = " ".join(str(problem).split())
        return ConfigurationError("scheduler", self._address, f"{expectation} ({words})" if words else expectation)


class _OtherSoftwareError(Exception):
    """A worker has other software than the process that gives the tasks: what was expected, and what it has."""


_ONE_AT_A_TIME = threading.Lock()  # in a worker of several threads: matplotlib is not made for them


def _run_there(work: Work, task: Any, software: Mapping[str, str]) -> tuple[Any, list[str]]:
    """Run a task on a worker, where it has the software of the process that gives the task."""
    from distributed import get_worker

    for name, expected in software.items():
        if (found := _software().get(name)) != expected:
            problem = f"worker {get_worker().address} has {found or 'none'}"
            raise _OtherSoftwareError(f"workers with {name} {expected}, as here", problem)
    with _ONE_AT_A_TIME:
        return run_task(work, task)


@cache
def _software() -> dict[str, str]:
    """Return the versions of a process's software, looked up once: what is imported stays."""
    found = {"Python": ".".join(platform.python_version_tuple()[:2])}
    for name in SOFTWARE:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = ""
    return found


def make_runner(work: Work, workers: int, scheduler: str = "") -> TaskRunner:
    """Return what runs tasks, each by one call of the same function.

    Args:
        work: called with task, log and progress; can be pickled, and is sent to each process once.
        workers: maximum number of processes; with one, everything runs in this process. A cluster has its own.
        scheduler: address of a Dask scheduler, for example `tcp://127.0.0.1:8786`; empty for processes of this machine.
    """
    return ClusterRunner(work, scheduler) if scheduler else WorkerPool(work, workers)
