"""The simulated rig's time, which can stand still."""

from __future__ import annotations

import time
from typing import Any

from rclpy.node import Node
from std_srvs.srv import SetBool

from magnetosuture_thread.interface import PAUSE_RIG
from magnetosuture_thread.nodes.replay_time import Timeline


class RigTime:
    """Counts the rig's own time, and stamps what happens in it; the node's service `rig/pause` lets it stand still.

    By a simulated clock the stamps stand still with the rig. By the time of the day they go on: what the rig shows
    after a pause is stamped as late as it is shown.

    Args:
        node: that gets the service.
        epoch: the stamp of its beginning, which is now [ns].
        rate: how much faster than real time it runs.
        simulated: whether the stamps are those of a simulated clock.
    """

    def __init__(self, node: Node, epoch: int, rate: float, *, simulated: bool) -> None:
        self._epoch, self._rate, self._simulated = epoch, rate, simulated
        self._timeline = Timeline(epoch, rate)
        self._timeline.begin()
        self._began = time.perf_counter()
        self._stood = 0.0  # s of real time, in all pauses that are over
        node.create_service(SetBool, PAUSE_RIG, self._on_pause)

    @property
    def paused(self) -> bool:
        """Whether it stands still."""
        return self._timeline.paused

    def elapsed(self) -> float:
        """Return the rig's own time since its beginning [s]."""
        return self._timeline.running() * self._rate

    def stamp(self, elapsed: float) -> int:
        """Return the stamp of a moment in the rig's own time, given in seconds [ns]."""
        return self._epoch + round((elapsed + (0.0 if self._simulated else self._stood)) * 1e9)

    def pause(self, still: bool) -> None:
        """Let it stand still, or go on from where it stood."""
        self._timeline.pause(still)
        if not still:
            self._stood = time.perf_counter() - self._began - self._timeline.running()

    def _on_pause(self, asked: Any, answer: Any) -> Any:
        self.pause(asked.data)
        answer.success = True
        answer.message = f"{'paused' if asked.data else 'goes on'} at {self.elapsed():.2f} s"
        return answer
