"""The figures of a closed loop: needle against path, prediction against ground truth, and latencies."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.evaluation.frames import FrameResult
from magnetosuture_thread.evaluation.graph_outputs import GraphCollector
from magnetosuture_thread.evaluation.metrics import Percentiles
from magnetosuture_thread.geometry.needle_arc import needle_axis
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import (
    CURRENTS,
    GROUND_TRUTH_NEEDLE,
    NEEDLE_POSE,
    PREDICTED_THREAD,
    TIP_SETPOINT,
    TRACKER_STATE,
)
from magnetosuture_thread.messages.reading import nanoseconds, planar_pose

TRACKED = 1  # as in the message TrackerState
WRONG_TAIL = 0.3e-3  # m; a pose farther than this from the truth, or ...
WRONG_HEADING = np.radians(5.0)  # ... turned by more, is wrong


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

    def to_json(self) -> dict[str, Any]:
        """Return the figures as plain values, None where there is none; units as above."""
        return {key: _plain(value) for key, value in asdict(self).items()}


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
        self._needle = needle_length
        self._curvature = needle_curvature
        self._rate = frame_rate
        self._truth: dict[int, NDArray[np.float64]] = {}
        self._poses: dict[int, NDArray[np.float64]] = {}
        self._setpoints: dict[int, Points] = {}
        self._arrived: dict[str, dict[int, int]] = {NEEDLE_POSE.name: {}, PREDICTED_THREAD.name: {}}
        self._states: dict[int, tuple[int, float]] = {}
        self._saturated: list[bool] = []
        self.instants: list[FrameResult] = []

    def add(self, topic: str, time: int, message: Any) -> None:
        """Take one message that arrived at a time [ns]."""
        self._threads.add(topic, message)
        if not hasattr(message, "header"):
            return
        stamp = nanoseconds(message.header.stamp)
        if topic == GROUND_TRUTH_NEEDLE.recorded:
            self._truth[stamp] = np.array(planar_pose(message.pose))
        elif topic == NEEDLE_POSE.recorded:
            self._poses[stamp] = np.array(planar_pose(message.pose.pose))
        elif topic == TIP_SETPOINT.recorded:
            self._setpoints[stamp] = np.array(planar_pose(message.pose)[:2])
        elif topic == TRACKER_STATE.recorded:
            self._states[stamp] = (message.state, message.processing_time)
        elif topic == CURRENTS.recorded:
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
        both = sorted(self._poses.keys() & frames)
        if not both:
            said = "; ".join(f"{name}: {text}" for name, text in sorted(self._threads.health.items()))
            raise GraphError(f"the needle was tracked in no frame; {said}")
        self.instants = self._threads.frames(first, last)
        metrics = self._threads.metrics(frames=self.instants)
        errors = metrics.errors()
        apart = np.array([self._poses[stamp] - self._truth[stamp] for stamp in both])
        tail = np.hypot(apart[:, 0], apart[:, 1])
        heading = np.abs(np.angle(np.exp(1j * apart[:, 2])))
        off = np.array([np.linalg.norm(self._tip(s) - self._setpoints[s]) for s in both if s in self._setpoints])
        states = [(state, taken) for stamp, (state, taken) in self._states.items() if stamp in frames]
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
            latency={name: self._latency(name) for name in self._arrived},
            error_truth=errors["truth"],
            error_seen=errors["seen"],
            seen_share=metrics.mean("seen_share"),
            stretch=metrics.maximum("strain"),
        )

    def _tip(self, stamp: int) -> Points:
        """Return where the needle's true tip was."""
        x, y, heading = self._truth[stamp]
        points, _ = needle_axis(np.array([x, y]), heading, self._needle, self._curvature, np.ones(1))
        return np.asarray(points[0])

    def _latency(self, name: str) -> Percentiles | None:
        return Percentiles.of(
            [(time - stamp) * 1e-9 for stamp, time in self._arrived[name].items() if stamp in self._setpoints]
        )


def _plain(value: Any) -> Any:
    """Return None for a number that is none, anything else as it is."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")
