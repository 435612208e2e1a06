"""What the thread model has said last, and for how long that is good: friction, and the scene that it knows."""

from __future__ import annotations

import math

from magnetosuture_thread.errors import InvalidInputError

SCENE_GRACE = 0.5  # s for which model and bridge may be on different versions of the scene, as a change takes time


class PredictionWatch:
    """Keeps the last valid margins of the thread model. Pure: times come in, in seconds.

    Args:
        timeout: margins are good for this long after their stamp and their arrival [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._stamp = self._arrival = -math.inf  # of the last valid margins
        self._heard = -math.inf  # arrival of the last margins, valid or not
        self._slowdown = 1.0
        self._version: str | None = None
        self._agreed = math.inf  # when model and bridge were last on one version, and at first when both were heard

    def hear(self, stamp: float, valid: bool, slowdown: float, scene_version: str, arrival: float) -> None:
        """Take the model's margins; invalid ones leave the last valid ones until these are too old.

        Raises:
            InvalidInputError: the slowdown or the stamp cannot be.
        """
        if valid and not (0.0 <= slowdown <= 1.0):
            raise InvalidInputError("thread/margins.slowdown", slowdown, "a factor from 0 to 1")
        if not math.isfinite(stamp):
            raise InvalidInputError("thread/margins.header.stamp", stamp, "a time [s]")
        self._heard, self._version = arrival, scene_version
        if valid:
            self._stamp, self._arrival, self._slowdown = stamp, arrival, slowdown

    def missing(self, now: float, arrival: float) -> str:
        """Say why there is no prediction at a time of the stamps' clock and a monotonic time; empty if there is."""
        if self._arrival == -math.inf:
            return "no thread prediction yet" if self._heard == -math.inf else "no valid thread prediction yet"
        good = max(arrival - self._arrival, now - self._stamp) <= self._timeout
        return "" if good else f"no thread prediction for {self._timeout:g} s"

    @property
    def slowdown(self) -> float:
        """The last valid factor on the needle's speed."""
        return self._slowdown

    def disagreement(self, scene_version: str, arrival: float) -> str:
        """Say that the model has been on another scene for too long; empty if not, or if it is silent.

        Args:
            scene_version: the bridge's.
            arrival: a monotonic time [s].
        """
        if self._version is None or arrival - self._heard > max(self._timeout, SCENE_GRACE):
            return ""
        if self._version == scene_version or self._agreed == math.inf:
            self._agreed = arrival
        if arrival - self._agreed <= SCENE_GRACE:
            return ""
        return f"scene: thread_model has {self._version or 'none'}, coil_bridge has {scene_version or 'none'}"
