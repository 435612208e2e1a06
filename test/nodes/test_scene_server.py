"""The scene server on a graph: what it publishes, what its services change and refuse."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from geometry_msgs.msg import Point
from magnetosuture_msgs.msg import Disc, Outline, Polygon, SceneShape
from magnetosuture_msgs.srv import EditShape, LoadScene, RemoveShape

from magnetosuture_thread.bags.reading import parse_scene_message
from magnetosuture_thread.geometry.scene_files import read_scene, shape_from_mapping, write_scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.scene_server import SceneServerNode
from magnetosuture_thread.settings.interface import Service
from test.geometry.scene.scenes import every_shape

SERVICES = {
    "load": (Service.LOAD_SCENE, LoadScene),
    "add": (Service.ADD_SHAPE, EditShape),
    "replace": (Service.REPLACE_SHAPE, EditShape),
    "remove": (Service.REMOVE_SHAPE, RemoveShape),
}


def pin(name: str = "pin", radius: float = 0.001, **fields: Any) -> SceneShape:
    """Return a disc as a message."""
    disc = Disc(x=0.001, y=0.002, radius=radius)
    return SceneShape(**{"name": name, "kind": SceneShape.KIND_INSTRUMENT, "disc": [disc], **fields})


def corners(*points: tuple[float, float]) -> Outline:
    """Return an outline."""
    return Outline(corners=[Point(x=x, y=y) for x, y in points])


SQUARE = corners((0.002, 0.0), (0.005, 0.0), (0.005, 0.003), (0.002, 0.003))
POST = read_scene("dish_35mm_post")


class Server:
    """A scene server and who listens to it."""

    def __init__(self, graph: Any, **parameters: Any) -> None:
        self.graph = graph
        self.node = graph.add(SceneServerNode, **parameters)
        self.scenes = graph.listen(topics.SCENE)
        self.markers = graph.listen(topics.SCENE_MARKERS)
        self.reports = graph.listen(topics.DIAGNOSTICS)

    def ask(self, name: str, /, **fields: Any) -> Any:
        """Call a service and return its answer."""
        service, kind = SERVICES[name]
        return self.graph.call(kind, service, **fields)

    def change(self, name: str, /, **fields: Any) -> Any:
        """Call a service that shall succeed, and return the scene that is then published."""
        before = len(self.scenes)
        answer = self.ask(name, **fields)
        assert (answer.success, answer.message) == (True, "")
        self.graph.wait(lambda: len(self.scenes) > before, "another scene")
        scene = parse_scene_message(self.scenes[-1])
        assert answer.version == scene.version
        return scene

    def said(self, words: str) -> bool:
        """Return whether it has said so of itself."""
        return any(words in report.status[0].message for report in self.reports)


def test_shapes_are_added_replaced_and_removed_and_scenes_loaded(graph, tmp_path: Path):
    server = Server(graph, scene="dish_35mm_post")
    graph.wait(lambda: bool(server.scenes and server.markers), "the scene")
    shape, wider = ({"disc": {"center": [0.001, 0.002], "radius": r}, "kind": "instrument"} for r in (0.001, 0.002))
    added = POST.add(shape_from_mapping("pin", shape))
    assert server.change("add", shape=pin()) == added
    assert server.change("replace", shape=pin(radius=0.002)) == added.replace(shape_from_mapping("pin", wider))
    square = pin("square", disc=[], polygon=[Polygon(outline=SQUARE)])
    assert len(server.change("add", shape=square).shapes[-1].geometry.outline) == 4
    assert server.change("remove", name="square").names == ("post", "pin")
    write_scene(every_shape(), tmp_path / "lab.geojson")
    assert server.change("load", file=str(tmp_path / "lab.geojson")) == every_shape()
    assert server.change("load", file="dish_35mm_post").version == POST.version
    graph.wait(lambda: len(server.markers) == len(server.scenes) == 7, "as many markers as scenes")


def test_without_a_scene_only_loading_one_is_possible(graph):
    server = Server(graph)
    graph.wait(lambda: server.said("no scene yet"), "its report")
    for name, fields in (("add", {"shape": pin("a")}), ("remove", {"name": "a"})):
        answer = server.ask(name, **fields)
        assert not answer.success
        assert answer.message == (
            "scene: got 'a change of a shape', expected a scene that is loaded first, of which the dish is known"
        )
        assert answer.version == ""
    assert server.scenes == []
    assert server.change("load", file="dish_35mm_post") == POST
    graph.wait(lambda: server.said("dish of 35 mm, 1 shape"), "that all is well")


HOSTILE: list[tuple[str, dict[str, Any], str]] = [
    ("load", {"file": "FIFO"}, "scene: got '"),
    ("load", {"file": "x" * 100_000}, "file: got '100000 characters', expected at most 4096"),
    ("add", {"shape": pin("post")}, "post: got 'a name given twice', expected a name of its own"),
    ("add", {"shape": pin("a", 1.5)}, "a: got 'a shape that covers the whole dish', expected"),
    (
        "add",
        {"shape": pin("a", disc=[], polygon=[Polygon(outline=corners(*[(0.0, 0.0)] * 1501))])},
        "scene.shapes.polygon.corners: got 1501, expected at most 1500",
    ),
    ("replace", {"shape": pin("none")}, "shape.name: got 'none', expected one of post"),
    ("remove", {"name": "x" * 100_000}, "shape.name: got 'xxxxxxxx"),
]


def test_hostile_requests_are_answered_in_one_line_and_change_nothing(graph, tmp_path: Path):
    server = Server(graph, scene="dish_35mm_post")
    graph.wait(lambda: bool(server.scenes), "the scene")
    os.mkfifo(tmp_path / "fifo.yaml")
    for name, fields, words in HOSTILE:
        given = {field: str(tmp_path / "fifo.yaml") if value == "FIFO" else value for field, value in fields.items()}
        answer = server.ask(name, **given)
        assert not answer.success
        assert answer.message.startswith(words), answer.message
        assert len(answer.message) < 600
        assert "\n" not in answer.message
        assert answer.version == POST.version
    graph.wait(lambda: server.said("refused: shape.name: got 'xxx"), "the last refusal on /diagnostics")
    assert server.change("remove", name="post").names == ()
    assert len(server.scenes) == 2
