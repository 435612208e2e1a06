"""What a graph published, put side by side by stamp: the figures of a replay and of a closed loop."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from magnetosuture_thread import interface
from magnetosuture_thread.errors import GraphError, InvalidInputError
from magnetosuture_thread.estimator import Disturbance
from magnetosuture_thread.evaluation.frames import Array, EstimatedThread, FrameResult
from magnetosuture_thread.evaluation.metrics import (
    EstimationFigures,
    MinimumMargin,
    Percentiles,
    RunMetrics,
    compare_errors,
    finite_or_none,
)
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.messages.reading import margins_of, nanoseconds, planar_pose, thread_observation
from magnetosuture_thread.thread_observation import ThreadObservation

TRACKED = 1  # as in the message TrackerState
WRONG_TAIL = 0.3e-3  # m; a pose farther than this from the ground truth, or ...
WRONG_HEADING = np.radians(5.0)  # ... turned by more, is wrong


@dataclass(frozen=True)
class CurrentDifference:
    """How far the currents of a replay are from the recorded ones, at the times of the replay's.

    In places the coils can give the same velocity in two ways, far apart, and change from one to the other
    within a hundredth of a second: the greatest differences are of such moments.

    Attributes:
        compared: how many replayed currents have a recorded one beside them.
        difference: of a coil, median [A].
        p99: 99th percentile [A].
        greatest: [A].
        recorded: root of the mean square of the recorded currents, to judge the difference by [A].
        stopped_apart: share of the compared of which one is a stop and the other is not.
    """

    compared: int
    difference: float
    p99: float
    greatest: float
    recorded: float
    stopped_apart: float


class CurrentSeries:
    """Currents over time, from messages in any order of arrival."""

    def __init__(self) -> None:
        self._received: dict[int, tuple[Array, bool]] = {}

    def add(self, message: Any) -> None:
        """Add a message CoilCurrents, of ROS or of the bags' type store."""
        stamp = nanoseconds(message.header.stamp)
        self._received[stamp] = np.asarray(message.current, dtype=np.float64), bool(message.stop)

    def against(self, recorded: CurrentSeries) -> CurrentDifference | None:
        """Compare with the currents in force when recorded, which are so for 0.05 s; None where nothing can be."""
        stamps = sorted(recorded._received)
        pairs = []
        for stamp, own in self._received.items():
            index = bisect_right(stamps, stamp) - 1
            if index >= 0 and stamp - stamps[index] <= 50_000_000:
                other = recorded._received[stamps[index]]
                if other[0].shape == own[0].shape:
                    pairs.append((own, other))
        if not pairs:
            return None
        difference = np.abs([own[0] - other[0] for own, other in pairs])
        return CurrentDifference(
            compared=len(pairs),
            difference=float(np.median(difference)),
            p99=float(np.percentile(difference, 99)),
            greatest=float(difference.max()),
            recorded=float(np.sqrt(np.mean(np.square([other[0] for _, other in pairs])))),
            stopped_apart=float(np.mean([own[1] != other[1] for own, other in pairs])),
        )


class GraphCollector:
    """Puts messages side by side by the stamp of the frame that they are about.

    Takes decoded messages, of ROS or of the bags' type store alike: only fields are read.

    Args:
        length: of the thread [m].

    Attributes:
        poses: frames in which the needle was found.
        applied: stamps of the commands that were followed, not stopped [ns].
        health: what each node reported last of itself.
    """

    def __init__(self, length: float) -> None:
        self._length = length
        self._frames: dict[int, FrameResult] = {}
        self.poses = 0
        self.applied: set[int] = set()
        self.health: dict[str, str] = {}

    def add(self, topic: str, message: Any) -> None:
        """Add one message; topics that concern no frame are ignored."""
        if topic == interface.DIAGNOSTICS.recorded:
            self.health.update({status.name.split(":")[0]: status.message for status in message.status})
        elif topic == interface.CURRENTS.recorded and not message.stop:
            self.applied.add(nanoseconds(message.command))
        elif topic in _OF_FRAMES:
            stamp = nanoseconds(message.header.stamp)
            _OF_FRAMES[topic](self._frames.setdefault(stamp, FrameResult(stamp)), message)
            self.poses += topic == interface.NEEDLE_POSE.recorded

    def frames(self, first: int = 0, last: int | None = None) -> list[FrameResult]:
        """Return the frames with a prediction, by time; their errors are set by `metrics`.

        Args:
            first: stamp of the first one [ns].
            last: stamp of the last one; of all if None.
        """
        last = max(self._frames, default=0) if last is None else last
        return [frame for at, frame in sorted(self._frames.items()) if len(frame.vertices) and first <= at <= last]

    def metrics(self, start: int = 0, frames: list[FrameResult] | None = None) -> RunMetrics:
        """Return the figures of frames, of all if None; times count from `start` [ns]."""
        metrics = RunMetrics(self._length, start)
        for frame in self.frames() if frames is None else frames:
            metrics.add(frame)
        return metrics


