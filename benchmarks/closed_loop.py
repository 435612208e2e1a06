"""What is kept of a closed loop without a graph, and a path follower that steers it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.coils.bridge import BridgeOutput
from magnetosuture_thread.estimator.thread_session import PredictionResult
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.rig.closed_loop import Measurement
from magnetosuture_thread.rig.rig import RigFrame
from magnetosuture_thread.rig.setups import Setup

Vector = NDArray[np.float64]


class PathControl:
    """Commands the velocities of a setup's path follower.

    Attributes:
        done: whether the needle is at the end of its path.
    """

    def __init__(self, setup: Setup) -> None:
        self._follower, self.done = setup.follower.follower(), False

    def __call__(self, stamp: float, tail: Points, heading: Points, condition: ThreadCondition) -> Vector:
        """Return the velocity for a measured pose, shape (2,) [m/s]."""
        command = self._follower.compute_command(stamp, tail, heading, condition.age)
        self.done = command.progress >= 1.0
        return np.asarray(command.velocity)


@dataclass
class LoopRecord:
    """What a loop did, as a `LoopRecorder`.

    Attributes:
        new_plan: returns the needle's plan if there is a new one.
        frames: time [s] and truth of each frame.
        measured: each measurement, what the thread model made of it, and the new plan.
        commands: time [s], commanded and filtered velocity, shapes (2,) [m/s], and input of each step of the bridge.
    """

    new_plan: Callable[[], Points | None] = lambda: None
    frames: list[tuple[float, RigFrame]] = field(default_factory=list)
    measured: list[tuple[Measurement, PredictionResult, Points | None]] = field(default_factory=list)
    commands: list[tuple[float, Vector, Vector, str]] = field(default_factory=list)

    def on_frame(self, now: float, frame: RigFrame) -> None:
        """Keep the ground truth."""
        self.frames.append((now, replace(frame, tail=frame.tail.copy(), thread=frame.thread.copy())))

    def on_measurement(self, now: float, measured: Measurement, result: PredictionResult, commanded: Vector) -> None:
        """Keep a measurement and its result."""
        self.measured.append((measured, result, self.new_plan()))

    def on_bridge(self, now: float, output: BridgeOutput) -> None:
        """Keep the command."""
        self.commands.append((now, output.commanded, output.filtered, output.source))
