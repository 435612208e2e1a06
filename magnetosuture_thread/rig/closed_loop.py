"""The closed loop without a graph: rig, tracker or its noise, estimator, procedure, and bridge on simulated time."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from magnetosuture_thread.bags import packing
from magnetosuture_thread.bags.packing import packed_scene
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.coils.bridge import NEEDLE, BridgeOutput, CoilBridge
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.estimator.thread_session import PredictionResult, ThreadSession
from magnetosuture_thread.geometry.polyline import Points, Vector, arc_lengths, points_at
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.planning.executor import ThreadCondition
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.rig.rig import Rig, RigFrame, ground_truth_outputs
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.thread.prediction import NeedlePose
from magnetosuture_thread.vision.tracker import TrackerSession

START = 1.0  # s; simulated time of the first frame, as 0 is no time in ROS
LATENCY = 0.02  # s; from a frame to the command that follows from it, as measured in the graph
POSE_NOISE = np.array([1e-5, 1e-5, 5e-3])  # m, m and rad; of a tracked needle, see docs/results.md

RECORDED = (  # what the bag of a run holds, besides frames
    *(interface.SCENE, interface.GROUND_TRUTH_NEEDLE, interface.GROUND_TRUTH_THREAD, interface.GROUND_TRUTH_PULL),
    *(interface.NEEDLE_POSE, interface.THREAD_OBSERVATION, interface.MEASURED_THREAD),
    *(interface.PREDICTED_THREAD, interface.ESTIMATED_THREAD, interface.MARGINS),
    *(interface.NEEDLE_COMMAND, interface.CURRENTS, interface.FILTER_STATE),
)

Controller = Callable[[float, Vector, Vector, ThreadCondition], Vector]
"""From stamp [s], tail [m], heading and the thread's condition to the command, see `CoilBridge.command`."""


@dataclass(frozen=True)
class LoopFrame:
    """The instant of a frame, as it is and as the nodes have it.

    Attributes:
        time: since the loop began [s].
        tail: of the needle in truth, shape (2,) [m].
        heading: of the needle in truth [rad].
        thread: in truth, shape (n + 1, 2) [m].
        tension: peak of the thread in truth [N].
        condition: what the model knows of the thread.
        commanded: by the controller, see `CoilBridge.command`.
        reason: why the coils are at zero; empty if they are not.
    """

    time: float
    tail: Vector
    heading: float
    thread: Points
    tension: float
    condition: ThreadCondition
    commanded: Vector
    reason: str


@dataclass
class Measurement:
    """Needle and thread as measured in a frame.

    Attributes:
        due: when it reaches the nodes [s].
        stamp: of the frame [s].
        tail: of the needle, shape (2,) [m].
        heading: unit vector, shape (2,).
        covariance: of x, y [m] and the angle of the heading [rad], shape (3, 3).
        observation: of the thread; None where none was made.
    """

    due: float
    stamp: float
    tail: Vector
    heading: Vector
    covariance: Vector
    observation: ThreadObservation | None


class LoopRecorder(Protocol):
    """Gets what the nodes and the rig would publish. Times are those of the loop's stamps [s]."""

    def on_frame(self, now: float, frame: RigFrame) -> None:
        """Take a frame with its ground truth."""

    def on_measurement(self, now: float, measured: Measurement, result: PredictionResult, commanded: Vector) -> None:
        """Take a measurement, what the thread model makes of it, and the command, see `CoilBridge.command`."""

    def on_bridge(self, now: float, output: BridgeOutput) -> None:
        """Take a step of the coil bridge."""


