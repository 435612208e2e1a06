"""The simulated rig as a bench: currents for a while, and a bare needle that the real tracker follows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from magnetosuture_thread.calibration.commission import AFTER, BEFORE, PATIENCE, middle_of
from magnetosuture_thread.calibration.needle_length import find_needle_length
from magnetosuture_thread.calibration.pulse_model import Pulse
from magnetosuture_thread.calibration.square import Square
from magnetosuture_thread.coils.bridge import OPERATOR, CoilBridge
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.coils.pulses import MotionGuard, guard_reach
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.rig.closed_loop import LATENCY, POSE_NOISE, START
from magnetosuture_thread.rig.rig import Rig, RigFrame
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.rig.truth import bare_rig
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError
from magnetosuture_thread.vision.tracker import State, TrackerSession


class SimulatedBench:
    """See `Bench`. Time is simulated, and frames are rendered and tracked.

    Args:
        setup: what is believed, with the true rig.
        drawn: whether poses are the truth with noise, in place of rendered frames.
        seed: of the needle's first heading, and of that noise.

    Attributes:
        needle_length: as the camera measures it [m].
        now: simulated time [s].

    Raises:
        ConfigurationError: the needle is bent.
        InvalidInputError: the tracker finds no needle.
    """

    def __init__(self, setup: Setup, *, drawn: bool = False, seed: int = 0) -> None:
        truth, scene = setup.rig, Scene(setup.scene.dish)
        if truth.needle_curvature:
            raise ConfigurationError(f"{truth.GROUP}.needle_curvature", truth.needle_curvature, "0: a straight needle")
        self._random = np.random.default_rng([seed, 3])
        self._rig = Rig(bare_rig(truth, self._random), scene)
        self._count, self._coils = len(truth.coil_angles), setup.coils
        self._interval, self._radius = 1.0 / truth.frame_rate, scene.dish.radius
        self.now = self._next_frame = START
        self._poses: list[tuple[float, Vector]] = []  # stamp and pose of frames
        self._reason = "no frames"
        self._rig.apply(np.full(self._count, 1e-12), 0.0)  # it holds the needle until a current comes
        self._tracker = None
        if drawn:
            self.needle_length = truth.needle_length * (1.0 + 0.003 * float(self._random.standard_normal()))
            return
        images = [frame.image for frame in self._frames(24) if frame.image is not None]
        self.needle_length = find_needle_length(images, setup.vision, scene)
        self._tracker = TrackerSession(replace(setup.vision, needle_length=self.needle_length), scene)

    def pulse(self, currents: Vector, seconds: float) -> Pulse:
        """Give currents for a time, then zeros; see `Bench`."""
        self._await_pose(self.now - BEFORE)
        on, guard = self.now, MotionGuard(guard_reach(self._radius, self.needle_length, self._coils.keep_out))
        guard.update(self._poses[-1][0], middle_of(self._poses[-1][1], self.needle_length))
        guard.begin()
        try:
            ended = self._drive(currents, seconds, guard if np.any(currents) else None)
        finally:
            self._rig.apply(np.zeros(self._count), self.now - START)
        off = self.now
        self._drive(np.zeros(self._count), AFTER)
        self._await_pose(off)
        frames = [(stamp, pose) for stamp, pose in self._poses if stamp > on - BEFORE]
        self._poses = self._poses[-30:]
        times, poses = zip(*frames, strict=True)
        return Pulse(currents.copy(), on, off, np.array(times), np.array(poses), ended)

    def follow_square(self, coils: CoilBridgeSettings) -> tuple[float, str]:
        """Steer the needle's tip slowly around a square by the coil bridge, without a thread; see `Bench`."""
        square, latch, driver, count = Square(coils, self._radius), ArmingLatch(), DriverState(True), 0
        bridge = CoilBridge(square.settings, latch, self._rig.scene)
        latch.activate()
        bridge.arm(driver)
        end, last = self.now + square.time_limit, self.now
        try:
            while self.now < end and not square.done and not latch.fault:
                self._look_if_due()
                for stamp, pose in [entry for entry in self._poses[-8:] if last < entry[0] <= self.now - LATENCY]:
                    count, last = count + 1, stamp
                    heading = np.array([math.cos(pose[2]), math.sin(pose[2])])
                    now = self.now, self.now
                    with suppress(InvalidInputError):  # of one that jumps, which the latch then names
                        bridge.on_pose(pose[:2], heading, stamp, count, *now, np.diag(POSE_NOISE**2))
                    velocity = square.command(stamp, pose, self.now - stamp)
                    bridge.command(OPERATOR, velocity, self.now, count, *now)
                output = bridge.step(self.now, self.now, driver)
                self._rig.apply(output.allocation.currents, self.now - START)
                self.now += 1.0 / self._coils.rate
        finally:
            self._rig.apply(np.zeros(self._count), self.now - START)
        return square.result(latch.fault)

    def _await_pose(self, since: float) -> None:
        """Wait for a pose of after a time [s]."""
        end = self.now + PATIENCE
        while not (self._poses and self._poses[-1][0] > since):
            if self.now > end:
                raise InvalidInputError("needle", f"no pose for {PATIENCE:g} s: {self._reason}", "one in every frame")
            self._drive(np.zeros(self._count), BEFORE)

    def _drive(self, currents: Vector, seconds: float, guard: MotionGuard | None = None) -> str:
        """Give currents until a time is over or the needle must not go on; return why it must not."""
        end, heard = self.now + seconds, -math.inf
        while self.now < end - 1e-9:
            self._look_if_due()
            known = [entry for entry in self._poses[-8:] if entry[0] + LATENCY <= self.now]
            if guard is not None:
                for stamp, pose in [entry for entry in known if entry[0] > heard]:
                    guard.update(stamp, middle_of(pose, self.needle_length))
                    heard = stamp
                if not known or self.now - known[-1][0] > self._coils.pose_timeout:
                    return f"no pose: {self._reason}"
                if reason := guard.problem():
                    return reason
            self._rig.apply(currents, self.now - START)
            self.now += 1.0 / self._coils.rate
        return ""

    def _frames(self, count: int) -> Sequence[RigFrame]:
        """Return frames of a needle that nothing moves yet."""
        frames = []
        for _ in range(count):
            frames.append(self._rig.look(self.now - START))
            self.now = self._next_frame = self.now + self._interval
        return frames

    def _look_if_due(self) -> None:
        """Take a frame if it is time, and keep the pose in it."""
        if self.now < self._next_frame - 1e-9:
            return
        self._next_frame += self._interval
        frame = self._rig.look(self.now - START, rendered=self._tracker is not None)
        stamp = self.now + frame.stamp_delay
        if frame.lost:
            self._reason = "no frames come"
            return
        if self._tracker is None or frame.image is None:
            pose = np.array([*frame.tail, frame.heading]) + POSE_NOISE * self._random.standard_normal(3)
        else:
            track = self._tracker.on_image(stamp, frame.image).track
            if track.state is not State.TRACKED:
                self._reason = track.reason
                return
            pose = np.array([*track.tail, math.atan2(track.heading[1], track.heading[0])])
        if self._poses:
            last = self._poses[-1][1][2]
            pose[2] = last + math.remainder(pose[2] - last, math.tau)
        self._poses.append((stamp, pose))
