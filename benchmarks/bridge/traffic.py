"""A node that stands in for a commander or a tracker of the coil bridge."""

from __future__ import annotations

import math
import random
import sys
import time
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from magnetosuture_thread.messages.packing import packed_pose, packed_twist
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.run import run

RATES = {"commander": 50.0, "tracker": 60.0}  # Hz
SPEED = 0.001  # m/s; too slow for the bridge to judge whether a needle follows whose pose is always the same
TAIL, HEADING = np.array([-0.0035, 0.0]), np.array([1.0, 0.0])


class TrafficNode(Node):
    """Publishes velocity commands or poses.

    Parameters: `kind`, commander or tracker; `burst` and `pause` [s], of a commander that falls silent again
    and again, and prints the monotonic time of the last command before each silence.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("traffic", **options)
        self._kind = str(self.declare_parameter("kind", "commander").value)
        self._burst = float(self.declare_parameter("burst", 1e9).value)
        self._pause = float(self.declare_parameter("pause", 0.0).value)
        topic = topics.NEEDLE_POSE if self._kind == "tracker" else topics.NEEDLE_COMMAND
        self._publisher = topic.publisher(self)
        self._random = random.Random(7)
        self._began = time.monotonic()
        self._last: float | None = None
        self._direction = 0.0
        act = self._track if self._kind == "tracker" else self._command
        self.create_timer(1.0 / RATES[self._kind], act, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _command(self) -> None:
        now = time.monotonic()
        if now - self._began > self._burst:
            if self._last is not None:
                print(f"{self._last:.6f}", flush=True)
                self._last = None
            if now - self._began < self._burst + self._pause * (0.8 + 0.4 * self._random.random()):
                return
            self._began, self._direction = now, self._direction + 1.0
        velocity = SPEED * np.array([math.cos(self._direction), math.sin(self._direction)])
        self._last = time.monotonic()
        self._publisher.publish(packed_twist(self._stamp(), velocity))

    def _track(self) -> None:
        self._publisher.publish(packed_pose(self._stamp(), TAIL, HEADING))

    def _stamp(self) -> Time:
        return self.get_clock().now().to_msg()


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(TrafficNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
