"""Independent tasks on several processors: processes of this machine, or the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import platform
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from concurrent.futures import wait as wait_for
from contextlib import ExitStack, contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import Connection
from typing import Any

from magnetosuture_thread.settings.errors import ConfigurationError

Log = Callable[[str], None]
Progress = Callable[[float], None]
Work = Callable[[Any, Log, Progress], Any]
Results = Iterator[tuple[int, Any]]  # index of a task, and what came of it

# A worker is one of as many as there are processors for: what it uses must not start a thread for each of them.
ONE_THREAD = [f"{name}_NUM_THREADS" for name in ("OMP", "OPENBLAS", "MKL", "NUMBA")] + ["OPENCV_FOR_THREADS_NUM"]
CONNECT_TIMEOUT = 20.0  # s to reach a scheduler
_ONE_AT_A_TIME = threading.Lock()  # in a worker of several threads: matplotlib is not made for them
_WORK: list[Work] = []  # of a process, which gets it when it starts


class WorkerDiedError(Exception):
    """A worker's process ended in the middle of a task, as when memory runs out."""


class TaskRunner:
    """Runs tasks, each by one call of the same function, by an executor; used as a context.

    With one worker or one task, and no scheduler, everything runs in this process. Else processes are started afresh
    (`spawn`): a fork would take along threads and locks of numba and OpenCV. Whatever ends the context, as Ctrl-C, ends
    the processes at once, and they end with this process however it ends. On a Dask cluster it cancels what has not
    begun.

    A worker that dies ends the tasks of others too. Each such task is repeated alone, and its result is a
    `WorkerDiedError` only where it ends its worker then again.

    Args:
        work: called with task, log and progress; can be pickled, and is sent to each worker once.
        workers: maximum number of processes; a cluster has its own.
        scheduler: address of a Dask scheduler, for example `tcp://127.0.0.1:8786`, whose workers run the tasks in place
            of processes; needs the extra `cluster`.

    Raises:
        ConfigurationError: on entering: there is no scheduler, or it has no workers.
    """

    def __init__(self, work: Work, workers: int, scheduler: str = "") -> None:
        self._work, self._workers, self._scheduler = work, workers, scheduler
        self._executor: Executor | None = None
        self._shared: tuple[Any, Mapping[str, str]] = (None, {})  # first arguments of `_run_task`
        self._died: tuple[type[Exception], ...] = (BrokenExecutor,)
        self._stack = ExitStack()

    def __enter__(self) -> TaskRunner:
        """Connect to the scheduler; processes start with the first tasks."""
        if self._scheduler:
            self._connect()
        return self

    def __exit__(self, *_: object) -> None:
        """End what still runs."""
        self._stack.close()

    def run(
        self, tasks: Sequence[Any], log: Log = lambda text: None, progress: Progress = lambda share: None
    ) -> Results:
        """Run tasks; yield the index and the result of each, or a `WorkerDiedError`, in the order in which they end.

        An exception that a task raises is raised here.

        Args:
            tasks: can be pickled, like their results.
            log: called with a line for a person; of a task in a worker, when it ends.
            progress: called with the share of all tasks done, 0 to 1.

        Raises:
            ConfigurationError: the scheduler is gone, or a worker has other software than this process (`_software`),
                so that its results may differ.
        """
        done, lost = 0, list[int]()

        def advance(share: float) -> None:
            progress((done + share) / len(tasks))

        results: Results
        if not self._scheduler and min(self._workers, len(tasks)) <= 1:
            results = ((index, self._work(task, log, advance)) for index, task in enumerate(tasks))
        else:
            results = self._run_in_workers(tasks, range(len(tasks)), log)
        for index, result in results:
            if isinstance(result, WorkerDiedError):
                lost.append(index)
                continue
            done += 1
            advance(0.0)
            yield index, result
        for suspect in lost:  # alone, as another task may have ended its worker
            for pair in self._run_in_workers(tasks, [suspect], log):
                done += 1
                advance(0.0)
                yield pair

    def _run_in_workers(self, tasks: Sequence[Any], indices: Sequence[int], log: Log) -> Results:
        waiting, pending = deque(indices), dict[Future[Any], int]()
        limit = len(indices) if self._scheduler else self._workers
        try:
            while waiting or pending:
                while waiting and len(pending) < limit:
                    index = waiting.popleft()
                    pending[self._submit(tasks[index])] = index
                for future in wait_for(pending, return_when=FIRST_COMPLETED).done:
                    yield pending.pop(future), self._result_of(future, log)
        finally:
            for future in pending:
                future.cancel()

    def _submit(self, task: Any) -> Future[Any]:
        with _environment_of_workers():
            try:
                self._executor = self._executor or self._start_processes()
                return self._executor.submit(_run_task, *self._shared, task)
            except BrokenExecutor:  # by the last task of a worker that died
                self._executor = None
                return self._submit(task)

    def _result_of(self, future: Future[Any], log: Log) -> Any:
        try:
            result, lines = future.result()
        except self._died as error:
            return WorkerDiedError(" ".join(str(error).split()))
        except CancelledError as error:
            raise self._refused("a scheduler that stays", error) from None
        for line in lines:
            log(line)
        return result

    def _start_processes(self) -> Executor:
        context = multiprocessing.get_context("spawn")
        theirs, ours = context.Pipe(duplex=False)
        executor = ProcessPoolExecutor(self._workers, context, _begin_process, (theirs, self._work))
        self._stack.callback(executor.shutdown, cancel_futures=True)
        self._stack.callback(ours.close)  # before, which ends the processes
        return executor

    def _connect(self) -> None:
        import dask
        from distributed import Client, KilledWorker
        from distributed import TimeoutError as ClusterTimeoutError

        try:
            client = Client(self._scheduler, timeout=CONNECT_TIMEOUT, set_as_default=False)
            self._stack.callback(client.close)
            client.wait_for_workers(1, timeout=60.0)  # the first may still start
        except (OSError, ValueError, ClusterTimeoutError) as error:
            self._stack.close()
            raise self._refused("the address of a running Dask scheduler that has workers", error) from None
        # The work is sent once; Dask warns beyond 10 MB, which a few recorded runs have. It is a task of its own and no
        # scattered data, which would be lost with the workers that hold it.
        with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GB"}):
            self._shared = client.submit(pickle.loads, pickle.dumps(self._work), pure=False), _software()
        self._executor = client.get_executor(pure=False)
        self._died = (KilledWorker,)

    def _refused(self, expectation: str, problem: object) -> ConfigurationError:
        words = " ".join(str(problem).split())
        return ConfigurationError("scheduler", self._scheduler, f"{expectation} ({words})" if words else expectation)


