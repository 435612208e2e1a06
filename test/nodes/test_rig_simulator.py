"""The rig simulator in a graph."""

from __future__ import annotations

import pytest
from magnetosuture_msgs.msg import CoilCurrents
from std_msgs.msg import String

from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.rig_simulator import RigSimulatorNode
from magnetosuture_thread.rig.dynamics import RigDynamics
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.settings.errors import SolverError
from test.nodes import wire

SMALL = {"scene": "dish_35mm", "thread_segments": 12, "needle_start": [0.003, 0.0, 0.0]}


def currents(graph, *values: float) -> CoilCurrents:
    """Return currents from now on."""
    message = CoilCurrents(current=[float(value) for value in values])
    message.header = wire.header(graph.now())
    return message


def nanoseconds(stamp) -> int:
    """Return a stamp as a number."""
    return stamp.sec * 10**9 + stamp.nanosec


def test_the_thread_is_held_until_there_is_a_model_that_follows_it(graph):
    threads = graph.listen_later(topics.GROUND_TRUTH_THREAD)
    graph.add(RigSimulatorNode, **SMALL, thread_start_curvature=-60.0)
    graph.wait(lambda: len(threads) > 3, "frames")
    places = [
        [(pose.pose.position.x, pose.pose.position.y) for pose in thread.poses] for thread in (threads[0], threads[-1])
    ]
    assert places[0] == places[1]
    graph.probe.create_publisher(topics.PREDICTED_THREAD.message, topics.PREDICTED_THREAD.name, 1)
    graph.wait(lambda: threads[-1].poses[-1] != threads[0].poses[-1], "the thread's end to move")


def refusals(diagnostics) -> list[str]:
    """Return what was refused."""
    values = [value for array in diagnostics for value in array.status[0].values]
    return [value.value for value in values if value.key == "last refusal" and value.value != "none"]


def test_where_the_simulation_fails_the_coils_go_off_and_it_is_said(graph, monkeypatch):
    node = graph.add(RigSimulatorNode, **SMALL)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.RIG_CURRENTS, currents(graph, 3, 0, 0, 0))
    graph.wait(lambda: node.rig.running > 0.0, "the currents")

    def fail(*_: object, **__: object) -> None:
        raise SolverError("rig", "no convergence", 1.0, 1e-8)

    monkeypatch.setattr(node.rig, "look", fail)
    graph.wait(lambda: any("no convergence" in d.status[0].message for d in diagnostics), "the error")
    assert node.rig.currents.tolist() == [0.0] * 4


@pytest.mark.parametrize("simulated", [False, True])
def test_a_rig_that_is_too_slow_lags_and_says_so_while_frames_go_on(graph, monkeypatch, simulated: bool):
    """A needle that is wedged moves by a tenth of the time; no callback makes up for what was missed before."""
    needles, clocks = graph.listen_later(topics.GROUND_TRUTH_NEEDLE), graph.listen_later(topics.CLOCK)
    spans: list[float] = []

    def move(dynamics: RigDynamics, currents: object, dt: float, most: float) -> float:
        spans.append(dt)
        return 0.1 * dt

    monkeypatch.setattr(RigDynamics, "step", move)
    monkeypatch.setattr(Rig, "warm_up", lambda made: None)
    node = graph.add(RigSimulatorNode, use_sim_time=simulated, **SMALL)
    diagnostics = graph.listen(topics.DIAGNOSTICS)

    def late() -> bool:
        graph.publish(topics.RIG_CURRENTS, currents(graph, 1, 0, 0, 0))
        texts = [d.status[0].message for d in diagnostics]
        return any("late: simulated time runs at" in text for text in texts) and len(needles) > 20

    graph.wait(late, "the lag to be reported", timeout=30.0)
    assert 0.0 < max(spans) < 0.1 + 1e-9
    values = {value.key: value.value for value in diagnostics[-1].status[0].values}
    assert float(values["lag [s]"]) > 0.0
    assert float(values["real_time_factor"]) < 0.9
    stamps = [nanoseconds(message.header.stamp) for message in needles]
    assert stamps == sorted(stamps)
    times = [nanoseconds(message.clock) for message in clocks]
    assert times == sorted(times)
    if simulated:  # the clock waits for the rig
        assert times[-1] < node._stamp(node.rig.time) + 0.2e9
    else:  # what is shown is of now
        assert abs(stamps[-1] - node.get_clock().now().nanoseconds) < 5e9


def test_a_fault_can_be_asked_for_now(graph):
    node = graph.add(RigSimulatorNode, **SMALL)
    diagnostics = graph.listen(topics.DIAGNOSTICS)
    graph.publish(topics.RIG_CURRENTS, currents(graph, 0.01, 0, 0, 0))
    graph.publish(topics.FAULT_REQUEST, String(data="glare 60"))
    graph.wait(lambda: any("with glare" in d.status[0].message for d in diagnostics), "the fault")
    graph.publish(topics.FAULT_REQUEST, String(data="sunshine 60"))
    graph.wait(lambda: any("expected KIND DURATION" in text for text in refusals(diagnostics)), "a refusal")
    assert [fault.kind for fault in node.rig.faults.faults] == ["glare"]
