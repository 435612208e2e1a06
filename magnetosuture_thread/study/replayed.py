"""What a replayed bag showed: the outputs of the graph, put side by side by their stamps."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, arc_lengths
from magnetosuture_thread.interface import (
    CAMERA,
    CURRENTS,
    DIAGNOSTICS,
    MARGINS,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    PREDICTED_THREAD,
    SEEN_THREAD,
    TRUE_THREAD,
)
from magnetosuture_thread.study.currents import CurrentDifference
from magnetosuture_thread.study.score import prediction_error_percent

# By the number in the message BarrierMargin.
KINDS = ("connectivity", "compression", "obstacle", "enhanced_connectivity", "stiffness", "wall")
SOLID = ("obstacle", "wall")  # kinds of what a node can touch


@dataclass(frozen=True)
class LeastMargin:
    """The least margin of one kind over the whole bag, and where it was.

    Attributes:
        kind: of barrier.
        clearance: as a distance [m].
        node: index.
        obstacle: index, -1 where the kind has none.
        time: since the bag's start [s].
    """

    kind: str
    clearance: float
    node: int
    obstacle: int
    time: float


@dataclass
class Instant:
    """What the graph said about one camera frame.

    Attributes:
        stamp: of the frame [ns].
        vertices: predicted thread, shape (n + 1, 2) [m].
        stretch: greatest absolute stretch of a segment.
        residual: of the solves.
        step_time: of the model [s].
        clearance: least clearance of an obstacle for each node, shape (n + 1,), inf where none [m].
        least: least clearance of each kind [m].
        seen: the thread's centreline as the camera saw it, shape (m, 2) [m].
        truth: where the thread really was, if the bag says so, shape (m, 2) [m].
        tail: the needle's tail as tracked, shape (2,) [m].
        heading: the needle's angle as tracked [rad].
        seen_share: part of the thread's length that the camera saw.
        error_seen: prediction error against the seen centreline [% of length].
        error_truth: the same against the truth.
    """

    stamp: int
    vertices: Points = field(default_factory=lambda: np.empty((0, 2)))
    stretch: float = float("nan")
    residual: float = float("nan")
    step_time: float = float("nan")
    clearance: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    least: dict[str, float] = field(default_factory=dict)
    seen: Points = field(default_factory=lambda: np.empty((0, 2)))
    truth: Points = field(default_factory=lambda: np.empty((0, 2)))
    tail: Points = field(default_factory=lambda: np.empty(0))
    heading: float = float("nan")
    seen_share: float = 0.0
    error_seen: float = float("nan")
    error_truth: float = float("nan")


@dataclass(frozen=True)
class Spread:
    """Median, 99th percentile and maximum of a set of values."""

    median: float
    p99: float
    maximum: float

    @classmethod
    def of(cls, values: list[float]) -> Spread | None:
        """Return the spread of values, or None of none."""
        kept = [value for value in values if np.isfinite(value)]
        if not kept:
            return None
        return cls(float(np.median(kept)), float(np.percentile(kept, 99)), float(np.max(kept)))


@dataclass(frozen=True)
class Summary:
    """The figures of a replayed bag.

    Attributes:
        bag: its path.
        setup: the set-up's name.
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
        seen_share: part of the thread's length that the camera saw, mean over the predicted frames.
        error_seen: prediction error against the seen centreline [% of length], over `count` frames.
        error_truth: the same against the truth, where the bag holds it.
        currents: difference of the coils' currents from the recorded ones, where the bag holds any.
        source: `camera`, or `poses` where `frames` are recorded poses.
        speed: how many seconds of the bag were worked through in a second, of an offline replay; else None.
        refused: frames and poses that could not be used, by why.
        dropped: messages that got lost on a way, by which; empty offline, where there are none.
        damage: what of the bag could not be read, empty if nothing.
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
    latency: dict[str, Spread | None]
    step_time: Spread | None
    least_margins: list[LeastMargin]
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
    remark: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values; units as above."""
        return asdict(self)


class Collector:
    """Puts messages side by side by the stamp of the frame that they are about.

    Takes decoded messages, of ROS or of the bags' type store alike: only fields are read.

    Args:
        length: of the thread [m].

    Attributes:
        contact_frames: predicted frames in which the thread touches an obstacle.
        poses: frames in which the needle was found.
        driven: stamps of the commands that were followed, not stopped [ns].
        health: what each node said last of itself.
    """

    def __init__(self, length: float) -> None:
        self._length = length
        self._instants: dict[int, Instant] = {}
        self._least: dict[int, tuple[float, int, int, int]] = {}
        self.contact_frames = 0
        self.poses = 0
        self.driven: set[int] = set()
        self.health: dict[str, str] = {}

    def take(self, topic: str, message: Any) -> None:
        """Take one message; topics that say nothing about a frame are ignored."""
        taker = {
            NEEDLE_POSE.recorded: self._take_pose,
            SEEN_THREAD.recorded: self._take_seen,
            PREDICTED_THREAD.recorded: self._take_prediction,
            MARGINS.recorded: self._take_margins,
            TRUE_THREAD.recorded: self._take_truth,
        }.get(topic)
        if topic == DIAGNOSTICS.recorded:
            self.health.update({status.name.split(":")[0]: status.message for status in message.status})
            return
        stamp = message.header.stamp if hasattr(message, "header") else None
        time = stamp.sec * 1_000_000_000 + stamp.nanosec if stamp is not None else 0
        if topic == CURRENTS.recorded and not message.stop:
            self.driven.add(message.command.sec * 1_000_000_000 + message.command.nanosec)
        if taker is not None:
            taker(self._instants.setdefault(time, Instant(time)), message)

    def instants(self) -> list[Instant]:
        """Return the predicted frames by time, with their errors."""
        found = sorted((i for i in self._instants.values() if len(i.vertices)), key=lambda i: i.stamp)
        for instant in found:
            instant.seen_share = min(1.0, _length(instant.seen) / self._length)
            instant.error_seen = prediction_error_percent(instant.vertices, instant.seen, self._length)
            if len(instant.truth):
                instant.error_truth = prediction_error_percent(instant.vertices, instant.truth, self._length)
        return found

    def least_margins(self, start: int) -> list[LeastMargin]:
        """Return the least margin of each kind; times count from `start` [ns]."""
        return [
            LeastMargin(KINDS[kind], clearance, node, obstacle, (stamp - start) * 1e-9)
            for kind, (clearance, node, obstacle, stamp) in sorted(self._least.items())
        ]

    def _take_pose(self, instant: Instant, message: Any) -> None:
        position, turned = message.pose.pose.position, message.pose.pose.orientation
        instant.tail = np.array([position.x, position.y])
        instant.heading = 2.0 * float(np.arctan2(turned.z, turned.w))
        self.poses += 1

    def _take_seen(self, instant: Instant, message: Any) -> None:
        instant.seen = _path(message)

    def _take_truth(self, instant: Instant, message: Any) -> None:
        instant.truth = _path(message)

    def _take_prediction(self, instant: Instant, message: Any) -> None:
        instant.vertices = np.array([[p.x, p.y] for p in message.vertices]).reshape(-1, 2)
        instant.stretch = float(np.abs(np.asarray(message.stretch)).max(initial=0.0))
        instant.residual = message.residual
        instant.step_time = message.step_time

    def _take_margins(self, instant: Instant, message: Any) -> None:
        if not message.valid:
            return
        kind, node = np.asarray(message.kind), np.asarray(message.node)
        clearance = np.asarray(message.clearance)
        near = np.isin(kind, [KINDS.index(solid) for solid in SOLID])
        instant.clearance = np.full(int(node.max(initial=0)) + 1, np.inf)
        np.minimum.at(instant.clearance, node[near], clearance[near])
        for entry in message.least:
            instant.least[KINDS[entry.kind]] = entry.clearance
            if entry.clearance < self._least.get(entry.kind, (np.inf,))[0]:
                self._least[entry.kind] = (entry.clearance, entry.node, entry.obstacle, instant.stamp)
        self.contact_frames += bool(len(message.contact_nodes))


def error_figures(errors: list[float]) -> dict[str, float] | None:
    """Return count, mean, median, p99 and maximum of errors in %; None of none."""
    spread = Spread.of(errors)
    if spread is None:
        return None
    return {"count": int(np.isfinite(errors).sum()), "mean": float(np.nanmean(errors)), **asdict(spread)}


def stage_latencies(
    published: Mapping[str, Mapping[int, float]], arrived: Mapping[str, Mapping[int, float]], driven: Set[int]
) -> dict[str, Spread | None]:
    """Return the latency of each stage of the graph [s].

    Args:
        published: of each input topic, when the message of a stamp was published [s].
        arrived: of each output topic, when the first message of a stamp arrived [s].
        driven: stamps of the commands that were followed; the watchdog's zeros answer no command.
    """
    camera = {stamp: at for channel in CAMERA.values() for stamp, at in published.get(channel.name, {}).items()}
    commands = {stamp: at for stamp, at in published.get(NEEDLE_COMMAND.name, {}).items() if stamp in driven}
    poses, predictions = arrived.get(NEEDLE_POSE.name, {}), arrived.get(PREDICTED_THREAD.name, {})
    stages: dict[str, tuple[Mapping[int, float], Mapping[int, float]]] = {
        "frame to needle pose": (camera, poses),
        "pose to prediction": (poses, predictions),
        "frame to prediction": (camera, predictions),
        "command to currents": (commands, arrived.get(CURRENTS.name, {})),
    }
    return {
        stage: Spread.of([after[stamp] - before[stamp] for stamp in after if stamp in before])
        for stage, (before, after) in stages.items()
    }


def _length(points: Points) -> float:
    return float(arc_lengths(points)[-1]) if len(points) > 1 else 0.0


def _path(message: Any) -> Points:
    return np.array([[p.pose.position.x, p.pose.position.y] for p in message.poses]).reshape(-1, 2)
