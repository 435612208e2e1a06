"""Many independent tasks on several processors: processes of this machine, or the workers of a Dask cluster.

Without a scheduler's address the process pool runs them, not a local Dask cluster: it takes less processor time to
start, needs no further packages, and its processes end with this one however that ends.
"""

from __future__ import annotations

from magnetosuture_thread.workers.pool import Log, Progress, TaskRunner, Work, WorkerDiedError, WorkerPool

__all__ = ["Log", "Progress", "TaskRunner", "Work", "WorkerDiedError", "make_runner"]


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
