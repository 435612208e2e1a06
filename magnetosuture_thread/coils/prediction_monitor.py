"""Prediction monitor: validity of the thread model's margins, its slowdown, and its scene."""

from __future__ import annotations

import math

from magnetosuture_thread.errors import InvalidInputError

SCENE_GRACE_PERIOD = 0.5  # s for which model and bridge may be on different versions of the scene during a change


class PredictionMonitor:
    """Keeps the last valid margins of the thread model. Pure: times come in, in seconds.

    Args:
        timeout: margins are valid for this long after their stamp and their arrival [s].
    """

    def __init__(self, timeout: float) -> None:
        self._timeout = timeout
        self._stamp = self._arrival = -math.inf  # of the last valid margins
        self._last_arrival = -math.inf  # of the last margins, valid or not
        self._slowdown = 1.0
        self._version: str | None = None
        self._agreed = math.inf  # when model and bridge last had one version; initially when both were known

    def update(self, stamp: float, valid: bool, slowdown: float, scene_version: str, arrival: float) -> None:
        """Register the model's margins; invalid ones leave the last valid ones until these are stale.

        Raises:
            InvalidInputError: slowdown or stamp is out of range.
        """
        if valid and not (0.0 <= slowdown <= 1.0):
            raise InvalidInputError("thread/margins.slowdown", slowdown, "a factor from 0 to 1")
        if not math.isfinite(stamp):
            raise InvalidInputError("thread/margins.header.stamp", stamp, "a time [s]")
        self._last_arrival, self._version = arrival, scene_version
        if valid:
            self._stamp, self._arrival, self._slowdown = stamp, arrival, slowdown

    def stale_reason(self, now: float, arrival: float) -> str:
        """Return why there is no prediction at a time of the stamps' clock and a monotonic time; empty if there is."""
        if self._arrival == -math.inf:
            return "no thread prediction yet" if self._last_arrival == -math.inf else "no valid thread prediction yet"
        age = max(arrival - self._arrival, now - self._stamp)
        return "" if age <= self._timeout else f"no thread prediction for {self._timeout:g} s"

    @property
    def slowdown(self) -> float:
        """The last valid factor on the needle's speed."""
        return self._slowdown

    def scene_mismatch(self, scene_version: str, arrival: float) -> str:
        """Return a text if the model has had another scene for too long; empty if not, or if the model is silent.

        Args:
            scene_version: the bridge's.
            arrival: a monotonic time [s].
        """
        if self._version is None or arrival - self._last_arrival > max(self._timeout, SCENE_GRACE_PERIOD):
            return ""
        if self._version == scene_version or self._agreed == math.inf:
            self._agreed = arrival
        if arrival - self._agreed <= SCENE_GRACE_PERIOD:
            return ""
        return f"scene: thread_model has {self._version or 'none'}, coil_bridge has {scene_version or 'none'}"
