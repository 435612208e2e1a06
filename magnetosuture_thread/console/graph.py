"""Interfaces of the operator page to a running graph and to its host.

SI units and plain JSON types throughout. `Graph.state` returns, where every part is None until its first message:

    {
      "time": float,                   # the graph's time [s]
      "needle_length": float, "needle_curvature": float,   # of the console's settings
      "scene": {"version": str, "dish_diameter": m, "dish_depth": m,
                "shapes": [{"name": str, "kind": "tissue|instrument|wall", "label": [x, y],   # position of its name
                            "disc": [x, y, r]}   # or, in place of the disc,
                           | {..., "outline": [[x, y], ...], "holes": [[[x, y], ...], ...]}]} | None,
      "needle": {"tail": [x, y], "heading": rad, "age": s} | None,
      "camera": {"age": s} | None,     # of the latest image
      "tracker": {"state": "tracked|lost|searching", "reason": str, "confidence": float,
                  "view": {"centre": [u, v], "scale": m_per_px, "rotation": rad} | None, "age": s} | None,
      "measured": [[x, y], ...],       # the measured centreline, may be empty
      "predicted": {"vertices": [[x, y], ...], "residual": float, "step_time": float, "status": str, "age": s} | None,
      "estimated": {"vertices": [[x, y], ...], "deviation": [m, ...],   # of each vertex across the thread
                    "prediction_only": bool, "unmeasured_for": s, "hidden": share,
                    "disturbances": [{"position": [x, y], "direction": [x, y], "force": N, "text": str}, ...],
                    "age": s} | None,
      "forecast": {"horizon": s,        # while the present command is held
                   "ghosts": [{"time": s, "vertices": [[x, y], ...]}, ...],   # the thread, last at the horizon
                   "events": [str],     # what happens when
                   "problem": str,      # why it ends early, empty if it does not
                   "age": s} | None,
      "margins": {"valid": bool, "of": "estimate|prediction|nothing", "reason": str,
                  "clearance": [float | None, ...],   # of each node, minimum over wall and shapes; None: none near
                  "least": {"connectivity": m, "compression": m, "obstacle": m, ...},   # of the kinds present
                  "bound": m | None,   # least of the 99 % bounds of all clearances
                  "contact": [node, ...],
                  "friction": {"state": "unknown|free|pulled|resting", "nodes": [int], "slowdown": float}} | None,
      "filter": {"source": "operator|needle|", "commanded": [vx, vy], "filtered": [vx, vy], "applied": [vx, vy],
                 "slowdown": float, "active": [str], "overridden": str, "reason": str, "age": s} | None,
      "bridge": {"state": "unconfigured|inactive|active|fault", "armed": bool, "emergency_stopped": bool,
                 "reasons": [str], "commanded": [vx, vy], "filtered": [vx, vy], "applied": [vx, vy], "saturated": bool,
                 "driver": str, "driver_ready": bool, "driver_warnings": [str], "current": [A],
                 "measured_current": [A], "refused": int, "age": s} | None,
      "procedure": {"state": "idle|ready|running|paused|done|failed", "name": str, "goals": [str], "goal": int,
                    "goals_met": int, "progress": share, "reason": str, "resumes": bool, "hold_to_run": bool,
                    "clearance": m | None} | None,   # None where no needle planner runs
      "plan": [[x, y], ...],           # where the middle of the needle is to go, may be empty
      "procedures": [str],             # names of those whose shapes the scene has
      "nodes": {name: {"level": "ok|warn|error|silent", "message": str, "values": {str: str}, "age": s}},
    }

`Host.state` returns

    {"mode": "simulated|graph|replay", "setup": str, "setups": [str], "can_pause": bool, "paused": bool,
     "can_record": bool,
     "recording": str,   # the path, empty if nothing is recorded
     "busy": str,        # operation in progress, empty if none
     "simulated": bool}
"""

from __future__ import annotations

from typing import Any, Protocol


class Graph(Protocol):
    """Interface to a running graph. All calls come from the thread of one asyncio loop."""

    def publish_velocity(self, velocity: tuple[float, float]) -> None:
        """Publish an operator velocity command, stamped now.

        Args:
            velocity: of the needle's tip in the dish plane [m/s].
        """

    async def execute_action(self, action: str) -> str:
        """Execute arm, disarm, stop or reset; return an empty text, or the reason of a refusal."""

    def publish_hold(self) -> None:
        """Publish that the page is held, so that a procedure may go on."""

    async def execute_procedure(self, action: str, procedure: str, hold_to_run: bool) -> str:
        """Plan, resume, pause or abort a procedure; return an empty text, or the reason of a refusal."""

    def state(self) -> dict[str, Any]:
        """Return the present state as a new dictionary; fast enough for 30 calls a second."""

    def frame(self) -> tuple[int, bytes] | None:
        """Return number and JPEG or PNG bytes of the latest camera frame; the number increases."""


class Host(Protocol):
    """Interface to the host of the graph, which may offer setups, pause and recording."""

    def state(self) -> dict[str, Any]:
        """Return what is running and which requests are possible."""

    async def select_setup(self, setup: str) -> str:
        """Run another setup; return an empty text, or the reason of a refusal."""

    async def set_paused(self, paused: bool) -> str:
        """Pause or resume time; return an empty text, or the reason of a refusal."""

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Start or end a recording; return an empty text, or the reason of a refusal.

        Args:
            recording: whether to start.
            operator: who commands the page that has control, "an operator" or "a script"; noted in the recording.
        """
