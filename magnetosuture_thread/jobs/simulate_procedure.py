"""A procedure in the simulated graph: the needle planner in place of the path follower."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

from magnetosuture_thread.evaluation.metrics import finite_or_none
from magnetosuture_thread.jobs.replay_inputs import Progress
from magnetosuture_thread.nodes.clients import DONE, ProcedureClient, ProcedureReport
from magnetosuture_thread.nodes.recorder import Recorder
from magnetosuture_thread.planning.procedure import read_procedure
from magnetosuture_thread.resources import find_procedure_file, find_scene_file
from magnetosuture_thread.setups import Setup

MAX_TIME = 600.0  # s of simulated time for a procedure, as in a campaign
BEGIN_TIMEOUT = 240.0  # s for the planner to begin; the first start on a machine compiles
FINAL_TIME = 0.5  # s that are recorded after the end
POLL_PERIOD = 0.02  # s between two looks at planner and nodes


class ProcedureRun:
    """Executes a procedure in the graph, by the action of the needle planner.

    Args:
        procedure: name of one that ships with the package, or path.
        setup: of the graph.

    Attributes:
        result: name, state, reason, goals met, goals and minimum clearance of the needle's axis by its measured poses
            [m].

    Raises:
        ConfigurationError: there is no such procedure, or it does not fit the setup's scene.
    """

    def __init__(self, procedure: str, setup: Setup) -> None:
        self._procedure = read_procedure(procedure)
        self._path = find_procedure_file(procedure).resolve()
        setup.planner.planner(setup.scene).check(self._procedure)
        self._goals = len(self._procedure.goals)
        self.result: dict[str, Any] = {
            "procedure": self._procedure.name,
            "state": "not begun",
            "reason": "",
            "goals_met": 0,
            "goals": self._goals,
            "min_clearance_m": None,
        }

    @property
    def arguments(self) -> tuple[str, ...]:
        """Arguments for the node, after `--ros-args`: it waits for bridge and recorder."""
        return "-p", "needle_planner:audience:=2"

    @property
    def scene_arguments(self) -> tuple[str, ...]:
        """Arguments for all nodes: the procedure's own scene, if it names one."""
        scene = self._procedure.scene
        return ("-p", f"scene:={find_scene_file(scene).resolve()}") if scene else ()

    def execute(
        self, recorder: Recorder, check: Callable[[], None], duration: float | None, rate: float, progress: Progress
    ) -> str:
        """Record until the procedure has ended, or the time is over; return what went wrong.

        Args:
            recorder: of the graph.
            check: raises where a node has ended, or the run is interrupted.
            duration: the run ends after this many seconds of simulated time; at the procedure's end if None.
            rate: how much faster than real time the rig runs.
            progress: called with the share done, 0 to 1.
        """
        started, began = time.monotonic(), math.inf
        with ProcedureClient(str(self._path)) as client:
            while True:
                check()
                recorder.spin(POLL_PERIOD)
                client.poll()
                now = time.monotonic()
                if client.status is not None:
                    self._update(client.status)
                    self.result["min_clearance_m"] = finite_or_none(client.status.clearance)
                    began = min(began, now)
                if client.result is not None:
                    self._update(client.result)
                    recorder.spin(FINAL_TIME / rate)
                    return "" if client.result.state == DONE else self._problem()
                elapsed = max(0.0, now - began) * rate
                done = (
                    0.0 if client.status is None else (client.status.goals_met + client.status.progress) / self._goals
                )
                progress(done if duration is None else min(1.0, elapsed / duration))
                if duration is not None and elapsed > duration:
                    return ""
                if began == math.inf and now - started > BEGIN_TIMEOUT:
                    self.result["reason"] = client.refusal or "no needle planner"
                    return self._problem()
                if elapsed > MAX_TIME:
                    return f"after {elapsed:.0f} s {self._problem()}"

    def _update(self, report: ProcedureReport) -> None:
        self.result |= {"state": report.state, "reason": report.reason, "goals_met": report.goals_met}

    def _problem(self) -> str:
        result = self.result
        met = f"{result['goals_met']} of {result['goals']} goals met"
        return f"the procedure {result['procedure']} is {result['state']}, {met}: {result['reason']}"
