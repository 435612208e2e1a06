"""Test doubles of graph and host: they record calls, and show a scene like a hernia's."""

from __future__ import annotations

import asyncio
import functools
import time
from typing import Any

import numpy as np

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import points_at
from magnetosuture_thread.rig.camera import CameraScene, DishCamera, encode_jpeg

VIEW = DishView((322.0, 238.0), 8e-5)
NODES = 40
REST = {"commanded": [0.0, 0.0], "filtered": [0.0, 0.0], "applied": [0.0, 0.0]}
RING = 0.006
# Tissue on both sides of the ring: from left, bottom to right, top [m].
BLOCKS = {"left": (-0.0135, -0.0045, -0.0075, 0.0045), "right": (0.0075, -0.0045, 0.0135, 0.0045)}


def thread(points: int = NODES, wander: float = 0.0) -> np.ndarray:
    """Return a thread that lies around the ring and runs on to its free end, from the tail on [m]."""
    angles = np.linspace(1.45, -1.0, 60)
    wrapped = (RING + 0.00045) * np.column_stack([np.cos(angles), np.sin(angles)])
    ahead, behind = np.array([-np.sin(1.45), np.cos(1.45)]), np.array([np.sin(-1.0), -np.cos(-1.0)])
    out = wrapped[0] + np.linspace(0.0022, 0.0, 12)[:, None] * ahead
    along = np.linspace(0.0, 0.008, 40)[:, None]
    free = wrapped[-1] + along * behind + 40.0 * along**2 * np.array([-0.4, -0.6])
    result = resampled_points(np.vstack([out[:-1], wrapped, free[1:]]), points)
    result[:, 1] += wander * np.sin(np.linspace(0.0, 9.0, points))
    return result


def resampled_points(line: np.ndarray, count: int) -> np.ndarray:
    """Return equally spaced points of a line."""
    return points_at(line, np.linspace(0.0, np.linalg.norm(np.diff(line, axis=0), axis=1).sum(), count))


def heading() -> float:
    """Return the needle's, straight on from the thread [rad]."""
    line = thread(200)
    return float(np.arctan2(*(line[0] - line[1])[::-1]))


@functools.cache
def picture() -> bytes:
    """Return a frame of the scene as the bytes of a JPEG file."""
    camera = DishCamera(CameraScene(obstacles=[Disc((0.0, 0.0), RING)]), VIEW, seed=5)
    return encode_jpeg(camera.render(thread()[0], heading(), thread(200, 4e-5)), 90).tobytes()


def clearances(line: np.ndarray) -> list[float]:
    """Return the distance of each node from the ring [m]."""
    return (np.linalg.norm(line, axis=1) - RING).tolist()


def block(name: str) -> dict[str, Any]:
    """Return a block of tissue as the page gets it."""
    left, bottom, right, top = BLOCKS[name]
    outline = [[left, bottom], [right, bottom], [right, top], [left, top]]
    label = [(left + right) / 2.0, (bottom + top) / 2.0]
    return {"name": name, "kind": "tissue", "label": label, "outline": outline, "holes": []}


