"""Paths that are planned here and now, or elsewhere while the needle is moved."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Protocol

from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.planner import PlanningError


class PendingPath(Protocol):
    """A path that is being planned, as `concurrent.futures.Future` is one."""

    def done(self) -> bool:
        """Return whether planning has ended."""

    def result(self) -> BodyPath:
        """Return the path, or raise what planning raised."""


PathSubmitter = Callable[[Callable[[], BodyPath]], PendingPath]
"""Begins to plan a path, as `concurrent.futures.Executor.submit` does."""


def plan_now(task: Callable[[], BodyPath]) -> PendingPath:
    """Plan a path here and now."""
    pending: Future[BodyPath] = Future()
    try:
        pending.set_result(task())
    except PlanningError as error:
        pending.set_exception(error)
    return pending
