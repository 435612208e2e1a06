"""Tasks on the workers of a Dask cluster; needs the extra `cluster`."""

from __future__ import annotations

import asyncio
import pickle
import platform
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import dask
from distributed import Client, KilledWorker, as_completed, get_worker

from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.workers import Log, Progress, Work, WorkerDiedError

CONNECT_TIMEOUT = 20.0  # s to reach the scheduler
# A result has the same bits only where these are the same. OpenCV comes by pip or as Ubuntu's package.
SOFTWARE = ("magnetosuture_thread", "numpy", "scipy", "numba", "opencv-python-headless", "osqp")
_ONE_AT_A_TIME = threading.Lock()  # in a worker of several threads: matplotlib is not made for them


class ClusterRunner:
    """Workers of a Dask cluster that run tasks; implements `TaskRunner`.

    Dask repeats the tasks of a worker that is lost on others, and gives up a task that was on as many lost workers as
    the scheduler allows, whichever task ended them: each such task is repeated alone, and gives a `WorkerDiedError`
    only where it ends workers then too. Log lines of a task come when it ends. Whatever ends the context cancels what
    has not begun; what a worker has begun it still ends. Each task compares the software of its worker with this
    process's, as a worker may join later or come back with another version.

    Args:
        work: called with task, log and progress; can be pickled.
        address: of the scheduler.

    Raises:
        ConfigurationError: on entering: there is no scheduler, or it has no workers.
    """

    def __init__(self, work: Work, address: str) -> None:
        self._work = pickle.dumps(work)
        self._address = address

    def __enter__(self) -> ClusterRunner:
        """Connect to the scheduler."""
        try:
            self._client = Client(self._address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, asyncio.TimeoutError) as error:
            raise self._refused("the address of a running Dask scheduler", error) from None
        try:
            self._client.wait_for_workers(1, timeout=60.0)  # the first may still start
            # The work is sent once; Dask warns beyond 10 MB, which a few recorded runs have.
            with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GB"}):
                # A task of its own and not scattered data, which would be lost with the workers that hold it.
                self._loaded = self._client.submit(pickle.loads, self._work, pure=False)
        except TimeoutError as error:
            self._client.close()
            raise self._refused("a scheduler with workers", error) from None
        return self

    def __exit__(self, *_: object) -> None:
        """Disconnect, which cancels what has not begun."""
        self._client.close()

    def run(
        self, tasks: Sequence[Any], log: Log = lambda text: None, progress: Progress = lambda share: None
    ) -> Iterator[tuple[int, Any]]:
        """Run tasks; see `TaskRunner`.

        Raises:
            ConfigurationError: the scheduler is gone, or a worker has other software than this process (`SOFTWARE`, or
                another minor version of Python), so that its results may differ.
        """
        done, lost = 0, list[int]()
        for index, result in self._run_together(tasks, range(len(tasks)), log):
            if isinstance(result, WorkerDiedError):
                lost.append(index)
                continue
            done += 1
            progress(done / len(tasks))
            yield index, result
        for suspect in lost:  # alone, as another task may have ended their workers
            yield from self._run_together(tasks, [suspect], log)
            done += 1
            progress(done / len(tasks))

    def _run_together(self, tasks: Sequence[Any], indices: Sequence[int], log: Log) -> Iterator[tuple[int, Any]]:
        software = _software()
        futures = {
            self._client.submit(_run_task, self._loaded, tasks[index], software, pure=False): index for index in indices
        }
        try:
            for future in as_completed(list(futures), loop=self._client.loop):
                yield futures.pop(future), self._result_of(future, log)  # what nobody names the cluster forgets
        finally:
            self._client.cancel(list(futures))

    def _result_of(self, future: Any, log: Log) -> Any:
        try:
            result, lines = future.result()
        except _OtherSoftwareError as error:
            raise self._refused(*error.args) from None
        except ModuleNotFoundError as error:
            raise self._refused("workers with the same packages as here", error) from None
        except KilledWorker as error:
            return WorkerDiedError(" ".join(str(error).split()))
        except (asyncio.CancelledError, OSError) as error:
            if future.status == "error":
                raise
            raise self._refused("a scheduler that stays", error) from None
        for line in lines:
            log(line)
        return result

    def _refused(self, expectation: str, problem: object) -> ConfigurationError:
        words = " ".join(str(problem).split())
        return ConfigurationError("scheduler", self._address, f"{expectation} ({words})" if words else expectation)


class _OtherSoftwareError(Exception):
    """A worker has other software than the process that gives the tasks: what was expected, and what it has."""


def _run_task(work: Work, task: Any, software: Mapping[str, str]) -> tuple[Any, list[str]]:
    """Run a task on a worker; return its result and the lines that it logged.

    Args:
        work: as for `ClusterRunner`.
        task: its argument.
        software: of the process that gives the task.

    Raises:
        _OtherSoftwareError: that of this worker is another.
    """
    for name, expected in software.items():
        if (found := _software().get(name)) != expected:
            problem = f"worker {get_worker().address} has {found or 'none'}"
            raise _OtherSoftwareError(f"workers with {name} {expected}, as here", problem)
    lines: list[str] = []
    with _ONE_AT_A_TIME:
        return work(task, lines.append, lambda share: None), lines


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
