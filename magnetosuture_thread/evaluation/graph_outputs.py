"""Outputs of a graph side by side by stamp, and the figures of a replay and of a closed loop."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from magnetosuture_thread.bags.reading import margins_of, nanoseconds, planar_pose, thread_observation
from magnetosuture_thread.estimator import Disturbance
from magnetosuture_thread.evaluation.frames import Array, EstimatedThread, FrameResult
from magnetosuture_thread.evaluation.metrics import (
    EstimationFigures,
    MinimumMargin,
    Percentiles,
    RunMetrics,
    SensorSilence,
    compare_errors,
    finite_or_none,
)
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.thread_observation import ThreadObservation
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import GraphError, InvalidInputError


@dataclass(frozen=True)
class CurrentDifference:
    """Difference of the currents of a replay from the recorded ones, at the times of the replay's.

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
        """Compare with the currents in force when recorded; None where nothing can be."""
        stamps, replayed = np.array(sorted(recorded._received), np.int64), sorted(self._received)
        pairs = []
        for stamp, index in zip(replayed, np.searchsorted(stamps, replayed, side="right") - 1, strict=True):
            if index >= 0 and stamp - stamps[index] <= 50_000_000:  # ns, for which currents are in force
                now, then = self._received[stamp], recorded._received[int(stamps[index])]
                if now[0].shape == then[0].shape:
                    pairs.append((now, then))
        if not pairs:
            return None
        difference = np.abs([now[0] - then[0] for now, then in pairs])
        median, p99, greatest = np.percentile(difference, (50, 99, 100)).tolist()
        level = _rms(np.array([then[0] for _, then in pairs]))
        stopped_apart = float(np.mean([now[1] != then[1] for now, then in pairs]))
        return CurrentDifference(len(pairs), median, p99, greatest, level, stopped_apart)


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
        """Add one message; topics that concern no frame are ignored, and a later message of a frame counts."""
        match topic:
            case interface.DIAGNOSTICS.recorded:
                self.health.update({status.name.split(":")[0]: status.message for status in message.status})
            case interface.CURRENTS.recorded if not message.stop:
                self.applied.add(nanoseconds(message.command))
            case interface.NEEDLE_POSE.recorded:
                self.poses += 1
            case interface.MEASURED_THREAD.recorded:
                self._of(message).measured = _points(stamped.pose.position for stamped in message.poses)
            case interface.GROUND_TRUTH_THREAD.recorded:
                self._of(message).ground_truth = _points(stamped.pose.position for stamped in message.poses)
            case interface.GROUND_TRUTH_PULL.recorded:
                self._of(message).true_pull = _in_plane(message.wrench.force)
            case interface.THREAD_OBSERVATION.recorded:
                try:
                    observation = thread_observation(message, interface.THREAD_OBSERVATION.name)
                except InvalidInputError:
                    observation = ThreadObservation()
                self._of(message).observation = observation
            case interface.ESTIMATED_THREAD.recorded:
                self._of(message).estimate = _estimate(message)
            case interface.MARGINS.recorded if message.valid:
                self._of(message).margins = margins_of(message)
            case interface.PREDICTED_THREAD.recorded:
                frame = self._of(message)
                frame.vertices = _points(message.positions)
                frame.strain = float(np.abs(np.asarray(message.strain)).max(initial=0.0))
                frame.residual, frame.step_time = message.residual, message.step_time
                if len(tension := getattr(message, "tension", ())):  # older bags have none
                    frame.tension, frame.pull = float(np.max(tension)), _in_plane(message.needle_force)

    def _of(self, message: Any) -> FrameResult:
        """Return the frame that a message is about."""
        stamp = nanoseconds(message.header.stamp)
        return self._frames.setdefault(stamp, FrameResult(stamp))

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


