"""Test doubles of graph and host: they record calls, and show a needle with a straight thread behind it."""

from __future__ import annotations

import asyncio
import time
from typing import Any

import cv2
import numpy as np

NODES = 40
TAIL = (0.002, 0.010)  # m; the needle points east
REST = {"commanded": [0.0, 0.0], "filtered": [0.0, 0.0], "applied": [0.0, 0.0]}


def thread() -> np.ndarray:
    """Return the thread, from the tail on [m]."""
    return np.column_stack([TAIL[0] - np.linspace(0.0, 0.012, NODES), np.full(NODES, TAIL[1])])


def picture() -> bytes:
    """Return a camera frame as the bytes of a JPEG file."""
    return cv2.imencode(".jpg", np.full((480, 640, 3), 200, np.uint8))[1].tobytes()


def state(friction: str = "free", count: int = 0) -> dict[str, Any]:
    """Return the state of a graph that is armed and tracked, as `Graph.state` has it."""
    line = thread().tolist()
    factor = 0.9**count if friction == "sliding" else 1.0
    return {
        "time": time.monotonic(),
        "needle_length": 0.007,
        "needle_curvature": 0.0,
        "needle": {"tail": list(TAIL), "heading": 0.0, "age": 0.02},
        "axis": None,
        "tracker": {
            **{"state": "tracked", "reason": "", "confidence": 0.97},
            "view": {"centre": [322.0, 238.0], "scale": 8e-5, "rotation": 0.0},
        },
        "measured": line,
        "predicted": {"vertices": line, "residual": 1e-9, "step_time": 2.1e-4, "status": "solved", "age": 0.02},
        **{"estimated": None, "forecast": None},
        "margins": {
            **{"valid": True, "of": "prediction", "bound": None, "reason": "", "contact": []},
            "clearance": [1e-3] * NODES,
            "least": {"connectivity": 4.1e-6, "compression": 1.2e-4, "obstacle": 1e-3},
            "friction": {"state": friction, "nodes": list(range(13, 13 + count)), "slowdown": factor},
        },
        "scene": {
            **{"version": "0123456789abcdef", "dish_diameter": 0.035, "dish_depth": 0.003},
            "shapes": [
                {"name": "ring", "kind": "instrument", "label": [0.0, 0.0], "disc": [0.0, 0.0, 0.003]},
                {
                    **{"name": "left", "kind": "tissue", "label": [-0.01, -0.008], "holes": []},
                    "outline": [[-0.013, -0.01], [-0.007, -0.01], [-0.007, -0.006], [-0.013, -0.006]],
                },
            ],
        },
        "filter": {
            **{**REST, "source": "operator", "slowdown": factor, "active": []},
            **{"overridden": "", "reason": "", "age": 0.01},
        },
        "bridge": {
            **{"state": "active", "armed": True, "emergency_stopped": False, "reasons": [], **REST, "saturated": False},
            **{"driver": "simulated", "driver_ready": True, "driver_warnings": []},
            **{"current": [0.0] * 4, "measured_current": [0.0] * 4, "refused": 0, "age": 0.01},
        },
        "nodes": {
            "vision_tracker": {"level": "ok", "message": "needle tracked", "values": {}, "age": 0.4},
            "thread_model": {"level": "ok", "message": "predicting", "values": {}, "age": 0.3},
            "coil_bridge": {"level": "ok", "message": "armed", "values": {"commissioning": "False"}, "age": 0.5},
        },
    }


def procedure_state(state_name: str = "idle", **values: Any) -> dict[str, Any]:
    """Return the state of a graph with a needle planner, whose procedure is in a state."""
    procedure = {
        "state": state_name,
        "name": "" if state_name == "idle" else "hernia",
        "goals": [] if state_name == "idle" else ["pass_through", "wrap"],
        **{"goal": 0, "goals_met": 0, "progress": 0.0, "reason": "", "resumes": False, "hold_to_run": False},
        "clearance": None,
    }
    return {**state(), "procedure": {**procedure, **values}, "plan": [], "procedures": ["hernia", "slalom"]}


def forecast_state(*events: str) -> dict[str, Any]:
    """Return the state of a graph that forecasts its thread: it moves up by 1 mm in each of three seconds."""
    ghosts = [{"time": float(k), "vertices": (thread() + np.array([0.0, 1e-3 * k])).tolist()} for k in (1, 2, 3)]
    forecast = {"horizon": 3.0, "ghosts": ghosts, "events": list(events), "problem": "", "age": 0.02}
    return {**state(), "forecast": forecast}


def estimated_state() -> dict[str, Any]:
    """Return the state of a graph that estimates its thread, half of which is hidden, and which something holds."""
    shown = state()
    held = {
        "position": thread()[-9].tolist(),
        "direction": [-0.8, 0.6],
        "force": 2e-4,
        "text": "held at 22 mm of the thread: 0.2 mN up and to the left",
    }
    shown["estimated"] = {
        "vertices": thread().tolist(),
        "deviation": np.linspace(2e-5, 3e-4, NODES).tolist(),
        **{"prediction_only": False, "unmeasured_for": 0.0, "hidden": 0.5},
        "disturbances": [held],
        "age": 0.02,
    }
    shown["margins"] |= {"of": "estimate", "bound": 9.5e-4}
    return shown