@contextmanager
def _environment_of_workers() -> Iterator[None]:
    """Block signals that are meant for the parent, which ends its workers itself, and set `ONE_THREAD`.

    A process keeps both as they are when it starts.
    """
    before = {name: os.environ[name] for name in ONE_THREAD if name in os.environ}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name in ONE_THREAD:
            del os.environ[name]
        os.environ.update(before)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _begin_process(parent: Connection, work: Work) -> None:
    """Keep the work, and end this process, whatever it does, when the parent closes its end of the pipe or ends."""

    def end() -> None:
        parent.poll(None)
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()
    _WORK.append(work)


def _run_task(work: Work | None, software: Mapping[str, str], task: Any) -> tuple[Any, list[str]]:
    """Run a task in a worker; return its result and the lines that it logged.

    Args:
        work: of `TaskRunner`; None in a process, which has it.
        software: of the process that gives the task, which this one must have too.
        task: argument of the work.

    Raises:
        ConfigurationError: this worker has other software.
    """
    for name, expected in software.items():
        if (present := _software()[name]) != expected:
            from distributed import get_worker

            where = f"{name} of worker {get_worker().address}"
            raise ConfigurationError(where, present, f"{expected or 'none'}, as in the process that gives the tasks")
    lines: list[str] = []
    with _ONE_AT_A_TIME:
        return (work or _WORK[0])(task, lines.append, lambda share: None), lines


@cache
def _software() -> dict[str, str]:
    """Return the versions of a process's software, looked up once: what is imported stays.

    A result has the same bits only where these are the same.
    """
    versions = {"Python": ".".join(platform.python_version_tuple()[:2])}
    # OpenCV comes by pip or as Ubuntu's package.
    for name in ("magnetosuture_thread", "numpy", "scipy", "numba", "opencv-python-headless", "osqp"):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = ""
    return versions