def _estimate(message: Any) -> EstimatedThread:
    disturbances = []
    for contact in message.disturbances:
        place, direction, since = contact.position, contact.direction, nanoseconds(contact.since) * 1e-9
        vectors, force = (_in_plane(place), _in_plane(direction)), (contact.force, contact.significance)
        disturbances.append(Disturbance(contact.arc_length, contact.extent, *vectors, *force, since))
    degrees, vertices = int(message.innovation_degrees), _points(message.positions)
    squared = np.full(degrees, message.innovation_squared / max(degrees, 1))
    return EstimatedThread(vertices, not message.prediction_only, squared, tuple(disturbances), message.hidden)


def _in_plane(vector: Any) -> Array:
    return np.array([vector.x, vector.y])


def _points(points: Iterable[Any]) -> Points:
    return np.array([[point.x, point.y] for point in points]).reshape(-1, 2)


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """The figures that a replay and a closed loop have in common.

    Attributes:
        setup: the setup's name.
        frames: camera frames, lost ones too, or recorded poses.
        tracked: frames with a pose.
        predicted: frames with a predicted thread.
        latency: of each stage, or from a frame's stamp to the arrival of what was made of it [s].
        step_time: of the model's step [s].
        stretch: greatest absolute stretch of a segment.
        seen_share: part of the thread's length that the camera saw, mean over the predicted frames.
        error_seen: prediction error against the seen centreline [% of length], over `count` frames.
        error_truth: the same against the truth, where the bag holds it.
        prediction: errors of the prediction; see `compare_errors`.
        estimate: errors of the estimate, under the same names.
    """

    setup: str
    frames: int
    tracked: int
    predicted: int
    latency: dict[str, Percentiles | None]
    step_time: Percentiles | None
    stretch: float
    seen_share: float
    error_seen: dict[str, float] | None
    error_truth: dict[str, float] | None
    prediction: dict[str, float | None] = field(default_factory=dict)
    estimate: dict[str, float | None] = field(default_factory=dict)


def figures_of(metrics: RunMetrics) -> dict[str, Any]:
    """Return the fields of `RunSummary` that the metrics of a run give, by their names."""
    errors = metrics.errors()
    return {
        "predicted": len(metrics.series),
        "step_time": metrics.percentiles("step_time"),
        "stretch": metrics.maximum("strain"),
        "seen_share": metrics.mean("seen_share"),
        "error_seen": errors["seen"],
        "error_truth": errors["truth"],
        **compare_errors(metrics.series),
    }


