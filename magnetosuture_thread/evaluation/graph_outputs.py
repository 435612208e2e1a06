"""What a recorded graph published, put side by side by stamp, and the figures of a replay."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.metrics import MinimumMargin, Percentiles, RunMetrics
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import (
    CAMERA,
    CURRENTS,
    DIAGNOSTICS,
    GROUND_TRUTH_THREAD,
    MARGINS,
    MEASURED_THREAD,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    PREDICTED_THREAD,
)
from magnetosuture_thread.messages.reading import margins_of, nanoseconds, planar_pose

CURRENT_VALID = 0.05  # s; a recorded current counts as in force for this long


class GraphCollector:
    """Puts messages side by side by the stamp of the frame that they are about.

    Takes decoded messages, of ROS or of the bags' type store alike: only fields are read.

    Args:
        length: of the thread [m].

    Attributes:
        poses: frames in which the needle was found.
        driven: stamps of the commands that were followed, not stopped [ns].
        health: what each node reported last of itself.
    """

    def __init__(self, length: float) -> None:
        self._length = length
        self._frames: dict[int, FrameResult] = {}
        self.poses = 0
        self.driven: set[int] = set()
        self.health: dict[str, str] = {}

    def add(self, topic: str, message: Any) -> None:
        """Take one message; topics that say nothing about a frame are ignored."""
        taker = {
            NEEDLE_POSE.recorded: self._take_pose,
            MEASURED_THREAD.recorded: self._take_seen,
            PREDICTED_THREAD.recorded: self._take_prediction,
            MARGINS.recorded: self._take_margins,
            GROUND_TRUTH_THREAD.recorded: self._take_truth,
        }.get(topic)
        if topic == DIAGNOSTICS.recorded:
            self.health.update({status.name.split(":")[0]: status.message for status in message.status})
            return
        if topic == CURRENTS.recorded and not message.stop:
            self.driven.add(nanoseconds(message.command))
        if taker is not None:
            time = nanoseconds(message.header.stamp)
            taker(self._frames.setdefault(time, FrameResult(time)), message)

    def frames(self, first: int = 0, last: int | None = None) -> list[FrameResult]:
        """Return the frames with a prediction, by time; their errors are set by `metrics`.

        Args:
            first: stamp of the first one [ns].
            last: stamp of the last one; of all if None.
        """
        found = (frame for frame in self._frames.values() if len(frame.vertices))
        return sorted(
            (f for f in found if first <= f.stamp and (last is None or f.stamp <= last)), key=lambda f: f.stamp
        )

    def metrics(self, start: int = 0, frames: list[FrameResult] | None = None) -> RunMetrics:
        """Return the figures of frames, of all if None; times count from `start` [ns]."""
        metrics = RunMetrics(self._length, start)
        for frame in self.frames() if frames is None else frames:
            metrics.add(frame)
        metrics.compare()
        return metrics

    def _take_pose(self, frame: FrameResult, message: Any) -> None:
        x, y, frame.heading = planar_pose(message.pose.pose)
        frame.tail = np.array([x, y])
        self.poses += 1

    def _take_seen(self, frame: FrameResult, message: Any) -> None:
        frame.seen = _path(message)

    def _take_truth(self, frame: FrameResult, message: Any) -> None:
        frame.truth = _path(message)

    def _take_prediction(self, frame: FrameResult, message: Any) -> None:
        frame.vertices = np.array([[p.x, p.y] for p in message.positions]).reshape(-1, 2)
        frame.strain = float(np.abs(np.asarray(message.strain)).max(initial=0.0))
        frame.residual = message.residual
        frame.step_time = message.step_time

    def _take_margins(self, frame: FrameResult, message: Any) -> None:
        if message.valid:
            frame.margins = margins_of(message)
            frame.in_contact = bool(frame.margins.in_contact)


def _path(message: Any) -> Points:
    return np.array([[p.pose.position.x, p.pose.position.y] for p in message.poses]).reshape(-1, 2)


def stage_latencies(
    published: Mapping[str, Mapping[int, float]], arrived: Mapping[str, Mapping[int, float]], driven: Set[int]
) -> dict[str, Percentiles | None]:
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
        stage: Percentiles.of([after[stamp] - before[stamp] for stamp in after if stamp in before])
        for stage, (before, after) in stages.items()
    }


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
        self._taken: dict[int, tuple[NDArray[np.float64], bool]] = {}

    def add(self, message: Any) -> None:
        """Take a message CoilCurrents, of ROS or of the bags' type store."""
        stamp = nanoseconds(message.header.stamp)
        self._taken[stamp] = np.asarray(message.current, dtype=np.float64), bool(message.stop)

    def against(self, recorded: CurrentSeries) -> CurrentDifference | None:
        """Compare with what was recorded; None where nothing can be."""
        theirs = np.array(sorted(recorded._taken))
        apart, sizes, stops = [], [], []
        for stamp, (currents, stopped) in sorted(self._taken.items()):
            index = int(np.searchsorted(theirs, stamp, side="right")) - 1
            if index < 0 or stamp - theirs[index] > CURRENT_VALID * 1e9:
                continue
            other, other_stopped = recorded._taken[int(theirs[index])]
            if other.shape != currents.shape:
                continue
            apart.append(currents - other)
            sizes.append(other)
            stops.append(stopped != other_stopped)
        if not apart:
            return None
        difference = np.abs(np.array(apart))
        return CurrentDifference(
            compared=len(difference),
            difference=float(np.median(difference)),
            p99=float(np.percentile(difference, 99)),
            greatest=float(difference.max()),
            recorded=float(np.sqrt(np.mean(np.array(sizes) ** 2))),
            stopped_apart=float(np.mean(stops)),
        )


@dataclass(frozen=True)
class ReplaySummary:
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
    remark: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values; units as above."""
        return asdict(self)