def state(friction: str = "free", count: int = 0, nodes: int = NODES) -> dict[str, Any]:
    """Return the state of a graph that is armed and tracked, as `Graph.state` has it."""
    line = thread(nodes)
    factor = 0.9**count if friction == "sliding" else 1.0
    return {
        "time": time.monotonic(),
        "needle_length": 0.007,
        "needle_curvature": 0.0,
        "needle": {"tail": line[0].tolist(), "heading": heading(), "age": 0.02},
        "tracker": {
            "state": "tracked",
            "reason": "",
            "confidence": 0.97,
            "view": {"centre": list(VIEW.centre_px), "scale": VIEW.metres_per_pixel, "rotation": VIEW.rotation},
        },
        "measured": thread(120, 4e-5).tolist(),
        "predicted": {
            "vertices": line.tolist(),
            "residual": 1e-9,
            "step_time": 2.1e-4,
            "status": "solved",
            "age": 0.02,
        },
        "estimated": None,
        "forecast": None,
        "margins": {
            "valid": True,
            "of": "prediction",
            "bound": None,
            "reason": "",
            "clearance": clearances(line),
            "least": {"connectivity": 4.1e-6, "compression": 1.2e-4, "obstacle": min(clearances(line))},
            "contact": [],
            "friction": {"state": friction, "nodes": list(range(13, 13 + count)), "slowdown": factor},
        },
        "scene": {
            "version": "0123456789abcdef",
            "dish_diameter": 0.035,
            "dish_depth": 0.003,
            "shapes": [
                {"name": "ring", "kind": "instrument", "label": [0.0, 0.0], "disc": [0.0, 0.0, RING]},
                *map(block, BLOCKS),
            ],
        },
        "filter": {
            **REST,
            "source": "operator",
            "slowdown": factor,
            "active": [],
            **{"overridden": "", "reason": "", "age": 0.01},
        },
        "bridge": {
            "state": "active",
            "armed": True,
            "emergency_stopped": False,
            "reasons": [],
            **REST,
            "saturated": False,
            **{"driver": "simulated", "driver_ready": True, "driver_warnings": []},
            **{"current": [0.0] * 4, "measured_current": [0.0] * 4, "refused": 0, "age": 0.01},
        },
        "nodes": {
            "vision_tracker": {"level": "ok", "message": "needle tracked", "values": {}, "age": 0.4},
            "thread_model": {"level": "ok", "message": "predicting", "values": {}, "age": 0.3},
            "coil_bridge": {"level": "ok", "message": "armed", "values": {}, "age": 0.5},
        },
    }


def procedure_state(state_name: str = "idle", **values: Any) -> dict[str, Any]:
    """Return the state of a graph with a needle planner, whose procedure is in a state."""
    shown = state()
    shown["procedure"] = {
        "state": state_name,
        "name": "" if state_name == "idle" else "hernia",
        "goals": [] if state_name == "idle" else ["pass_through", "wrap"],
        "goal": 0,
        "goals_met": 0,
        "progress": 0.0,
        "reason": "",
        "resumes": False,
        "hold_to_run": False,
        "clearance": None,
        **values,
    }
    return {**shown, "plan": [], "procedures": ["hernia", "slalom"]}


def forecast_state(*events: str, **values: Any) -> dict[str, Any]:
    """Return the state of a graph that forecasts its thread: it moves up by 1 mm in each of three seconds."""
    shown = state(**values)
    line = thread(len(shown["predicted"]["vertices"]))
    ghosts = [{"time": float(k), "vertices": (line + np.array([0.0, 1e-3 * k])).tolist()} for k in (1, 2, 3)]
    shown["forecast"] = {"horizon": 3.0, "ghosts": ghosts, "events": list(events), "problem": "", "age": 0.02}
    return shown


def estimated_state(hidden: bool = False, found: bool = False, **values: Any) -> dict[str, Any]:
    """Return the state of a graph that estimates its thread too, while the model alone has gone another way.

    Args:
        hidden: whether nothing was measured for 3.2 s; else half of the thread is hidden.
        found: whether something holds the thread that the model does not know.
        values: see `state`.
    """
    shown = state(**values)
    line = thread(shown_nodes := len(shown["predicted"]["vertices"]))
    half = np.arange(shown_nodes) > shown_nodes // 2
    deviation = np.where(half | hidden, 3e-4 * np.linspace(0.1, 1.0, shown_nodes), 2e-5)
    off = np.column_stack([np.zeros(shown_nodes), 1.2e-3 * np.linspace(0.0, 1.0, shown_nodes) ** 2])
    shown["predicted"]["vertices"] = (line + off).tolist()
    at = shown_nodes - 9
    shown["estimated"] = {
        "vertices": line.tolist(),
        "deviation": deviation.tolist(),
        "prediction_only": hidden,
        "unmeasured_for": 3.2 if hidden else 0.0,
        "hidden": 1.0 if hidden else 0.5,
        "disturbances": [
            {
                "position": line[at].tolist(),
                "direction": [-0.8, 0.6],
                "force": 2e-4,
                "text": "held at 22 mm of the thread: 0.2 mN up and to the left",
            }
        ]
        if found
        else [],
        "age": 0.02,
    }
    shown["margins"] |= {"of": "estimate", "bound": min(clearances(line)) - 5e-5}
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
            "mode": "simulated",
            "setup": "hernia_ring",
            "setups": ["hernia_ring", "petri_35mm_polyamide"],
            "can_pause": True,
            "paused": False,
            "can_record": True,
            "recording": "",
            "busy": "",
            "simulated": True,
        }

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
