"""Scenes as messages: the same of both libraries, and refused where anything of them is not as it was."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from magnetosuture_msgs.msg import Scene as SceneMessage
from rclpy.serialization import deserialize_message

from magnetosuture_thread.bags import packing, reading
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.geometry.obstacles import Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.settings.errors import InvalidInputError
from magnetosuture_thread.settings.interface import SCENE
from test.geometry.scene.scenes import every_shape
from test.shared import check_refused

LARGE = Polygon(
    tuple((0.01 * np.cos(a), 0.01 * np.sin(a)) for a in np.linspace(0.0, 2.0 * np.pi, 1500, endpoint=False))
)
SCENES = {
    "every shape": every_shape(),
    "hernia_ring": read_scene("hernia_ring"),
    "touching": Scene(Dish(self_contact=True)),
    "large": Scene(Dish(), (SceneShape("large", "tissue", LARGE),)),
}


def sent(scene: Scene) -> SceneMessage:
    """Return a scene as a node gets it."""
    return deserialize_message(packing.packed_scene(7, scene), SceneMessage)


def recorded(scene: Scene) -> Any:
    """Return a scene as a bag gives it."""
    return typestore().deserialize_cdr(packing.packed_scene(7, scene), SCENE.type_name)


@pytest.mark.parametrize("way", [sent, recorded])
@pytest.mark.parametrize("name", SCENES)
def test_a_scene_goes_there_and_back(way: Callable[[Scene], Any], name: str):
    again = reading.parse_scene_message(way(SCENES[name]))
    assert again == SCENES[name]
    assert again.version == SCENES[name].version


def swap_two(message: Any) -> None:
    message.shapes[0], message.shapes[1] = message.shapes[1], message.shapes[0]


def of_one(of: str, value: Any) -> Callable[[Any], None]:
    """Return what sets a field of a message's first disc or dish."""

    def change(message: Any) -> None:
        *path, name = of.split(".")
        part = message
        for step in path:
            part = part[int(step)] if step.isdigit() else getattr(part, step)
        setattr(part, name, value)

    return change


DAMAGE: list[tuple[Callable[[Any], None], str]] = [
    (of_one("shapes.1.polygon.0.outline.corners.3.x", 0.00501), "scene.version: got '"),
    (swap_two, "scene.version: got '"),
    (of_one("version", "x" * 10_000), "scene.version: got 'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx', expected '"),
    (of_one("dish_diameter", float("nan")), "scene.dish.diameter: got nan, expected a number"),
    (of_one("header.frame_id", "map"), "scene.header.frame_id: got 'map', expected 'dish'"),
    (of_one("shapes.0.kind", "bone"), "scene.post.kind: got 'bone', expected one of tissue"),
    (of_one("shapes.0.name", "a\nb"), r"scene.shape.name: got 'a\nb', expected 1 to 64 printable characters"),
    (of_one("shapes.0.disc", []), "scene.shapes[0]: got 0 discs and 0 polygons, expected one disc or one polygon"),
    (of_one("shapes.0.disc.0.radius", float("inf")), "scene.post.disc.radius: got inf, expected a number from"),
    (of_one("shapes.1.polygon.0.outline.corners.5.y", -0.01), "scene.ring.polygon.outline: got 'Self-inter"),
]


@pytest.mark.parametrize(("harm", "words"), DAMAGE, ids=[words for _, words in DAMAGE])
def test_a_damaged_message_is_refused_in_one_line(harm: Callable[[Any], None], words: str):
    message = recorded(every_shape())
    harm(message)
    check_refused(InvalidInputError, lambda: reading.parse_scene_message(message), words, most=400)


def test_more_than_a_scene_may_have_is_refused_before_anything_is_made_of_it():
    message = recorded(every_shape())
    ring = message.shapes[1].polygon[0]
    ring.holes = [ring.holes[0]] * 41
    with pytest.raises(InvalidInputError, match=r"^scene\.shapes\.polygon: got 4\d, expected at most 40$"):
        reading.parse_scene_message(message)
    ring.holes = []
    ring.outline.corners = [ring.outline.corners[0]] * 1501
    with pytest.raises(InvalidInputError, match=r"^scene\.shapes\.polygon\.corners: got \d{4}, expected at most 1500$"):
        reading.parse_scene_message(message)
    message.shapes = [message.shapes[0]] * 201
    with pytest.raises(InvalidInputError, match=r"^scene\.shapes: got 201, expected at most 200$"):
        reading.parse_scene_message(message)