def _take_pose(frame: FrameResult, message: Any) -> None:
    *tail, frame.heading = planar_pose(message.pose.pose)
    frame.tail = np.array(tail)


def _take_measured(frame: FrameResult, message: Any) -> None:
    frame.measured = _points(each.pose.position for each in message.poses)


def _take_ground_truth(frame: FrameResult, message: Any) -> None:
    frame.ground_truth = _points(each.pose.position for each in message.poses)


def _take_true_pull(frame: FrameResult, message: Any) -> None:
    frame.true_pull = _in_plane(message.wrench.force)


def _take_observation(frame: FrameResult, message: Any) -> None:
    try:
        frame.observation = thread_observation(message, interface.THREAD_OBSERVATION.name)
    except InvalidInputError:
        frame.observation = ThreadObservation()


def _take_estimate(frame: FrameResult, message: Any) -> None:
    """Take an estimate; a later one of the same frame takes its place."""
    degrees = int(message.innovation_degrees)
    disturbances = tuple(
        Disturbance(
            found.arc_length,
            found.extent,
            _in_plane(found.position),
            _in_plane(found.direction),
            found.force,
            found.significance,
            nanoseconds(found.since) * 1e-9,
        )
        for found in message.disturbances
    )
    frame.estimate = EstimatedThread(
        _points(message.positions),
        not message.prediction_only,
        np.full(degrees, message.innovation_squared / max(degrees, 1)),
        disturbances,
        message.hidden,
    )


def _take_prediction(frame: FrameResult, message: Any) -> None:
    frame.vertices = _points(message.positions)
    frame.strain = float(np.abs(np.asarray(message.strain)).max(initial=0.0))
    frame.residual, frame.step_time = message.residual, message.step_time
    if len(tension := getattr(message, "tension", ())):  # older bags have none
        frame.tension, frame.pull = float(np.max(tension)), _in_plane(message.needle_force)


def _take_margins(frame: FrameResult, message: Any) -> None:
    if message.valid:
        frame.margins = margins_of(message)
        frame.in_contact = bool(frame.margins.in_contact)


_OF_FRAMES: dict[str, Callable[[FrameResult, Any], None]] = {
    interface.NEEDLE_POSE.recorded: _take_pose,
    interface.MEASURED_THREAD.recorded: _take_measured,
    interface.THREAD_OBSERVATION.recorded: _take_observation,
    interface.PREDICTED_THREAD.recorded: _take_prediction,
    interface.ESTIMATED_THREAD.recorded: _take_estimate,
    interface.MARGINS.recorded: _take_margins,
    interface.GROUND_TRUTH_THREAD.recorded: _take_ground_truth,
    interface.GROUND_TRUTH_PULL.recorded: _take_true_pull,
}


def _in_plane(vector: Any) -> Array:
    return np.array([vector.x, vector.y])


def _points(points: Iterable[Any]) -> Points:
    return np.array([[point.x, point.y] for point in points]).reshape(-1, 2)


