"""The simulated rig with a thread at its needle: a path followed in the closed loop, and its bag."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.calibration.square import TipPath
from magnetosuture_thread.evaluation.recorded import SETUP_NOTE
from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.rig.closed_loop import ClosedLoop, RunBag
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings.files import whole_folder


class _PoseBag(RunBag):
    """Records a run without its frames: what they show is tracked already."""

    def on_frame(self, now: float, frame: RigFrame) -> None:
        """Write the ground truth."""
        super().on_frame(now, replace(frame, image=None))


class SimulatedThreadBench:
    """See `ThreadBench`. Time is simulated; each path begins anew where the setup has the needle.

    Args:
        truth: a setup with the true rig.
        drawn: whether poses and threads are the truth with noise, in place of rendered frames that are tracked.
        seed: of that noise.
    """

    def __init__(self, truth: Setup, *, drawn: bool = False, seed: int = 0) -> None:
        self._rig, self._drawn, self._seed = replace(truth.rig, obstacle_looks=()), drawn, seed

    def follow(self, path: TipPath, setup: Setup, bag: Path) -> tuple[float, str]:
        """Steer the tip along a path with a setup, and record it; see `ThreadBench`."""

        def steer(stamp: float, tail: Vector, heading: Vector, thread: ThreadCondition) -> Vector:
            return path.command(stamp, np.array([*tail, math.atan2(heading[1], heading[0])]), thread.age)

        self._seed += 1
        poses = "drawn with a tracker's noise" if self._drawn else "tracked in rendered frames"
        notes = {"setup": setup.name, SETUP_NOTE: setup.path.read_text(encoding="utf-8")}
        notes["simulated"] = f"a rig with a thread, closed loop in one process, poses {poses}"
        with whole_folder(bag) as folder, BagWriter(folder, notes, name=bag.name) as writer:
            rig, recorder = Rig(self._rig, setup.scene), _PoseBag(writer, setup, camera=False)
            loop = ClosedLoop(setup, rig, steer, self._seed, camera=not self._drawn, recorder=recorder)
            while not (path.done or loop.bridge.latch.fault) and rig.time < path.time_limit:
                loop.step()
        return path.result(loop.bridge.latch.fault)
