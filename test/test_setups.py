"""Every setup that ships is valid; what is not is refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.closed_loop import PathControl
from magnetosuture_thread.forecast.forecaster import make_forecaster
from magnetosuture_thread.planning.follower import SmoothPath
from magnetosuture_thread.planning.session import NeedlePlannerSettings
from magnetosuture_thread.rig.closed_loop import ClosedLoop
from magnetosuture_thread.rig.dynamics import NeedleBody
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.files import find_file, share_directory
from magnetosuture_thread.settings.shared_parameters import SHARED_PARAMETERS
from test.shared import known

SHIPPED = sorted(path.stem for path in (share_directory("magnetosuture_thread") / "config").glob("*.yaml"))


@pytest.mark.parametrize("name", SHIPPED)
def test_in_every_setup_that_ships_the_rig_is_what_the_nodes_believe(name: str):
    setup = read_setup(name)
    rig, vision, coils, thread = setup.rig, setup.vision, setup.coils, setup.model.thread()
    assert setup.name == name
    assert thread.segment_length > thread.diameter
    for shared in SHARED_PARAMETERS:
        others = [getattr(other, shared) for other in (vision, setup.model, coils) if hasattr(other, shared)]
        assert not others or not hasattr(rig, shared) or set(others) == {getattr(rig, shared)}
    assert rig.thread_attachment == setup.model.attachment
    rig.check_scene(setup.scene)
    assert (rig.coil_distance, rig.coil_radius) == (coils.coil_distance, coils.coil_radius)
    body = NeedleBody(
        rig.needle_length, rig.needle_width, rig.needle_curvature, rig.needle_magnetisation, rig.viscosity
    )
    assert coils.needle_moment == pytest.approx(body.pole * rig.needle_length, rel=0.01)
    assert coils.needle_turning_drag == pytest.approx(body.drag[2], rel=0.02)
    thread_drag = rig.thread_drag_along * rig.thread_length
    assert coils.needle_drag == pytest.approx(body.drag[0] + thread_drag, rel=0.05)
    field = known(rig.dynamics(setup.scene).field).at(np.zeros(2), np.eye(len(rig.coil_angles))[0])
    assert np.linalg.norm(field) == pytest.approx(coils.field_per_current, rel=0.01)


def test_bridge_planner_and_forecast_keep_the_same_clearance():
    """Else plans lead where the filter stops the needle, and forecasts do not show it."""
    setup = read_setup("hernia_ring")
    coils = setup.coils
    planner = NeedlePlannerSettings(keep_out=coils.keep_out, pose_margin=coils.pose_margin).planner(setup.scene)
    clearance = coils.keep_out + coils.pose_margin
    assert coils.pose_margin > 0.0
    assert coils.safety_filter(setup.scene).keep_out == pytest.approx(clearance)
    assert planner.keep_out == pytest.approx(clearance)
    assert make_forecaster(setup.model, setup.scene).safety.keep_out == pytest.approx(clearance)


@pytest.mark.parametrize("name", SHIPPED)
def test_in_every_setup_that_ships_the_needle_gets_to_the_end_of_its_path_through_the_filter(name: str):
    """The needle moves as the filter lets it: nearly everywhere as commanded, and slowed where it would be too near."""
    setup = read_setup(name)
    safety, follower = setup.coils.safety_filter(setup.scene), setup.follower.follower()
    x, y, angle = setup.rig.needle_start
    tail, heading, time, interval, progress = np.array([x, y]), np.array([np.cos(angle), np.sin(angle)]), 0.0, 0.02, 0.0
    velocity, shares = np.zeros(2), []
    while progress < 1.0:
        command = follower.compute_command(time, tail, heading)
        progress, time = command.progress, time + interval
        assert time < 120.0
        velocity = safety.filter(command.velocity, tail, heading, previous=velocity, elapsed=interval).filtered
        if (speed := float(np.linalg.norm(command.velocity))) > 1e-4:
            shares.append(float(np.linalg.norm(velocity)) / speed)
        tail, heading = safety.kinematics.moved(
            tail, heading, *safety.kinematics.body_velocity(heading, velocity), interval
        )
    assert np.mean(shares) > 0.95, np.mean(shares)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_in_every_setup_that_ships_the_coils_take_the_needle_along_its_path(name: str):
    """In ground truth, with its thread, with poses that come late and get lost, within a quarter of the needle."""
    setup = read_setup(name)
    control = PathControl(setup)
    loop = ClosedLoop(setup, Rig(setup.rig, setup.scene), control, losses=0.1, latency=0.05)
    tips: list[np.ndarray] = []
    while not control.done:
        if frame := loop.step():
            heading = np.array([np.cos(frame.heading), np.sin(frame.heading)])
            tips.append(setup.coils.needle().kinematics.tip(frame.tail, heading))
            assert "follow" not in frame.reason
        assert loop.now < 120.0
    angle = setup.rig.needle_start[2]
    waypoints = np.vstack([tips[0], np.reshape(setup.follower.waypoints, (-1, 2))])
    path = SmoothPath(waypoints, np.array([np.cos(angle), np.sin(angle)]))
    points = np.array([path.point(length) for length in np.arange(0.0, path.length, 1e-4)])
    off = max(np.hypot(*(points - tip).T).min() for tip in tips)
    assert off < 0.25 * setup.coils.needle_length


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ("/**/coil_bridge: {ros__parameters: {needle_length: 0.008}}", "as vision_tracker.needle_length"),
        ("/**/coil_bridge: {ros__parameters: {scene: dish_35mm}}", "'', as vision_tracker.scene"),
    ],
)
def test_two_values_of_what_nodes_share_are_refused(tmp_path: Path, section: str, words: str):
    path = tmp_path / "odd.yaml"
    path.write_text(section + "\n")
    with pytest.raises(ConfigurationError, match=words) as caught:
        read_setup(str(path))
    assert "written once, under /**" in str(caught.value)


def test_what_nodes_share_is_written_once(tmp_path: Path):
    path = tmp_path / "shared.yaml"
    path.write_text(
        "/**: {ros__parameters: {scene: dish_150mm, needle_length: 0.004, needle_curvature: 8, driver_timeout: 0.3}}\n"
        "/**/rig_simulator: {ros__parameters: {needle_width: 0.0006}}\n"  # which may be another than nodes believe
    )
    setup = read_setup(str(path))
    for part in (setup.vision, setup.coils, setup.rig, setup.follower, setup.console):
        assert part.needle_length == 0.004
        assert part.scene == "dish_150mm"
    assert setup.console.needle_curvature == setup.coils.needle_curvature == setup.rig.needle_curvature == 8.0
    assert setup.coils.driver_timeout == setup.rig.driver_timeout == 0.3
    assert (setup.rig.needle_width, setup.coils.needle_width) == (0.0006, 0.0004)
    assert setup.scene.dish.diameter == 0.15


def test_an_unknown_setup_is_refused_with_the_known_ones():
    with pytest.raises(ConfigurationError, match="petri_150mm_silk"):
        find_file("setup", "petri_36mm")
    with pytest.raises(ConfigurationError, match=r"nowhere\.yaml"):
        find_file("setup", "nowhere.yaml")
