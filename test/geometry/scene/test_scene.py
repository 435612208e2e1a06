"""A scene: its version, its changes, its bounds."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.settings.errors import ConfigurationError

POST = SceneShape("post", "instrument", Disc((0.001, 0.002), 0.003))
OUTLINE = ((0.0, 0.0), (0.01, 0.0), (0.0, 0.01))
BLOCK = SceneShape("block", "tissue", Polygon(OUTLINE, (((1e-3, 1e-3), (2e-3, 1e-3), (1e-3, 2e-3)),)))
SCENE = Scene(Dish(0.035, 0.003), (POST, BLOCK))


def altered(shape: SceneShape, **changes: Any) -> Scene:
    """Return the scene with something else of a shape."""
    return Scene(SCENE.dish, tuple(dataclasses.replace(s, **changes) if s is shape else s for s in SCENE.shapes))


def test_any_change_gives_another_version():
    less = 0.002 - 1e-15
    changed = [
        SCENE,
        Scene(Dish(0.035 + 1e-15, 0.003), SCENE.shapes),
        *(Scene(Dish(0.035, 0.003, self_contact=touches), SCENE.shapes) for touches in (True, False)),
        Scene(Dish(0.035, 0.003, wall_friction=0.1), SCENE.shapes),
        altered(POST, friction=0.1),
        Scene(SCENE.dish, (POST,)),
        Scene(SCENE.dish, (BLOCK, POST)),
        altered(POST, kind="wall"),
        altered(POST, geometry=Disc((0.001, less), 0.003)),
        altered(BLOCK, geometry=Polygon(OUTLINE)),
        altered(BLOCK, geometry=Polygon(OUTLINE, (((1e-3, 1e-3), (2e-3, 1e-3), (1e-3, less)),))),
    ]
    versions = [scene.version for scene in changed]
    assert len(set(versions)) == len(versions)


@pytest.mark.parametrize(
    ("geometry", "words"),
    [
        (Disc((0.02, 0.0), 0.002), "it: got 'a shape outside of the dish, 0.018 m from its centre', expected a part"),
        (Polygon(((-0.1, -0.1), (0.1, -0.1), (0.0, 0.2))), "it: got 'a shape that covers the whole dish'"),
        (Disc((0.0, 0.0, 0.0), 0.001), "it.disc.centre: got (0.0, 0.0, 0.0), expected two coordinates"),
    ],
)
def test_a_shape_that_cannot_be_in_the_dish_is_refused(geometry: Disc | Polygon, words: str):
    with pytest.raises(ConfigurationError) as caught:
        Scene(Dish(0.035), (SceneShape("it", "tissue", geometry),))
    assert str(caught.value).startswith(words)


def test_more_shapes_vertices_and_outlines_than_a_bridge_adopts_in_time_are_refused():
    def disc(index: int) -> SceneShape:
        return SceneShape(f"disc {index}", "tissue", Disc((0.0, 0.0), 0.001))

    assert len(Scene(Dish(), tuple(map(disc, range(200)))).shapes) == 200
    with pytest.raises(ConfigurationError, match=r"^shapes: got '201 shapes', expected at most 200$"):
        Scene(Dish(), tuple(map(disc, range(201))))
    comb = [(1e-5 * x, 1e-3 * (x % 2)) for x in range(498)]
    polygon = Polygon(((0.0, -0.001), *comb, (0.00498, -0.001)))
    shapes = tuple(SceneShape(f"comb {i}", "tissue", polygon) for i in range(4))
    assert Scene(Dish(), shapes[:3]).names == ("comb 0", "comb 1", "comb 2")
    with pytest.raises(ConfigurationError, match=r"^shapes: got '2000 vertices', expected at most 1500 in all$"):
        Scene(Dish(), shapes)
    square = Polygon(((0.0, 0.0), (1e-3, 0.0), (1e-3, 1e-3)))
    with pytest.raises(ConfigurationError, match=r"^shapes: got '41 outlines and holes', expected at most 40 in all$"):
        Scene(Dish(), tuple(SceneShape(f"{i}", "tissue", square) for i in range(41)))


def test_an_edge_below_what_contacts_resolve_is_refused():
    def cut(edge: float) -> SceneShape:
        return SceneShape("it", "tissue", Polygon(((0.0, 0.0), (1e-3, 0.0), (1e-3, edge), (0.0, 1e-3))))

    assert cut(2.1e-6).name == "it"
    with pytest.raises(ConfigurationError, match=r"^it\.polygon: got 1\.9e-06, expected edges of at least 2e-06 m$"):
        cut(1.9e-6)


@pytest.mark.parametrize("name", ["", " a", "a\nb", "x" * 65])
def test_a_name_that_cannot_be_printed_is_refused(name: str):
    with pytest.raises(ConfigurationError, match=r"^shape\.name: got .*, expected 1 to 64 printable characters$"):
        SceneShape(name, "tissue", Disc((0.0, 0.0), 0.001))
