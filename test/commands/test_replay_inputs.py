"""What a bag is replayed with: its own scene and setup, or those that are asked for."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from magnetosuture_thread.bags.packing import packed_image
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import parse_scene_message
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.commands.live import GraphInput
from magnetosuture_thread.evaluation.recorded import SETUP_NOTE, BagInput, open_bag
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.geometry.scene_files import read_scene
from magnetosuture_thread.settings.errors import BagError, ConfigurationError
from magnetosuture_thread.settings.interface import COMPRESSED_IMAGE, IMAGE, SCENE
from magnetosuture_thread.vision.images import decode_image
from test.bags.bags import changed, scene_message

POST = Scene(Dish(0.035), (SceneShape("post", "instrument", Disc((0.0, 0.01), 0.001)),))
OLD = "vision_tracker: {ros__parameters: {dish_diameter: 0.035}}\nthread_model: {ros__parameters: {length: 0.019}}\n"
OWN = "petri_35mm_polyamide"

Copy = Callable[..., Path]


@pytest.fixture
def copied(short_bag: Path, tmp_path: Path) -> Copy:
    """Makes a copy of a short bag with other notes, and with scenes told at times into it [s] in place of its own."""

    def copy(*scenes: tuple[float, Scene], version: str = "", **notes: str) -> Path:
        begin = Bag(short_bag).start
        times = [begin + round(1e9 * time) for time, _ in scenes]
        told = [(SCENE, at, scene_message(at, scene, version)) for at, (_, scene) in zip(times, scenes, strict=True)]
        own = SCENE.recorded
        return changed(
            short_bag, tmp_path / "copy", lambda old, message: None if old.topic == own else message, told, notes
        )

    return copy


def given(path: Path, setup_name: str = "", start: float = 0.0) -> AbstractContextManager[BagInput]:
    """Open a bag."""
    return open_bag(path, print, setup_name=setup_name, start=start)


def test_the_bags_own_scene_counts_before_that_of_any_setup(copied: Copy):
    path = copied((0.0, POST), setup=OWN)
    for name, expected in (("", OWN), ("petri_150mm_silk", "petri_150mm_silk")):
        with given(path, setup_name=name) as found:
            assert (found.setup.scene, found.setup.name) == (POST, expected)


def test_a_bag_without_a_scene_has_that_of_its_setup(copied: Copy):
    with given(copied(setup="petri_35mm_polyamide_post")) as found:
        assert found.setup.scene == read_scene("dish_35mm_post")


def test_a_damaged_scene_is_refused(copied: Copy):
    path = copied((0.0, POST), version="0123")
    with pytest.raises(BagError, match=r"scene\.version: got '0123', expected"), given(path):
        pass


def test_a_setup_of_an_earlier_version_is_refused_with_what_to_do(copied: Copy):
    path = copied(**{"setup": "mine", SETUP_NOTE: OLD})
    words = r"the bag's own setup: got 'vision_tracker\.dish_diameter', expected .*; name a setup by --setup"
    with pytest.raises(ConfigurationError, match=words), given(path):
        pass
    with given(path, setup_name=OWN) as found:
        assert found.setup.name == OWN


def test_the_scene_is_played_first_and_when_it_changes_and_nodes_begin_in_it(copied: Copy, tmp_path: Path):
    path = copied((0.0, Scene()), (0.4, POST), setup=OWN)
    with given(path, start=0.5) as found:
        playing = GraphInput(found)
        first, *rest = playing.records()
        assert (first.topic, parse_scene_message(first.decode())) == (SCENE.recorded, POST)
        assert first.time == found.begin <= rest[0].time
        arguments = playing.arguments(tmp_path / "qos.yaml")
        assert f"scene:={tmp_path / 'scene.yaml'}" in arguments
        assert read_scene(str(tmp_path / "scene.yaml")) == POST
    with given(path) as found:
        told = [record for record in GraphInput(found).records() if record.topic == SCENE.recorded]
        assert [parse_scene_message(record.decode()) for record in told] == [Scene(), POST]
        assert told[1].time == pytest.approx(found.begin + 4e8, abs=1e8)


def test_raw_frames_are_played_as_such_whatever_the_setup_says(short_bag: Path, tmp_path: Path):
    """A bag that names no setup gets the default."""
    with BagWriter(tmp_path / "raw") as writer:
        writer.add_topic(IMAGE.recorded, IMAGE.type_name)
        for record in Bag(short_bag).records({COMPRESSED_IMAGE.recorded}):
            pixels = decode_image(record.decode().data)
            writer.write(IMAGE.recorded, record.time, packed_image(record.time, pixels))
    logged: list[str] = []
    with open_bag(tmp_path / "raw", logged.append) as found:
        playing = GraphInput(found)
        assert "vision_tracker:image_transport:=raw" in playing.arguments(tmp_path / "qos.yaml")
        assert playing.channels == [SCENE, IMAGE]
    assert any(line.startswith(f"the bag names no setup; taking {OWN}") for line in logged)