@dataclass(frozen=True, kw_only=True)
class ReplaySummary(RunSummary):
    """The figures of a replayed bag.

    Attributes:
        bag: its path.
        simulated: what was simulated, empty if the bag does not say that anything was.
        commands: needle velocity commands played.
        driven: commands that reached the coils.
        least_margins: of each kind.
        contact_frames: predicted frames in which the thread touches an obstacle.
        residual: greatest scaled residual of a solve.
        peak_tension: greatest tension of a segment [N]; None where no force is known.
        needle_pull: greatest force of the thread upon the needle [N]; None where no force is known.
        estimation: what else there is of the estimate.
        currents: difference of the coils' currents from the recorded ones, where the bag holds any.
        source: `camera`, or `poses` where `frames` are recorded poses.
        speed: how many seconds of the bag were worked through in a second, of an offline replay; else None.
        refused: frames and poses that could not be used, by why.
        dropped: messages that got lost on a way, by which; empty offline, where there are none.
        silence: time without frames, or poses.
        damage: what of the bag could not be read, empty if nothing.
        unverified: why any message of the bag may be wrong, empty if nothing speaks against them.
        remark: what else to know of the bag, empty if nothing.
    """

    bag: str
    simulated: str
    commands: int
    driven: int
    least_margins: list[MinimumMargin]
    contact_frames: int
    residual: float
    peak_tension: float | None = None
    needle_pull: float | None = None
    estimation: EstimationFigures = field(default_factory=EstimationFigures)
    currents: CurrentDifference | None = None
    source: str = "camera"
    speed: float | None = None
    refused: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    silence: SensorSilence = field(default_factory=SensorSilence)
    damage: str = ""
    unverified: str = ""
    remark: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values; units as above. Those of `estimation` stand beside the others."""
        figures = asdict(self)
        events = figures.pop("estimation")["disturbances"]
        figures["silence"]["at"] = finite_or_none(self.silence.at)
        return figures | self.estimation.to_json() | {"disturbances": list(events)}


@dataclass(frozen=True, kw_only=True)
class LoopSummary(RunSummary):
    """The figures of a closed loop. Everything in it is simulated.

    Attributes:
        duration: from the start of the steering until the path was done, or to the end; all figures are of
            this time [s].
        skipped: frames that are missing: the rig had no time for them.
        lost: frames that the tracker looked at without giving a pose.
        wrong: poses farther from the truth than 0.3 mm or 5 degrees.
        saturated: share of the currents at a limit.
        tail_error: distance of the tracked tail from the truth, root of the mean square [m].
        heading_error: of the tracked heading, the same [rad].
        path_error: distance of the needle's true tip from where the path wanted it, the same [m].
        path_error_greatest: greatest such distance [m].
        processing: of a frame in the tracker [s].
        procedure: what came of a procedure; None for a path that was followed.
        too_slow: that the computer was too slow for the run, and what to do; empty if it was not.
    """

    duration: float
    skipped: int
    lost: int
    wrong: int
    saturated: float
    tail_error: float
    heading_error: float
    path_error: float
    path_error_greatest: float
    processing: Percentiles | None
    procedure: dict[str, Any] | None = None
    too_slow: str = ""

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
        match topic:
            case interface.GROUND_TRUTH_NEEDLE.recorded:
                self._truth[stamp] = np.array(planar_pose(message.pose))
            case interface.TIP_SETPOINT.recorded:
                self._setpoints[stamp] = np.array(planar_pose(message.pose))
            case interface.NEEDLE_POSE.recorded:
                self._tracked[stamp] = np.array(planar_pose(message.pose.pose))
            case interface.TRACKER_STATE.recorded:
                self._states[stamp] = (message.state, message.processing_time)
            case interface.CURRENTS.recorded:
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
            health = "; ".join(f"{name}: {text}" for name, text in sorted(self._threads.health.items()))
            raise GraphError(f"the needle was tracked in no frame; {health}")
        self.instants = self._threads.frames(first, last)
        apart = np.array([self._tracked[stamp] - self._truth[stamp] for stamp in both])
        tail, heading = np.linalg.norm(apart[:, :2], axis=1), np.abs(np.angle(np.exp(1j * apart[:, 2])))
        off = np.array([np.linalg.norm(self._tip(s) - self._setpoints[s][:2]) for s in both if s in self._setpoints])
        states = [state for stamp, state in self._states.items() if stamp in frames]
        return LoopSummary(
            setup=setup,
            duration=(last - first) * 1e-9,
            frames=len(frames),
            skipped=max(0, round((last - first) * 1e-9 * self._rate) + 1 - len(frames)),
            tracked=len(both),
            lost=sum(state != 1 for state, _ in states),  # TrackerState.TRACKED
            wrong=int(np.sum((tail > 0.3e-3) | (heading > np.radians(5.0)))),
            saturated=float(np.mean(self._saturated or [False])),
            tail_error=_rms(tail),
            heading_error=_rms(heading),
            path_error=_rms(off),
            path_error_greatest=float(off.max(initial=0.0)),
            processing=Percentiles.of([taken for _, taken in states]),
            latency={
                name: Percentiles.of([1e-9 * (at - stamp) for stamp, at in arrived.items() if stamp in self._setpoints])
                for name, arrived in self._arrived.items()
            },
            **figures_of(self._threads.metrics(frames=self.instants)),
        )

    def _tip(self, stamp: int) -> Points:
        """Return where the needle's true tip was."""
        x, y, heading = self._truth[stamp]
        points, _ = needle_axis(np.array([x, y]), heading, *self._needle, np.ones(1))
        return np.asarray(points[0])


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
