"""What a node says of itself."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

from magnetosuture_thread.nodes import node as diagnostics
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.node import Health
from magnetosuture_thread.settings.errors import InvalidInputError


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
    assert said[-1].status[0].hardware_id == (graph.probe.get_namespace().strip("/") or "magnetosuture")


def test_that_a_node_stands_by_is_reported_at_once_as_a_warning_whatever_else_there_is(graph, monkeypatch):
    monkeypatch.setattr(diagnostics, "PERIOD", 1e6)  # the state of each second would say it too
    said = graph.listen_later(topics.DIAGNOSTICS)
    health = Health(graph.probe)
    graph.wait(lambda: graph.matched(topics.DIAGNOSTICS), "the match")

    def last() -> tuple[bytes, str]:
        return (said[-1].status[0].level, said[-1].status[0].message) if said else (b"", "")

    health.ok("all well")
    graph.wait(lambda: last() == (DiagnosticStatus.OK, "all well"), "the state")
    health.stand_by("inactive")
    graph.wait(lambda: last() == (DiagnosticStatus.WARN, "inactive"), "the report")
    health.error("broken")
    health.stand_by("x" * 100_000)
    graph.wait(lambda: last()[1].startswith("xxx"), "the report")
    assert len(last()[1]) <= diagnostics.MAX_REASON_CHARS
    health.stand_by("")
    graph.wait(lambda: last() == (DiagnosticStatus.ERROR, "broken"), "the state of meanwhile")
