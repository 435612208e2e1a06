"""What runs many independent tasks: the interface of the process pool and of the Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Protocol

Log = Callable[[str], None]
Progress = Callable[[float], None]
Work = Callable[[Any, Log, Progress], Any]


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
        """Run tasks; give the index and the result of each, or a `WorkerDiedError`, in the order in which they end.

        An exception that a task raises is raised here.

        Args:
            tasks: can be pickled, like their results.
            log: called with a line for a person.
            progress: called with the share of all tasks done, 0 to 1.
        """
