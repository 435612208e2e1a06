"""Messages of a graph put side by side: the figures of a replay and of a closed loop."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.evaluation.graph_outputs import CurrentSeries, GraphCollector, LoopCollector, ReplaySummary
from magnetosuture_thread.evaluation.metrics import Percentiles, compare_errors, stage_latencies
from magnetosuture_thread.evaluation.tables import summary_table


def header(nanoseconds: int) -> Message:
    """Return a header."""
    return Message(stamp=Message(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9))


def path(nanoseconds: int, points: np.ndarray) -> Message:
    """Return a path."""
    return Message(
        header=header(nanoseconds), poses=[Message(pose=Message(position=Message(x=x, y=y))) for x, y in points]
    )


def prediction(nanoseconds: int, points: np.ndarray) -> Message:
    """Return a predicted thread."""
    return Message(
        header=header(nanoseconds),
        positions=[Message(x=x, y=y) for x, y in points],
        strain=[0.0, -0.002, 0.001, 0.0],
        residual=1e-8,
        step_time=0.004,
    )


def margins(nanoseconds: int, clearance: float, valid: bool = True) -> Message:
    """Return margins of one obstacle row for node 3 and one connectivity row for node 1."""
    return Message(
        header=header(nanoseconds),
        valid=valid,
        scene_version="",
        barrier_names=["connectivity", "obstacle"],
        barrier=[0, 1],
        node=[1, 3],
        obstacle=[-1, 0],
        value=[1e-9, clearance],
        clearance=[1e-9, clearance],
        contact_nodes=[3] if clearance <= 0.0 else [],
        friction_state=1,
        friction_nodes=[],
        slowdown=1.0,
    )


STRAIGHT = np.column_stack([-0.25 * np.arange(5), np.zeros(5)])


def test_messages_of_one_stamp_are_put_together():
    collector = GraphCollector(length=1.0)
    for k, clearance in ((1, 0.5), (2, -0.1), (3, 0.2)):
        collector.add("/thread/predicted", prediction(k * 10**9, STRAIGHT))
        collector.add("/thread/measured", path(k * 10**9, STRAIGHT + np.array([0.0, 0.01])))
        collector.add("/thread/margins", margins(k * 10**9, clearance))
    collector.add("/ground_truth/thread", path(2 * 10**9, STRAIGHT + np.array([0.0, 0.02])))
    collector.add("/thread/measured", path(9 * 10**9, STRAIGHT))  # without a prediction
    collector.add("/thread/margins", margins(9 * 10**9, -7.0, valid=False))
    metrics, instants = collector.metrics(start=10**9), collector.frames()
    assert [instant.stamp for instant in instants] == [10**9, 2 * 10**9, 3 * 10**9]
    assert [instant.errors["seen"] for instant in instants] == pytest.approx([1.0] * 3)
    assert instants[1].errors["truth"] == pytest.approx(2.0)
    assert np.isnan(instants[0].errors["truth"])
    assert instants[0].strain == pytest.approx(0.002)
    assert instants[0].clearance.tolist() == [np.inf, np.inf, np.inf, 0.5, np.inf]
    assert metrics.contact_frames == 1
    assert [(m.kind, m.clearance, m.node, m.obstacle, m.time) for m in metrics.minimum_margins.values()] == [
        ("connectivity", 1e-9, 1, -1, 0.0),
        ("obstacle", -0.1, 3, 0, 1.0),
    ]


def test_the_pull_is_compared_with_the_ground_truth_in_percent_of_its_peak():
    collector = GraphCollector(length=1.0)
    for k, (pull, true) in enumerate([((3.0, 4.0), (0.0, 0.0)), ((0.0, 10.0), (0.0, 10.0)), ((1.0, 0.0), None)], 1):
        predicted = prediction(k * 10**9, STRAIGHT)
        predicted.tension, predicted.needle_force = [1.0], Message(x=pull[0], y=pull[1])
        collector.add("/thread/predicted", predicted)
        if true is not None:
            wrench = Message(force=Message(x=true[0], y=true[1]))
            collector.add("/ground_truth/thread_pull", Message(header=header(k * 10**9), wrench=wrench))
    metrics = collector.metrics(start=10**9)
    assert metrics.series.column("pull_error") == pytest.approx([5.0, 0.0, math.nan], nan_ok=True)
    assert metrics.pull_error_percent == pytest.approx(100.0 * math.sqrt(25.0 / 2.0) / 10.0)
    assert math.isnan(GraphCollector(length=1.0).metrics().pull_error_percent)


def estimate(nanoseconds: int, points: np.ndarray, degrees: int) -> Message:
    """Return an estimated thread that is disturbed."""
    found = Message(
        arc_length=0.5,
        extent=0.1,
        position=Message(x=-0.5, y=0.0, z=0.0),
        direction=Message(x=0.0, y=1.0, z=0.0),
        force=1e-6,
        significance=6.0,
        since=header(nanoseconds - 10**8).stamp,
    )
    return Message(
        header=header(nanoseconds),
        positions=[Message(x=x, y=y) for x, y in points],
        prediction_only=degrees == 0,
        innovation_squared=1.5 * degrees,
        innovation_degrees=degrees,
        hidden=0.25,
        disturbances=[found],
    )


def test_the_last_estimate_of_a_frame_is_compared_beside_the_prediction():
    collector = GraphCollector(length=1.0)
    for k in (1, 2):
        collector.add("/thread/predicted", prediction(k * 10**9, STRAIGHT + np.array([0.0, 0.05])))
        collector.add("/thread/estimated", estimate(k * 10**9, STRAIGHT + np.array([0.0, 0.04]), 0))
        collector.add("/ground_truth/thread", path(k * 10**9, STRAIGHT))
    collector.add("/thread/estimated", estimate(2 * 10**9, STRAIGHT + np.array([0.0, 0.01]), 16))
    metrics = collector.metrics(start=10**9)
    found = compare_errors(metrics.series)
    assert found["prediction"]["error_ground_truth_mean_percent"] == pytest.approx(5.0)
    assert found["estimate"]["error_ground_truth_mean_percent"] == pytest.approx(2.5)
    estimation = metrics.estimation
    assert estimation.corrected == 1
    assert estimation.consistency is not None
    assert estimation.consistency.mean == pytest.approx(1.5)
    assert estimation.hidden is not None
    assert estimation.hidden.length == pytest.approx((1.0 + 0.25) / 2)  # nothing measured was kept beside it
    assert [event.begin_s for event in estimation.disturbances] == pytest.approx([-0.1, 0.9])


def test_latencies_pair_stamps():
    published = {"camera/image_raw/compressed": {1: 0.0, 2: 1.0}, "needle/servo_cv": {1: 0.5}}
    arrived = {"needle/measured_cp": {1: 0.01, 2: 1.03}, "thread/predicted": {2: 1.04}, "coils/currents": {7: 0.1}}
    found = stage_latencies(published, arrived, applied={1})
    pose, step = found["frame to needle pose"], found["pose to prediction"]
    assert pose is not None
    assert step is not None
    assert pose.median == pytest.approx(0.02)
    assert pose.maximum == pytest.approx(0.03)
    assert step.median == pytest.approx(0.01)
    assert found["command to currents"] is None


def shown(summary: ReplaySummary) -> str:
    """Return a summary as a terminal of 80 columns shows it."""
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(summary_table(summary))
    text = console.export_text()
    assert max(len(line) for line in text.splitlines()) <= 80
    return text


def test_the_table_says_what_is_simulated_and_fits_a_terminal():
    spread, latency = Percentiles(0.012, 0.02, 0.03), {"frame to needle pose": None}
    summary = ReplaySummary(
        *("bag", "petri", "all of it", 10, 9, 8, 0, 0, {**latency, "command to currents": spread}, spread, [], 2),
        *(1e-6, 1e-9, 0.9, None, None),
        prediction={"error_measured_mean_percent": 0.5, "error_measured_max_percent": 1.0},
        dropped={"frames not taken by vision_tracker": 3, "poses without an answer": 0},
    )
    text = shown(summary)
    for words in ("simulated", "90.0 %", "12.0 ms", "no pairs", "0.500 %", "1.000 %", "dropped", "frames not taken"):
        assert words in text
    assert "truth" not in text
    assert "without an answer" not in text
    given: dict[str, Any] = {
        "refused": {"a pose that is none": 2},
        "damage": "the end is missing",
        "remark": "it is another thread",
    }
    text = shown(replace(summary, source="poses", speed=52.4, latency={}, **given))
    for words in ("recorded poses", "usable", "a pose that is none", "52.4", "the end is missing", "another thread"):
        assert words in text
    for words in ("camera frames", "velocity", "latency", "dropped"):
        assert words not in text


def currents(time: float, *currents: float, stop: str = "") -> Message:
    """Return what a message of currents amounts to."""
    return Message(header=header(round(time * 1e9)), current=list(currents), stop=stop)


def series(*messages: Message) -> CurrentSeries:
    """Return a series of messages."""
    made = CurrentSeries()
    for each in messages:
        made.add(each)
    return made


def test_the_current_in_force_is_the_one_to_compare_with():
    recorded = series(currents(1.0, 1.0, 0.0), currents(1.01, 2.0, 0.0), currents(1.02, 3.0, 0.0, stop="no command"))
    found = series(currents(1.013, 2.5, 0.0), currents(1.0199, 2.0, 0.0), currents(1.03, 3.0, 0.0)).against(recorded)
    assert found is not None
    assert (found.compared, found.greatest, found.difference) == (3, 0.5, 0.0)
    assert found.recorded == pytest.approx((17.0 / 6.0) ** 0.5)
    assert found.stopped_apart == pytest.approx(1.0 / 3.0)


def test_what_has_nothing_beside_it_is_not_compared():
    recorded = series(currents(1.0, 1.0))
    assert series(currents(0.9, 1.0), currents(1.06, 1.0)).against(recorded) is None
    assert series(currents(1.0, 1.0, 2.0)).against(recorded) is None
    assert series().against(recorded) is None
    assert series(currents(1.0, 1.0)).against(series()) is None


LENGTH = 0.007


def planar(x: float, y: float, angle: float) -> Message:
    """Return a pose in the plane."""
    turned = Message(x=0.0, y=0.0, z=math.sin(0.5 * angle), w=math.cos(0.5 * angle))
    return Message(position=Message(x=x, y=y, z=0.0), orientation=turned)


class Loop:
    """A collector that is told of frames."""

    def __init__(self, curvature: float = 0.0) -> None:
        self.collector = LoopCollector(0.019, LENGTH, curvature, 100.0)

    def truth(self, stamp: int, x: float = 0.0, y: float = 0.0, angle: float = 0.0) -> None:
        """Say where the needle really was."""
        message = Message(header=header(stamp), pose=planar(x, y, angle))
        self.collector.add("/ground_truth/needle", stamp, message)

    def pose(self, stamp: int, x: float = 0.0, y: float = 0.0, angle: float = 0.0, after: int = 0) -> None:
        """Say where it was tracked, and what the tracker said of the frame."""
        message = Message(header=header(stamp), pose=Message(pose=planar(x, y, angle)))
        self.collector.add("/needle/measured_cp", stamp + after, message)
        self.state(stamp, 1)

    def state(self, stamp: int, state: int) -> None:
        """Say what the tracker said of a frame."""
        message = Message(header=header(stamp), state=state, processing_time=0.004)
        self.collector.add("/needle/tracker_state", stamp, message)

    def wish(self, stamp: int, x: float, y: float = 0.0) -> None:
        """Say where the path wanted the tip."""
        self.collector.add("/needle/setpoint_cp", stamp, Message(header=header(stamp), pose=planar(x, y, 0.0)))


def test_errors_are_against_the_truth_of_the_same_frame():
    loop = Loop()
    for index in range(4):
        stamp = 10**9 + index * 10**7
        loop.truth(stamp, x=1e-3 * index, angle=0.1)
        loop.pose(stamp, x=1e-3 * index + 3e-5, y=4e-5, angle=0.11, after=5_000_000)
        tip = 1e-3 * index + LENGTH * math.cos(0.1), LENGTH * math.sin(0.1)
        loop.wish(stamp, tip[0] + 2e-4, tip[1])
    summary = loop.collector.summary("x")
    assert summary.tail_error == pytest.approx(5e-5)
    assert summary.heading_error == pytest.approx(0.01)
    assert summary.path_error == pytest.approx(2e-4)
    assert summary.path_error_greatest == pytest.approx(2e-4)
    assert (summary.frames, summary.tracked, summary.lost, summary.wrong) == (4, 4, 0, 0)
    assert summary.duration == pytest.approx(0.03)
    latency = summary.latency["needle/measured_cp"]
    assert latency is not None
    assert latency.median == pytest.approx(0.005)


@pytest.mark.parametrize(
    ("x", "angle", "wrong"), [(2.9e-4, 0.0, 0), (3.1e-4, 0.0, 1), (0.0, 0.08, 0), (0.0, 0.09, 1), (0.0, math.pi, 1)]
)
def test_a_pose_far_from_the_truth_is_counted_as_wrong(x: float, angle: float, wrong: int):
    loop = Loop()
    loop.truth(10**9)
    loop.wish(10**9, LENGTH)
    loop.pose(10**9, x=x, angle=angle)
    assert loop.collector.summary("x").wrong == wrong


def test_only_the_time_of_steering_counts():
    loop = Loop()
    for index in range(10):
        stamp = 10**9 + index * 10**7
        loop.truth(stamp)
        if 3 <= index <= 6:
            loop.wish(stamp, LENGTH)
        if index != 5:
            loop.pose(stamp)
        else:
            loop.state(stamp, 2)
    done = Message(name="path_follower: state", message="done")
    loop.collector.add("/diagnostics", 10**9, Message(header=header(10**9), status=[done]))
    summary = loop.collector.summary("x")
    assert (summary.frames, summary.tracked, summary.lost, summary.skipped) == (4, 3, 1, 0)


def test_a_run_without_a_pose_says_what_the_nodes_said():
    loop = Loop()
    loop.truth(10**9)
    status = Message(name="vision_tracker: state", message="searching: no dish in the image")
    loop.collector.add("/diagnostics", 10**9, Message(header=header(10**9), status=[status]))
    with pytest.raises(GraphError, match="no dish in the image"):
        loop.collector.summary("x")
