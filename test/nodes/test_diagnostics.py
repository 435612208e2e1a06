"""What a node says of itself."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

from magnetosuture_thread.errors import InvalidInputError
from magnetosuture_thread.nodes import diagnostics, topics
from magnetosuture_thread.nodes.diagnostics import Health


def test_a_change_is_said_at_once_and_the_state_once_a_second(graph):
    said = graph.listen_later(topics.DIAGNOSTICS)
    health = Health(graph.probe)
    graph.wait(lambda: graph.matched(topics.DIAGNOSTICS), "the match")
    health.ok("all well", speed=3)
    graph.wait(lambda: any(d.status[0].message == "all well" for d in said), "the change")
    count = len(said)
    graph.wait(lambda: len(said) > count, "the next second")
    status = said[-1].status[0]
    assert status.level == DiagnosticStatus.OK
    assert status.name == "probe: state"
    assert {value.key: value.value for value in status.values} == {
        "speed": "3",
        "refused": "0",
        "last refusal": "none",
    }


def test_a_flood_of_refusals_is_counted_and_not_repeated(graph):
    said = graph.listen_later(topics.DIAGNOSTICS)
    health = Health(graph.probe)
    graph.wait(lambda: graph.matched(topics.DIAGNOSTICS), "the match")
    for index in range(1000):
        health.refuse(InvalidInputError("field", index, "something else"))
    graph.wait(
        lambda: any({v.key: v.value for v in d.status[0].values}["refused"] == "1000" for d in said), "the count"
    )
    assert len(said) < 20
    assert said[-1].status[0].level == DiagnosticStatus.WARN


def test_a_change_that_comes_too_soon_is_said_a_moment_later_and_not_lost(graph, monkeypatch):
    monkeypatch.setattr(diagnostics, "PERIOD", 1e6)  # the state of each second would say it too
    said = graph.listen_later(topics.DIAGNOSTICS)
    health = Health(graph.probe)
    graph.wait(lambda: graph.matched(topics.DIAGNOSTICS), "the match")
    for text in ("first", "second", "third"):
        health.warn(text)
    graph.wait(lambda: any(d.status[0].message == "third" for d in said), "the last change")
    assert "second" not in [d.status[0].message for d in said]
