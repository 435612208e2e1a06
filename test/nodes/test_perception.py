"""Tracker and model in one process."""

from __future__ import annotations

from magnetosuture_thread.nodes.perception import perception
from magnetosuture_thread.nodes.processes import reserved_domain
from test.nodes.conftest import Graph, own_context

SCENE = "dish_35mm"


def test_a_model_that_is_remapped_hears_the_topic_of_its_new_name():
    with reserved_domain() as domain, own_context(domain) as context:
        graph, other = Graph(context, domain), "thread_model:needle/measured_cp:=other/measured_cp"
        made = perception(context=context, cli_args=["--ros-args", "-r", other, "-p", f"scene:={SCENE}"])
        graph.nodes.extend(made)
        heard = {entry.topic_name for entry in made[1].subscriptions}
        graph.close()
    assert {"/other/measured_cp", "/thread/observation"} <= heard
