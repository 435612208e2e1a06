"""What a procedure has to know while the needle moves: needle, thread, coil bridge, and who holds the page."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.planning.settings import NeedlePlannerSettings

NO_POSE, NO_THREAD, NO_MARGINS = "no needle pose yet", "no thread yet", "no margins of the thread yet"
MAX_NAMED = 3  # forces, in a reason
NOT_HELD = "nobody holds the page"


@dataclass(frozen=True)
class _Margins:
    time: float
    reason: str  # why they are not valid; empty if they are
    friction_nodes: int
    slowdown: float
    scene_version: str


class LoopState:
    """Collects what the nodes of the loop report, and returns why a procedure cannot go on.

    Pure: `now` is a monotonic time [s].

    Args:
        settings: of the planner.

    Attributes:
        scene_version: of the planner's scene; empty for none.
        hold_to_run: whether a procedure goes on only while somebody holds the page.
    """

    def __init__(self, settings: NeedlePlannerSettings) -> None:
        self._settings = settings
        self.scene_version, self.hold_to_run = "", False
        self._pose, self._outside = -math.inf, ""
        self._tracker = ""
        self._margins: _Margins | None = None
        self._tension = self._drift = 0.0
        self._vertices: Callable[[], Points | None] | None = None
        self._estimated, self._estimate_problem = -math.inf, ""
        self._disturbances: dict[float, str] = {}
        self._accepted: set[float] = set()
        self._held = -math.inf
        self._graph_problem = ""
        self._last_problem, self._last_problem_time = NO_POSE, -math.inf

    def on_pose(self, now: float, distance: float, dish_radius: float) -> None:
        """Register a needle pose, with the distance of its tail from the dish's centre [m]."""
        self._pose = now
        self._outside = "" if distance <= dish_radius else "the needle is outside of the dish"

    def on_tracker(self, problem: str) -> None:
        """Register why the tracker has no needle in a frame; empty if it has."""
        self._tracker = problem and f"the needle is not tracked: {problem}"

    def on_prediction(self, now: float, tension: float, vertices: Callable[[], Points | None]) -> None:
        """Register a predicted thread: the peak of its tension [N], and what returns its vertices.

        Where no thread is estimated any more, nothing of the last estimate counts.
        """
        self._tension = tension
        if now - self._estimated > self._settings.thread_timeout:
            self._vertices, self._estimate_problem, self._disturbances = vertices, "", {}

    def on_estimate(
        self,
        now: float,
        unmeasured_for: float,
        disturbances: Mapping[float, str],
        vertices: Callable[[], Points | None],
    ) -> None:
        """Register an estimated thread.

        Args:
            now: a monotonic time [s].
            unmeasured_for: time since the thread was measured [s].
            disturbances: forces on it that the model does not know of, as texts, each by when it was found first [s].
            vertices: returns them, shape (n + 1, 2) [m]; None where they are not valid.
        """
        self._estimated, self._vertices, self._estimate_problem = now, vertices, ""
        if not unmeasured_for <= self._settings.unmeasured_timeout:  # also where it is no number
            self._estimate_problem = f"the thread has not been measured for {unmeasured_for:.1f} s"
        self._accepted &= disturbances.keys()
        self._disturbances = dict(disturbances)

    def accept_disturbances(self) -> None:
        """Go on in spite of the forces that are known now, as a person who begins or resumes wants; new ones count."""
        self._accepted = set(self._disturbances)

    def on_bridge(self, drift: float) -> None:
        """Register the velocity across the needle's chord that the bridge compensates [m/s]; 0 if it is no number."""
        self._drift = drift if math.isfinite(drift) else 0.0

    def on_margins(self, now: float, reason: str, friction_nodes: int, slowdown: float, scene_version: str) -> None:
        """Register the thread's margins, or the reason why they are not valid."""
        self._margins = _Margins(now, reason, friction_nodes, slowdown, scene_version)

    def on_hold(self, now: float) -> None:
        """Register that somebody holds the page."""
        self._held = now

    def on_graph(self, problem: str) -> None:
        """Register what is wrong with the graph: nobody follows the commands, or another node commands too."""
        self._graph_problem = problem

    def shift(self, duration: float) -> None:
        """Take what is known to be younger by a time in which nothing was heard, as while a path is planned [s]."""
        self._pose += duration
        self._estimated += duration
        self._held += duration
        self._last_problem_time += duration
        if self._margins is not None:
            self._margins = replace(self._margins, time=self._margins.time + duration)

    def has_pose(self, now: float) -> bool:
        """Return whether the needle's pose is known now."""
        return now - self._pose <= self._settings.pose_timeout

    def condition(self, now: float) -> ThreadCondition:
        """Return what is known, with the reason why a procedure cannot go on; that of before until it has settled.

        Where the thread alone is the reason, or all is known and has to settle, the needle may be kept in place.
        """
        needle, page = self._needle_problem(now), self._page_problem(now)
        may_hold = not (needle or page)
        problem = needle or self._thread_problem(now) or page
        if problem:
            self._last_problem, self._last_problem_time = problem, now
        elif now - self._last_problem_time < self._settings.settle:
            problem = self._last_problem
        margins = self._margins
        return ThreadCondition(
            None if self._vertices is None else self._vertices(),
            self._tension,
            0 if margins is None else margins.friction_nodes,
            1.0 if margins is None or self._settings.friction_feedback != "all" else margins.slowdown,
            problem,
            self._drift,
            may_hold,
        )

    def _page_problem(self, now: float) -> str:
        held = now - self._held <= self._settings.hold_timeout
        return NOT_HELD if self.hold_to_run and not held else ""

    def _needle_problem(self, now: float) -> str:
        """Return the first reason why the needle cannot be commanded; empty for none."""
        if not self.has_pose(now):
            if not math.isfinite(self._pose):
                return NO_POSE
            return self._tracker or f"no needle pose for more than {self._settings.pose_timeout:g} s"
        return self._outside or self._graph_problem  # in a frame or two it may be missed

    def _thread_problem(self, now: float) -> str:
        margins = self._margins
        if self._vertices is None:
            return NO_THREAD
        if margins is None:
            return NO_MARGINS
        if margins.reason:
            return f"the thread is not known: {margins.reason}"
        if now - margins.time > self._settings.thread_timeout:
            return f"no margins of the thread for more than {self._settings.thread_timeout:g} s"
        if margins.scene_version != self.scene_version:
            return "thread_model goes by another scene"
        if self._estimate_problem:
            return self._estimate_problem
        new = [text for since, text in self._disturbances.items() if since not in self._accepted]
        return f"an unmodelled contact: the thread is {'; '.join(new[:MAX_NAMED])}" if new else ""
