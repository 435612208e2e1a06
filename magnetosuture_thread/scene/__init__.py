"""The scene: the dish and the named shapes in it, as every node knows them."""

from magnetosuture_thread.scene.checks import WALL_NAME, find_collision
from magnetosuture_thread.scene.files import read_scene, write_scene
from magnetosuture_thread.scene.scene import KINDS, Dish, Scene, SceneShape
from magnetosuture_thread.scene.shapes import SHAPES, scene_from_mapping, scene_to_mapping, shape_from_mapping

__all__ = [
    "KINDS",
    "SHAPES",
    "WALL_NAME",
    "Dish",
    "Scene",
    "SceneShape",
    "find_collision",
    "read_scene",
    "scene_from_mapping",
    "scene_to_mapping",
    "shape_from_mapping",
    "write_scene",
]