@dataclass(frozen=True)
class ReplaySummary:
    """The figures of a replayed bag.

    Attributes:
        bag: its path.
        setup: the setup's name.
        simulated: what was simulated, empty if the bag does not say that anything was.
        frames: camera frames played, or recorded poses.
        tracked: frames in which the needle was found.
        predicted: frames with a predicted thread.
        commands: needle velocity commands played.
        driven: commands that reached the coils.
        latency: of each stage [s].
        step_time: of the model's step [s].
        least_margins: of each kind.
        contact_frames: predicted frames in which the thread touches an obstacle.
        stretch: greatest absolute stretch.
        residual: greatest scaled residual of a solve.
        peak_tension: greatest tension of a segment [N]; None where no force is known.
        needle_pull: greatest force of the thread upon the needle [N]; None where no force is known.
        seen_share: part of the thread's length that the camera saw, mean over the predicted frames.
        error_seen: prediction error against the seen centreline [% of length], over `count` frames.
        error_truth: the same against the truth, where the bag holds it.
        prediction: errors of the prediction; see `compare_errors`.
        estimate: errors of the estimate, under the same names.
        estimation: what else there is of the estimate.
        currents: difference of the coils' currents from the recorded ones, where the bag holds any.
        source: `camera`, or `poses` where `frames` are recorded poses.
        speed: how many seconds of the bag were worked through in a second, of an offline replay; else None.
        refused: frames and poses that could not be used, by why.
        dropped: messages that got lost on a way, by which; empty offline, where there are none.
        damage: what of the bag could not be read, empty if nothing.
        unverified: why any message of the bag may be wrong, empty if nothing speaks against them.
        remark: what else to know of the bag, empty if nothing.
    """

    bag: str
    setup: str
    simulated: str
    frames: int
    tracked: int
    predicted: int
    commands: int
    driven: int
    latency: dict[str, Percentiles | None]
    step_time: Percentiles | None
    least_margins: list[MinimumMargin]
    contact_frames: int
    stretch: float
    residual: float
    seen_share: float
    error_seen: dict[str, float] | None
    error_truth: dict[str, float] | None
    currents: CurrentDifference | None = None
    source: str = "camera"
    speed: float | None = None
    refused: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    damage: str = ""
    unverified: str = ""
    remark: str = ""
    prediction: dict[str, float | None] = field(default_factory=dict)
    estimate: dict[str, float | None] = field(default_factory=dict)
    estimation: EstimationFigures = field(default_factory=EstimationFigures)
    peak_tension: float | None = None
    needle_pull: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values; units as above. Those of `estimation` stand beside the others."""
        figures = {name: value for name, value in asdict(self).items() if name != "estimation"}
        events = [asdict(event) for event in self.estimation.disturbances]
        return figures | self.estimation.to_json() | {"disturbances": events}


@dataclass(frozen=True)
class LoopSummary:
    """The figures of a closed loop. Everything in it is simulated.

    Attributes:
        setup: the scenario's name.
        duration: from the start of the steering until the path was done, or to the end; all figures are of
            this time [s].
        frames: camera frames, lost ones too.
        skipped: frames that are missing: the rig had no time for them.
        tracked: frames with a pose.
        lost: frames that the tracker looked at without giving a pose.
        wrong: poses farther from the truth than 0.3 mm or 5 degrees.
        predicted: frames with a predicted thread.
        saturated: share of the currents at a limit.
        tail_error: distance of the tracked tail from the truth, root of the mean square [m].
        heading_error: of the tracked heading, the same [rad].
        path_error: distance of the needle's true tip from where the path wanted it, the same [m].
        path_error_greatest: greatest such distance [m].
        processing: of a frame in the tracker [s].
        step_time: of the model's step [s].
        latency: from a frame's stamp to the arrival of what was made of it [s].
        error_truth: prediction error against the truth [% of length].
        error_seen: the same against the seen centreline.
        seen_share: part of the thread's length that the camera saw, mean.
        stretch: greatest absolute stretch of a segment.
        prediction: errors of the prediction; see `compare_errors`.
        estimate: errors of the estimate, under the same names.
        procedure: what came of a procedure; None for a path that was followed.
    """

    setup: str
    duration: float
    frames: int
    skipped: int
    tracked: int
    lost: int
    wrong: int
    predicted: int
    saturated: float
    tail_error: float
    heading_error: float
    path_error: float
    path_error_greatest: float
    processing: Percentiles | None
    step_time: Percentiles | None
    latency: dict[str, Percentiles | None]
    error_truth: dict[str, float] | None
    error_seen: dict[str, float] | None
    seen_share: float
    stretch: float
    prediction: dict[str, float | None] = field(default_factory=dict)
    estimate: dict[str, float | None] = field(default_factory=dict)
    procedure: dict[str, Any] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, None where there is none; units as above."""
        return {key: finite_or_none(value) for key, value in asdict(self).items()}


