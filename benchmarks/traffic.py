"""A node that stands in for a commander, a tracker or a fuzzer of the coil bridge."""

from __future__ import annotations

import math
import random
import sys
import time
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.clock import Clock, ClockType

from benchmarks.attack.hostile import spoil
from magnetosuture_thread.bags.packing import packed_pose, packed_twist
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import GuardedNode
from magnetosuture_thread.nodes.program import run

RATES = {"commander": 50.0, "tracker": 60.0, "fuzzer": 1000.0}  # Hz
SPEED = 0.001  # m/s
TAIL, HEADING = np.array([-0.0035, 0.0]), np.array([1.0, 0.0])
REVERSAL = 1.0  # s; of a command, so that a needle which follows it stays where it is


class TrafficNode(GuardedNode):
    """Publishes velocity commands, poses, or anything at all.

    Parameters: `kind`, commander, tracker or fuzzer; `burst` and `pause` [s], of a commander that falls silent again
    and again, and prints the monotonic time of the last command before each silence; `count`, of a fuzzer.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("traffic", **options)
        self._kind = str(self.declare_parameter("kind", "commander").value)
        self._burst = float(self.declare_parameter("burst", 1e9).value)
        self._pause = float(self.declare_parameter("pause", 0.0).value)
        self._count = int(self.declare_parameter("count", 10_000).value)
        if self._kind != "tracker":
            self._commands = topics.NEEDLE_COMMAND.publisher(self)
        if self._kind != "commander":
            self._poses = topics.NEEDLE_POSE.publisher(self)
        self._random = random.Random(7)
        self._began = time.monotonic()
        self._last: float | None = None
        self._place, self._velocity, self._heard = TAIL, np.zeros(2), 0.0  # of a needle that does as it is told
        if self._kind == "tracker":
            topics.NEEDLE_COMMAND.subscribe(self, self._hear)
        act = {"commander": self._command, "tracker": self._track, "fuzzer": self._fuzz}
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(1.0 / RATES[self._kind], act[self._kind], clock=steady)

    def _command(self) -> None:
        now = time.monotonic()
        if now - self._began > self._burst:
            if self._last is not None:
                print(f"{self._last:.6f}", flush=True)
                self._last = None
            if now - self._began < self._burst + self._pause * (0.8 + 0.4 * self._random.random()):
                return
            self._began = now
        velocity = math.copysign(SPEED, math.sin(math.pi * now / REVERSAL)) * HEADING
        self._last = time.monotonic()
        self._commands.publish(packed_twist(self._stamp(), velocity))

    def _hear(self, message: Any) -> None:
        self._velocity, self._heard = np.array([message.twist.linear.x, message.twist.linear.y]), time.monotonic()

    def _track(self) -> None:
        if time.monotonic() - self._heard < 0.1:  # as long as the bridge drives
            self._place = self._place + self._velocity / RATES["tracker"]
        self._poses.publish(packed_pose(self._stamp(), self._place, HEADING))

    def _fuzz(self) -> None:
        """Publish a command or a pose with something wrong in it, or nothing."""
        if not self._count:
            raise SystemExit
        self._count -= 1
        # Most that is not odd is a needle that stays where it is: of others none would be believed, nothing driven.
        message: Any = topics.NEEDLE_POSE.decode(packed_pose(self._stamp(), TAIL, HEADING))
        publisher = self._poses
        if self._random.random() < 0.5:
            velocity = np.array([self._random.uniform(-0.02, 0.02) for _ in range(2)])
            message, publisher = topics.NEEDLE_COMMAND.decode(packed_twist(self._stamp(), velocity)), self._commands
        if self._random.random() < 0.7:
            spoil(message, self._random.choice((0.02, 0.1, 0.5)), self._random)
        publisher.publish(message)

    def _stamp(self) -> Time:
        return self.get_clock().now().to_msg()


def main(arguments: list[str] | None = None) -> int:
    """Run the node as a program."""
    return run(TrafficNode, arguments)


if __name__ == "__main__":
    sys.exit(main())
