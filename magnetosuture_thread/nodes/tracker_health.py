"""What the node `vision_tracker` says of itself on /diagnostics."""

from __future__ import annotations

from typing import Any

from magnetosuture_thread.nodes.diagnostics import Health
from magnetosuture_thread.vision.session import FrameMeasurement, TrackerSession

NO_SCENE = "no scene yet: neither the parameter nor the topic says how large the dish is"


class TrackerHealth:
    """Puts what is seen of needle and thread into words.

    Args:
        health: of the node.

    Attributes:
        lens_problem: why frames are not corrected for the lens; stays in the state until valid parameters come.
    """

    def __init__(self, health: Health) -> None:
        self._health = health
        self._words = ""
        self.lens_problem = ""

    def begin(self, session: TrackerSession | None) -> None:
        """Report that no frame has come yet; without a scene there is no session."""
        self._words = "nothing seen"
        self._health.warn("no camera frame yet" if session is not None else NO_SCENE)

    def show(self, measured: FrameMeasurement, session: TrackerSession) -> None:
        """Report what was seen in a frame."""
        track = measured.track
        values: dict[str, Any] = {"frames": session.frames, "tracked": session.tracked}
        if track.needle_length is not None:
            values["needle_length_mm"] = round(1e3 * track.needle_length, 3)
        if measured.problem is not None:
            self._health.refuse(measured.problem, **values)
        elif measured.tracked:
            values["confidence"] = round(track.confidence, 3)
            self._words = f"tracking; {track.warning}" if track.warning else "tracking"
            if self.lens_problem:
                self._health.warn(f"{self._words}; {self.lens_problem}", **values)
            else:
                (self._health.warn if track.warning else self._health.ok)(self._words, **values)
        else:
            self._words = f"{track.state.value}: {track.reason}"
            self._health.warn(self._words, **values)

    def show_silence(self, reason: str) -> None:
        """Report why no frame comes, and what was seen before."""
        self._health.warn("; ".join(filter(None, (reason, f"before that {self._words}", self.lens_problem))))