class LoopCollector:
    """Puts the messages of a closed loop side by side by their stamps.

    Args:
        thread_length: [m]
        needle_length: along the needle's body [m].
        needle_curvature: of its arc [1/m].
        frame_rate: of the camera [Hz].

    Attributes:
        instants: the predicted frames by time, once `summary` was asked for.
    """

    def __init__(self, thread_length: float, needle_length: float, needle_curvature: float, frame_rate: float) -> None:
        self._threads = GraphCollector(thread_length)
        self._needle = needle_length, needle_curvature
        self._rate = frame_rate
        self._truth: dict[int, Array] = {}
        self._tracked: dict[int, Array] = {}
        self._setpoints: dict[int, Array] = {}
        self._poses = {
            interface.GROUND_TRUTH_NEEDLE.recorded: self._truth,
            interface.NEEDLE_POSE.recorded: self._tracked,
            interface.TIP_SETPOINT.recorded: self._setpoints,
        }
        self._arrived: dict[str, dict[int, int]] = {interface.NEEDLE_POSE.name: {}, interface.PREDICTED_THREAD.name: {}}
        self._states: dict[int, tuple[int, float]] = {}
        self._saturated: list[bool] = []
        self.instants: list[FrameResult] = []

    def add(self, topic: str, time: int, message: Any) -> None:
        """Add one message that arrived at a time [ns]."""
        self._threads.add(topic, message)
        if not hasattr(message, "header"):
            return
        stamp = nanoseconds(message.header.stamp)
        if topic in self._poses:
            pose = message.pose.pose if topic == interface.NEEDLE_POSE.recorded else message.pose
            self._poses[topic][stamp] = np.array(planar_pose(pose))
        elif topic == interface.TRACKER_STATE.recorded:
            self._states[stamp] = (message.state, message.processing_time)
        elif topic == interface.CURRENTS.recorded:
            self._saturated.append(bool(message.saturated))
        if topic.lstrip("/") in self._arrived:
            self._arrived[topic.lstrip("/")].setdefault(stamp, time)

    def summary(self, setup: str) -> LoopSummary:
        """Return the figures.

        Raises:
            GraphError: there is no frame with a pose and its truth.
        """
        first, last = (min(self._setpoints), max(self._setpoints)) if self._setpoints else (0, 0)
        if self._setpoints and self._threads.health.get("path_follower") != "done":
            last = max(self._truth, default=last)  # who steers is silent while the needle is lost
        frames = {stamp for stamp in self._truth if first <= stamp <= last}
        both = sorted(self._tracked.keys() & frames)
        if not both:
            said = "; ".join(f"{name}: {text}" for name, text in sorted(self._threads.health.items()))
            raise GraphError(f"the needle was tracked in no frame; {said}")
        self.instants = self._threads.frames(first, last)
        metrics = self._threads.metrics(frames=self.instants)
        errors, compared = metrics.errors(), compare_errors(metrics.series)
        apart = np.array([self._tracked[stamp] - self._truth[stamp] for stamp in both])
        tail = np.hypot(apart[:, 0], apart[:, 1])
        heading = np.abs(np.angle(np.exp(1j * apart[:, 2])))
        off = np.array([np.linalg.norm(self._tip(s) - self._setpoints[s][:2]) for s in both if s in self._setpoints])
        states = [found for stamp, found in self._states.items() if stamp in frames]
        return LoopSummary(
            setup=setup,
            duration=(last - first) * 1e-9,
            frames=len(frames),
            skipped=max(0, round((last - first) * 1e-9 * self._rate) + 1 - len(frames)),
            tracked=len(both),
            lost=sum(state != TRACKED for state, _ in states),
            wrong=int(np.sum((tail > WRONG_TAIL) | (heading > WRONG_HEADING))),
            predicted=len(self.instants),
            saturated=float(np.mean(self._saturated or [False])),
            tail_error=_rms(tail),
            heading_error=_rms(heading),
            path_error=_rms(off),
            path_error_greatest=float(off.max(initial=0.0)),
            processing=Percentiles.of([taken for _, taken in states]),
            step_time=metrics.percentiles("step_time"),
            latency={name: self._latency(arrived) for name, arrived in self._arrived.items()},
            error_truth=errors["truth"],
            error_seen=errors["seen"],
            seen_share=metrics.mean("seen_share"),
            stretch=metrics.maximum("strain"),
            prediction=compared["prediction"],
            estimate=compared["estimate"],
        )

    def _tip(self, stamp: int) -> Points:
        """Return where the needle's true tip was."""
        x, y, heading = self._truth[stamp]
        points, _ = needle_axis(np.array([x, y]), heading, *self._needle, np.ones(1))
        return np.asarray(points[0])

    def _latency(self, arrived: dict[int, int]) -> Percentiles | None:
        return Percentiles.of([(time - stamp) * 1e-9 for stamp, time in arrived.items() if stamp in self._setpoints])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