class ClosedLoop:
    """Runs rig, measurement, thread model and coil bridge, as the graph does, in one process and without clocks.

    Args:
        setup: what the nodes believe.
        rig: the simulated rig, which may differ from that.
        controller: commands the needle from each pose.
        seed: of noise and lost frames.
        camera: whether frames are rendered and tracked; else the tracker's noise is added to the truth.
        losses: share of the frames that get lost, 0 to 1.
        latency: from a frame to the command that follows from it [s].
        recorder: gets what the nodes would publish; None for nobody.
    """

    def __init__(
        self,
        setup: Setup,
        rig: Rig,
        controller: Controller,
        seed: int = 0,
        *,
        camera: bool = False,
        losses: float = 0.0,
        latency: float = LATENCY,
        recorder: LoopRecorder | None = None,
    ) -> None:
        self.setup, self.rig, self._controller, self._recorder = setup, rig, controller, recorder
        self._random, self._losses = np.random.default_rng([seed, 1]), losses
        self._latency = latency
        latch, self._driver = ArmingLatch(), DriverState(True)
        self.bridge = CoilBridge(setup.coils, latch, setup.scene)
        latch.activate()
        self.bridge.arm(self._driver)
        self.session = ThreadSession(setup.model, setup.scene)
        self._tracker = TrackerSession(setup.vision, setup.scene) if camera else None
        self.now = self._next_frame = START
        self._waiting: list[Measurement] = []
        self._count, self._reason, self._pull = 0, "", np.zeros(2)
        self._condition, self._commanded = ThreadCondition(problem="no thread yet"), np.zeros(3)

    def step(self) -> LoopFrame | None:
        """Go on by a period of the bridge; return the frame if one was taken.

        Raises:
            SolverError: the rig's mechanics find no next state.
        """
        frame = None
        if self.now >= self._next_frame - 1e-9:
            self._next_frame += 1.0 / self.setup.rig.frame_rate
            frame = self._look()
        else:
            self.rig.advance(self.now - START)
        while self._waiting and self._waiting[0].due <= self.now + 1e-9:
            self._take(self._waiting.pop(0))
        output = self.bridge.step(self.now, self.now, self._driver)
        self._reason, self._pull = output.reason, output.pull
        if self._recorder is not None:
            self._recorder.on_bridge(self.now, output)
        self.rig.apply(output.allocation.currents, self.now - START)
        self.now += 1.0 / self.setup.coils.rate
        return frame

    def _look(self) -> LoopFrame:
        frame = self.rig.look(self.now - START, rendered=self._tracker is not None)
        if self._recorder is not None:
            self._recorder.on_frame(self.now, frame)
        lost = self._random.uniform() < self._losses
        if not lost and (measured := self._measure(frame)) is not None:
            self._waiting = sorted([*self._waiting, measured], key=lambda waiting: waiting.due)
        truth = frame.tail.copy(), frame.heading, frame.thread.copy(), float(self.rig.dynamics.tension.max(initial=0.0))
        return LoopFrame(self.now - START, *truth, self._condition, self._commanded, self._reason)

    def _measure(self, frame: RigFrame) -> Measurement | None:
        stamp = self.now + frame.stamp_delay
        due = stamp + self._latency
        if self._tracker is None:
            tail = frame.tail + POSE_NOISE[:2] * self._random.standard_normal(2)
            angle = frame.heading + POSE_NOISE[2] * self._random.standard_normal()
            heading, covariance = np.array([math.cos(angle), math.sin(angle)]), np.diag(POSE_NOISE**2)
            return Measurement(due, stamp, tail, heading, covariance, self._observe(frame.thread))
        if frame.image is None:
            return None
        track = self._tracker.on_image(stamp, frame.image).track
        if not len(track.tail) or len(track.heading) == 0:
            return None
        return Measurement(due, stamp, track.tail, track.heading, track.covariance, track.observation)

    def _observe(self, thread: Points) -> ThreadObservation:
        """Return the thread with the noise of a tracked centreline, which is alike over a length."""
        deviation, alike, length = 1e-5, 5e-4, float(arc_lengths(thread)[-1])  # m
        at, knots = np.linspace(0.0, length, 64), np.arange(0.0, length + alike, alike)
        noise = np.column_stack([np.interp(at, knots, self._random.standard_normal(len(knots))) for _ in range(2)])
        points, deviations = points_at(thread, at) + deviation * noise, np.full(len(at), deviation)
        piece = ThreadPiece(points, deviations, PieceEnd.TAIL, PieceEnd.FREE, (0.0, 0.0))
        return ThreadObservation((piece,), complete=True)

    def _take(self, measured: Measurement) -> None:
        """Hand a measurement to bridge, thread model and controller, in the order of the graph."""
        self._count += 1
        stamp, now = measured.stamp, self.now
        with suppress(InvalidInputError):  # the bridge's node reports it, and the others take the pose all the same
            self.bridge.on_pose(measured.tail, measured.heading, stamp, self._count, now, now, measured.covariance)
        nanoseconds = round(1e9 * stamp)
        if measured.observation is not None:
            list(self.session.on_observation(nanoseconds, measured.observation))
        deviation = tuple(np.sqrt(np.maximum(0.0, np.diag(measured.covariance)[[0, 2]])).tolist())
        pose = NeedlePose(1e-9 * nanoseconds, measured.tail, measured.heading, deviation)
        result = self.session.on_pose(nanoseconds, pose)
        self.session.late_estimates()
        margins = result.margins
        slowdown = margins.friction.slowdown if margins else 1.0
        self.bridge.on_margins(stamp, margins is not None, slowdown, result.scene_version, now)
        condition = replace(condition_of(result), pull=self._pull, age=now - stamp)
        slows = self.setup.coils.friction_feedback == "all"
        self._condition = condition if slows else replace(condition, slowdown=1.0)
        self._commanded = self._controller(stamp, measured.tail, measured.heading, self._condition)
        self.bridge.command(NEEDLE, self._commanded, now, self._count, now, now)
        if self._recorder is not None:
            self._recorder.on_measurement(now, measured, result, self._commanded)


