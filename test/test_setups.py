"""Every set-up that ships is valid; what is not is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.resources import setup_file, share
from magnetosuture_thread.setups import read_setup

SHIPPED = sorted(path.stem for path in (share("magnetosuture_thread") / "config").glob("*.yaml"))


def test_there_are_setups():
    assert "petri_35mm_polyamide" in SHIPPED


@pytest.mark.parametrize("name", SHIPPED)
def test_every_setup_that_ships_loads(name: str):
    setup = read_setup(name)
    assert setup.name == name
    assert setup.vision.thread_length == setup.model.length
    assert setup.model.thread().segment_length > setup.model.thread().diameter


@pytest.mark.parametrize("name", SHIPPED)
def test_in_every_setup_that_ships_the_rig_is_what_the_nodes_believe(name: str):
    setup = read_setup(name)
    rig, vision, coils = setup.rig, setup.vision, setup.coils
    assert (rig.dish_diameter, rig.needle_length, rig.needle_width) == (
        vision.dish_diameter,
        vision.needle_length,
        vision.needle_width,
    )
    assert (rig.thread_length, rig.thread_attachment) == (setup.model.length, setup.model.attachment)
    assert (rig.disc_obstacles, rig.polygon_obstacles) == (setup.model.disc_obstacles, setup.model.polygon_obstacles)
    assert (rig.coil_angles, rig.coil_distance, rig.coil_radius) == (
        coils.coil_angles,
        coils.coil_distance,
        coils.coil_radius,
    )
    body = rig.dynamics().needle
    assert coils.needle_moment == pytest.approx(body.pole * rig.needle_length, rel=0.01)
    assert coils.needle_turning_drag == pytest.approx(body.drag[2], rel=0.02)
    thread_drag = rig.thread_drag_along * rig.thread_length
    assert coils.needle_drag == pytest.approx(body.drag[0] + thread_drag, rel=0.05)
    coil = rig.field().per_current(np.zeros((1, 3)))[0, 0]
    assert np.linalg.norm(coil) == pytest.approx(coils.field_per_current, rel=0.01)


@pytest.mark.parametrize("name", SHIPPED)
def test_in_every_setup_that_ships_the_path_keeps_clear_of_wall_and_obstacles(name: str):
    """The needle follows its path as the bridge has it move, and nothing is taken off any velocity."""
    setup = read_setup(name)
    workspace, needle, follower = setup.coils.workspace(), setup.coils.needle(), setup.follower.follower()
    x, y, angle = setup.rig.needle_start
    tail, heading, time, interval, progress = np.array([x, y]), np.array([np.cos(angle), np.sin(angle)]), 0.0, 0.02, 0.0
    while progress < 1.0:
        wish = follower.follow(time, tail, heading)
        progress, time = wish.progress, time + interval
        assert time < 120.0
        assert workspace.safe_velocity(wish.velocity, tail, heading).tolist() == wish.velocity.tolist()
        e = needle.chord_direction(heading)
        turned = float(wish.velocity @ (-e[1], e[0])) / (0.5 * needle.chord) * interval
        turn = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
        middle = tail + 0.5 * needle.chord * e + float(wish.velocity @ e) * interval * e
        heading, tail = turn @ heading, middle - 0.5 * needle.chord * (turn @ e)


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ("coil_bridge: {ros__parameters: {needle_length: 0.008}}", "as vision_tracker.needle_length"),
        ("path_follower: {ros__parameters: {needle_length: 0.008}}", "as vision_tracker.needle_length"),
        ("path_follower: {ros__parameters: {waypoints: [0.0, 0.0, 0.0335, 0.001]}}", "within the dish, 0.0175 m"),
        ("path_follower: {ros__parameters: {needle_curvature: 8.0}}", "as coil_bridge.needle_curvature"),
        ("coil_bridge: {ros__parameters: {dish_diameter: 0.05}}", "as vision_tracker.dish_diameter"),
        ("console: {ros__parameters: {dish_diameter: 0.05}}", "as vision_tracker.dish_diameter"),
        ("console: {ros__parameters: {needle_length: 0.008}}", "as vision_tracker.needle_length"),
        ("console: {ros__parameters: {needle_curvature: 8.0}}", "as coil_bridge.needle_curvature"),
        ("coil_bridge: {ros__parameters: {disc_obstacles: [0.0, 0.0, 0.002]}}", "as thread_model.disc_obstacles"),
        ("thread_model: {ros__parameters: {disc_obstacles: [0.0, 0.0, 0.002]}}", "as thread_model.disc_obstacles"),
        (
            "coil_bridge: {ros__parameters: {polygon_obstacles: [0.0, 0.0, 0.01, 0.0, 0.0, 0.01], polygon_sizes: [3]}}",
            "as thread_model.polygon_obstacles",
        ),
    ],
)
def test_sections_that_contradict_each_other_are_refused(tmp_path: Path, section: str, words: str):
    path = tmp_path / "odd.yaml"
    path.write_text(section + "\n")
    with pytest.raises(ConfigurationError, match=words):
        read_setup(str(path))


@pytest.mark.parametrize("section", ["", "console: {ros__parameters: {port: 0}}"])
def test_the_page_shows_the_dish_and_the_needle_of_the_others_where_it_is_not_told(tmp_path: Path, section: str):
    """As in set-ups, and in bags, from before there was a page."""
    path = tmp_path / "before.yaml"
    length = "needle_length: 0.004"
    path.write_text(
        f"vision_tracker: {{ros__parameters: {{dish_diameter: 0.05, {length}}}}}\n"
        f"coil_bridge: {{ros__parameters: {{dish_diameter: 0.05, {length}, needle_curvature: 8.0}}}}\n"
        f"path_follower: {{ros__parameters: {{{length}, needle_curvature: 8.0}}}}\n{section}\n"
    )
    page = read_setup(str(path)).console
    assert (page.dish_diameter, page.needle_length, page.needle_curvature) == (0.05, 0.004, 8.0)
    assert page.port == (0 if section else 8090)


def test_a_setup_is_found_by_path(tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text("thread_model: {ros__parameters: {segments: 30}}\n")
    assert read_setup(str(path)).model.segments == 30


def test_a_dish_in_millimetres_is_refused(tmp_path: Path):
    path = tmp_path / "millimetres.yaml"
    path.write_text("vision_tracker: {ros__parameters: {dish_diameter: 35.0}}\n")
    with pytest.raises(ConfigurationError) as caught:
        read_setup(str(path))
    assert str(caught.value) == (
        f"{path}: vision_tracker.dish_diameter: got 35.0, expected a number from 0.005 to 0.5 m"
    )


def test_an_unknown_setup_is_refused_with_the_known_ones():
    with pytest.raises(ConfigurationError, match="petri_150mm_silk"):
        setup_file("petri_36mm")
    with pytest.raises(ConfigurationError, match=r"nowhere\.yaml"):
        setup_file("nowhere.yaml")


def test_thread_and_obstacle_must_make_sense(tmp_path: Path):
    for text, words in (
        ("segments: 2000, length: 0.019", "so that a segment is longer than thick"),
        ("disc_obstacles: [0.0, 0.0, -0.001]", "half of a segment"),
        ("disc_obstacles: [0.0, 0.0, 0.0003]", "half of a segment"),
        ("viscosity: 1000.0", "from 0.0001 to 100 Pa s"),
        ("length: 0.03", "vision_tracker.thread_length: got 0.019, expected 0.03, as thread_model.length"),
    ):
        path = tmp_path / "odd.yaml"
        path.write_text(f"thread_model: {{ros__parameters: {{{text}}}}}\n")
        with pytest.raises(ConfigurationError, match=words):
            read_setup(str(path))
