"""What the operator's page needs of a running graph and of whoever runs it.

SI units and plain JSON types throughout. `Graph.state` returns, where every part may be None until something was heard:

    {
      "time": float,                   # the graph's time [s]
      "needle_length": float, "needle_curvature": float,   # of the console's settings
      "scene": {"version": str, "dish_diameter": m, "dish_depth": m,
                "shapes": [{"name": str, "kind": "tissue|instrument|wall", "label": [x, y],   # where its name can stand
                            "disc": [x, y, r]}   # or, in place of the disc,
                           | {..., "outline": [[x, y], ...], "holes": [[[x, y], ...], ...]}]} | None,
      "needle": {"tail": [x, y], "heading": rad, "age": s} | None,
      "tracker": {"state": "tracked|lost|searching", "reason": str, "confidence": float,
                  "view": {"centre": [u, v], "scale": m_per_px, "rotation": rad} | None} | None,
      "seen": [[x, y], ...],           # the seen centreline, may be empty
      "predicted": {"vertices": [[x, y], ...], "residual": float, "step_time": float, "status": str, "age": s} | None,
      "margins": {"valid": bool, "reason": str,
                  "clearance": [float | None, ...],   # of each node, least over wall and shapes; None: none near
                  "least": {"connectivity": m, "compression": m, "obstacle": m, ...},   # of the kinds present
                  "contact": [node, ...],
                  "friction": {"state": "unknown|free|pulled|resting", "nodes": [int], "slowdown": float}} | None,
      "filter": {"source": "operator|needle|", "commanded": [vx, vy], "filtered": [vx, vy], "applied": [vx, vy],
                 "slowdown": float, "active": [str], "overridden": str, "reason": str, "age": s} | None,
      "bridge": {"state": "unconfigured|inactive|active|fault", "armed": bool, "emergency_stopped": bool,
                 "reasons": [str], "commanded": [vx, vy], "filtered": [vx, vy], "applied": [vx, vy], "saturated": bool,
                 "driver": str, "driver_ready": bool, "driver_warnings": [str], "current": [A],
                 "measured_current": [A], "refused": int, "age": s} | None,
      "nodes": {name: {"level": "ok|warn|error|silent", "message": str, "values": {str: str}, "age": s}},
    }

`Host.state` returns

    {"mode": "simulated|graph|replay", "scenario": str, "scenarios": [str], "can_pause": bool, "paused": bool,
     "can_record": bool,
     "recording": str,   # the path, empty if nothing is recorded
     "busy": str,        # what is under way, empty if nothing
     "simulated": bool}
"""

from __future__ import annotations

from typing import Any, Protocol


class Graph(Protocol):
    """What the page needs of a running graph. All calls are made from one asyncio loop's thread."""

    def steer(self, velocity: tuple[float, float]) -> None:
        """Publish the operator's wish now, stamped now.

        Args:
            velocity: of the needle's tip in the dish plane [m/s].
        """

    async def act(self, action: str) -> str:
        """Do one of arm, disarm, stop and reset; return an empty text, or the refusal."""

    def state(self) -> dict[str, Any]:
        """Return what is known now, as a new dictionary; cheap enough for 30 calls a second."""

    def frame(self) -> tuple[int, bytes] | None:
        """Return number and JPEG or PNG bytes of the newest camera frame; the number rises."""


class Host(Protocol):
    """Who runs the graph: what can be chosen, paused and recorded. None of it may be possible."""

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""

    async def choose(self, scenario: str) -> str:
        """Run another scenario; return an empty text, or the refusal."""

    async def pause(self, still: bool) -> str:
        """Let time stand still, or go on; return an empty text, or the refusal."""

    async def record(self, on: bool) -> str:
        """Begin or end a recording; return an empty text, or the refusal."""
