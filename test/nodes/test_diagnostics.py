"""What a node says of itself."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus

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