def condition_of(result: PredictionResult) -> ThreadCondition:
    """Return what a prediction and an estimate say of the thread's condition."""
    thread = result.estimate or result.prediction
    if thread is None:
        return ThreadCondition(problem=result.reason)
    margins, estimate, forces = result.margins, result.estimate, result.prediction and result.prediction.forces
    problem = result.reason if margins is None else ""
    if estimate is not None and estimate.unmeasured_for > 1.0:  # s, after which it is unsure
        problem = f"the thread has not been measured for {estimate.unmeasured_for:.1f} s"
    nodes, slowdown = (len(margins.friction.nodes), margins.friction.slowdown) if margins is not None else (0, 1.0)
    return ThreadCondition(thread.positions, forces.peak_tension if forces else 0.0, nodes, slowdown, problem)


class RunBag:
    """Records a run, as a `LoopRecorder`. Every message is logged at the simulated time at which a node would get it.

    Args:
        bag: to write to.
        setup: what the nodes believe.
        camera: whether frames are rendered.
    """

    def __init__(self, bag: BagWriter, setup: Setup, *, camera: bool) -> None:
        self._bag, self._rig, self._material = bag, setup.rig, setup.model.material
        for channel in (*RECORDED, *((interface.COMPRESSED_IMAGE, interface.CAMERA_INFO) if camera else ())):
            bag.add_topic(channel.recorded, channel.type_name)
        begin = round(1e9 * START)
        bag.write(interface.SCENE.recorded, begin, packed_scene(begin, setup.scene))
        self._view = setup.rig.view(setup.scene)
        self._command = 0  # stamp of the last [ns]

    def on_frame(self, now: float, frame: RigFrame) -> None:
        """Write a frame, if it was rendered, and the ground truth."""
        stamp, rig = round(1e9 * now), self._rig
        if frame.image is not None:
            jpeg, size = encode_jpeg(frame.image, rig.jpeg_quality), (rig.camera_width, rig.camera_height)
            seen = stamp + round(1e9 * frame.stamp_delay)
            self._write(seen, packing.camera_outputs(seen, jpeg, size, self._view, rig.camera_distance))
        self._write(stamp, ground_truth_outputs(stamp, frame))

    def on_measurement(self, now: float, measured: Measurement, result: PredictionResult, commanded: Vector) -> None:
        """Write what was measured, predicted and estimated in a frame, and the command that came of it."""
        time, stamp, observation = round(1e9 * now), result.stamp, measured.observation
        self._write(time, packing.pose_outputs(stamp, measured.tail, measured.heading, measured.covariance))
        if observation is not None:
            self._write(time, packing.thread_outputs(stamp, observation, observation.from_tail))
        self._write(time, packing.prediction_outputs(result, self._material))
        self._write(time, packing.estimate_outputs(result))
        self._bag.write(interface.NEEDLE_COMMAND.recorded, time, packing.packed_twist(time, commanded))
        self._command = time

    def on_bridge(self, now: float, output: BridgeOutput) -> None:
        """Write currents and what became of the command, from the first command on."""
        time = round(1e9 * now)
        if not (output.publish and self._command):
            return
        self._bag.write(interface.CURRENTS.recorded, time, packing.packed_currents(time, self._command, output))
        self._bag.write(interface.FILTER_STATE.recorded, time, packing.packed_filter_state(self._command, output))

    def _write(self, time: int, outputs: packing.Outputs) -> None:
        for channel, data in outputs:
            self._bag.write(channel.recorded, time, data)
