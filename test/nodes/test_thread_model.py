"""The thread model in a graph."""

from __future__ import annotations

import math

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from magnetosuture_msgs.msg import SafetyMargins
from nav_msgs.msg import Path

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.thread_model import ThreadModelNode
from test.examples import FOLDER
from test.nodes import wire


def stamp(seconds: float) -> Time:
    """Return a stamp."""
    return Time(sec=int(seconds), nanosec=round((seconds % 1.0) * 1e9))


def pose(seconds: float, x: float = 0.0, y: float = 0.0) -> PoseWithCovarianceStamped:
    """Return a needle that points east."""
    return wire.pose_message(stamp(seconds), np.array([x, y]), np.array([1.0, 0.0]))


def seen(seconds: float) -> Path:
    """Return a thread that lies straight behind a needle at the origin."""
    return wire.path_message(stamp(seconds), np.column_stack([-np.linspace(0.0, 0.019, 60), np.zeros(60)]))


def test_the_thread_starts_where_it_is_seen_and_follows(graph):
    graph.add(ThreadModelNode)
    predicted, margins = graph.listen(topics.PREDICTED_THREAD), graph.listen(topics.MARGINS)
    markers = graph.listen(topics.THREAD_MARKERS)
    graph.publish(topics.MEASURED_THREAD, seen(1.0))
    graph.publish(topics.NEEDLE_POSE, pose(1.0))
    graph.wait(lambda: len(predicted) == 1, "the start")
    for k in range(1, 11):
        graph.publish(topics.NEEDLE_POSE, pose(1.0 + k / 30.0, k * 1e-4))
        graph.wait(lambda k=k: len(predicted) == k + 1, "a prediction")
    last = predicted[-1]
    assert last.header.frame_id == "dish"
    assert last.header.stamp == pose(1.0 + 10 / 30.0).header.stamp
    assert len(last.positions) == 26
    assert last.positions[0].x == pytest.approx(1e-3)
    assert last.positions[25].x == pytest.approx(1e-3 - 0.019, abs=1e-6)
    assert max(abs(value) for value in last.strain) < 1e-5
    graph.wait(lambda: len(margins) >= 11 and len(markers) >= 11, "margins and markers")
    assert margins[-1].valid
    assert margins[-1].contact_state == SafetyMargins.CONTACT_FREE
    assert margins[-1].friction_state == SafetyMargins.FRICTION_FREE


def test_a_barrier_of_ones_own_has_margins_on_the_topic(graph, tmp_path, monkeypatch: pytest.MonkeyPatch):
    source = (FOLDER / "barriers/tip_keep_in.py").read_text()
    (tmp_path / "barriers_of_a_laboratory.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    graph.add(ThreadModelNode, initial_shape="straight", barriers=["barriers_of_a_laboratory:TipKeepIn"])
    margins = graph.listen(topics.MARGINS)
    for k in range(3):
        graph.publish(topics.NEEDLE_POSE, pose(1.0 + k / 30.0, 0.0, 1e-4 * k))
    graph.wait(lambda: len(margins) == 3, "margins")
    assert margins[-1].valid
    own = margins[-1].barrier_names.index("tip_keep_in")
    assert [margins[-1].node[row] for row, barrier in enumerate(margins[-1].barrier) if barrier == own] == [25] * 4
    least = next(entry for entry in margins[-1].minimum if entry.barrier == "tip_keep_in")
    assert 0.0 < least.clearance < 1e-3


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda p: setattr(p.pose.pose.position, "x", math.nan), "finite coordinates"),
        (lambda p: setattr(p.header, "frame_id", "map"), "'dish'"),
        (lambda p: setattr(p.header, "stamp", stamp(0.9)), "later than"),
    ],
)
def test_a_bad_pose_is_refused_said_and_survived(graph, spoil, words):
    graph.add(ThreadModelNode, initial_shape="straight")
    predicted, diagnostics = graph.listen(topics.PREDICTED_THREAD), graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.NEEDLE_POSE, pose(1.0))
    graph.wait(lambda: len(predicted) == 1, "the start")
    bad = pose(1.1)
    spoil(bad)
    graph.publish(topics.NEEDLE_POSE, bad)
    graph.wait(lambda: any(words in d.status[0].message for d in diagnostics), "a refusal")
    graph.publish(topics.NEEDLE_POSE, pose(1.2))
    graph.wait(lambda: len(predicted) == 2, "the next prediction")
    assert np.isfinite([v.x for v in predicted[1].positions]).all()
    assert predicted[1].interval == pytest.approx(0.2)


def test_an_unproven_solution_gives_no_margin(graph):
    graph.add(ThreadModelNode, initial_shape="straight", residual_tolerance=1e-12)
    margins, predicted = graph.listen(topics.MARGINS), graph.listen(topics.PREDICTED_THREAD)
    graph.publish(topics.NEEDLE_POSE, pose(1.0))
    graph.wait(lambda: len(predicted) == 1, "the start")
    # A leap of half of the dish in a thousandth of a second, onto nothing that can be solved to 1e-12.
    graph.publish(topics.NEEDLE_POSE, pose(1.001, 0.017, 0.013))
    graph.wait(lambda: any(not m.valid for m in margins), "invalid margins")
    invalid = next(m for m in margins if not m.valid)
    assert "residual" in invalid.reason
    assert invalid.contact_state == SafetyMargins.CONTACT_UNKNOWN
    assert not invalid.minimum
    assert len(predicted) == 1