class RecordingGraph:
    """Keeps what it is told, and shows a state that a test may change."""

    def __init__(self) -> None:
        self.shown = state()
        self.picture: tuple[int, bytes] | None = None
        self.commands: list[tuple[float, tuple[float, float]]] = []  # when, and what
        self.actions: list[str] = []
        self.procedures: list[tuple[str, str, bool]] = []
        self.holds: list[float] = []
        self.tips: list[tuple[float, float]] = []
        self.refusal = ""

    @property
    def velocities(self) -> list[tuple[float, float]]:
        """The commands without their times."""
        return [velocity for _, velocity in self.commands]

    @property
    def last(self) -> tuple[float, float] | None:
        """The last command, None before the first."""
        return self.commands[-1][1] if self.commands else None

    def publish_velocity(self, velocity: tuple[float, float]) -> None:
        """Keep a command."""
        self.commands.append((time.monotonic(), velocity))
        if self.shown["filter"]:
            factor = self.shown["filter"]["slowdown"]
            self.shown["filter"].update(commanded=list(velocity), filtered=[entry * factor for entry in velocity])

    def publish_hold(self) -> None:
        """Record that the page is held."""
        self.holds.append(time.monotonic())

    async def point_at_tip(self, position: tuple[float, float]) -> str:
        """Keep a point; from then on the needle's heading is known."""
        self.tips.append(position)
        self.shown.update(needle=self.shown["axis"], axis=None)
        return self.refusal

    async def execute_procedure(self, action: str, procedure: str, hold_to_run: bool) -> str:
        """Record a request, and change the state of the procedure."""
        self.procedures.append((action, procedure, hold_to_run))
        if self.refusal:
            return self.refusal
        shown = self.shown["procedure"]
        if action == "plan":
            shown.update(state="ready", name=procedure, hold_to_run=hold_to_run, goals=["pass_through", "wrap"])
            self.shown["plan"] = [[0.0, 0.0], [0.004, 0.002], [0.008, 0.004]]
        else:
            states = {"resume": "running", "pause": "paused", "abort": "failed"}
            shown.update(state=states[action], reason="" if action == "resume" else f"{action} by a person")
        return ""

    async def execute_action(self, action: str) -> str:
        """Record an action, and change the state of the bridge."""
        self.actions.append(action)
        await asyncio.sleep(0)
        if self.refusal:
            return self.refusal
        bridge = self.shown["bridge"]
        changes: dict[str, dict[str, Any]] = {
            "arm": {"armed": True},
            "disarm": {"armed": False},
            "stop": {"armed": False, "emergency_stopped": True, "state": "fault", "reasons": ["emergency stop"]},
            "reset": {"emergency_stopped": False, "state": "active", "reasons": ["disarmed"]},
        }
        bridge.update(changes[action])
        return ""

    def state(self) -> dict[str, Any]:
        """Return what is shown now."""
        return {**self.shown, "time": time.monotonic()}

    def frame(self) -> tuple[int, bytes] | None:
        """Return the picture that is shown."""
        return self.picture


class RecordingHost:
    """Keeps what it is told."""

    def __init__(self) -> None:
        self.requests: list[tuple[str, object]] = []
        self.operator = ""
        self.shown: dict[str, Any] = {
            **{"mode": "simulated", "setup": "hernia_ring", "setups": ["hernia_ring", "petri_35mm_polyamide"]},
            **{"can_pause": True, "paused": False, "can_record": True, "recording": "", "busy": "", "simulated": True},
            **{"can_measure": True, "measurement": None},
        }
        self.shot, self.cancelled = b"", 0

    def state(self) -> dict[str, Any]:
        """Return what is shown now."""
        return dict(self.shown)

    async def select_setup(self, setup: str) -> str:
        """Record the setup; refuse an unknown one."""
        self.requests.append(("select_setup", setup))
        if setup not in self.shown["setups"]:
            return f"no setup {setup}"
        self.shown["setup"] = setup
        return ""

    async def set_paused(self, paused: bool) -> str:
        """Record pause and resume."""
        self.requests.append(("pause", paused))
        self.shown["paused"] = paused
        return ""

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Record start and end of a recording."""
        self.operator = operator
        self.requests.append(("record", recording))
        self.shown["recording"] = "output/console/take_1" if recording else ""
        return ""

    async def measure(self, action: str, marks: tuple[float, ...]) -> str:
        """Record a measurement; it runs until it is cancelled."""
        self.requests.append((action, marks))
        self.shown["measurement"] = {"name": action, "state": "running", "lines": ["at rest: 2 µm"], "picture": ""}
        return ""

    def cancel(self) -> None:
        """End the measurement."""
        self.cancelled += 1
        if self.shown["measurement"] is not None:
            self.shown["measurement"]["state"] = "failed"

    def picture(self) -> bytes:
        """Return the picture that is shown."""
        return self.shot
