"""Paths of the needle's body: clear of everything, the right way round, and refused where there is none."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.planner import NeedlePlanner, PlanningError
from magnetosuture_thread.planning.procedure import Procedure, parse_procedure, read_procedure
from magnetosuture_thread.safety import NeedleSafetyFilter
from magnetosuture_thread.safety.motion import NeedleKinematics
from magnetosuture_thread.scene import Dish, Scene, SceneShape
from magnetosuture_thread.setups import Setup

KEEP_OUT = 2.5e-4


def posts(*discs: tuple[float, float, float]) -> Scene:
    """Return a scene of posts in a dish of 35 mm: x, y and radius of each [m]."""
    shapes = tuple(SceneShape(f"post_{k}", "instrument", Disc((x, y), r)) for k, (x, y, r) in enumerate(discs))
    return Scene(Dish(), shapes)


def procedure(*goals: dict[str, Any]) -> Procedure:
    """Return a procedure of some goals."""
    return parse_procedure({"goals": list(goals)}, "test")


def clearance(path: BodyPath, scene: Scene, needle: NeedleKinematics) -> float:
    """Return the least clearance of the needle's axis on a path, by the filter and not by the planner's map [m]."""
    safety = NeedleSafetyFilter(scene, keep_out=KEEP_OUT, needle_length=needle.length)
    headings = np.column_stack([np.cos(path.angles), np.sin(path.angles)])
    tails = path.middles - path.lever * headings
    return min(safety.clearance(tail, heading) for tail, heading in zip(tails, headings, strict=True))


def swept(path: BodyPath, centre: np.ndarray) -> float:
    """Return the angle that a path sweeps about a point [rad]."""
    turns = np.unwrap(np.arctan2(*(path.middles - centre).T[::-1]))
    return float(turns[-1] - turns[0])


def test_the_hernia_repair_is_planned_clear_of_everything(hernia: Setup, planner: NeedlePlanner):
    x, y, heading = hernia.rig.needle_start
    pose = planner.pose(np.array([x, y]), np.array([math.cos(heading), math.sin(heading)]))
    paths = planner.plan_all(read_procedure("hernia"), *pose)
    # In, around and out again on one path; tightening and withdrawing follow.
    assert [len(path.ends) for path in paths] == [4, 1]
    kept = hernia.coils.keep_out
    assert min(clearance(path, hernia.scene, planner.needle) for path in paths) > kept - 5e-6
    inside = paths[0].middles[(paths[0].travel >= paths[0].ends[0]) & (paths[0].travel <= paths[0].ends[1])]
    around = np.unwrap(np.arctan2(*(inside - [0.0, 0.005]).T[::-1]))
    assert around[-1] - around[0] == pytest.approx(-6.2832, abs=0.2)
    # Between ring and tissue, and not around all of it.
    assert np.hypot(*(inside - [0.0, 0.005]).T).max() < 0.0125


@pytest.mark.parametrize("sense", ["clockwise", "counterclockwise"])
@pytest.mark.parametrize("angle", [2.0, 6.5, 9.4])
def test_a_wrap_goes_around_by_its_angle_in_its_sense(sense: str, angle: float):
    scene = posts((0.001, 0.002, 0.002), (0.008, 0.001, 0.0015))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.05)
    goal = {"wrap": {"around": "post_0", "angle": angle, "sense": sense}}
    (path,) = planner.plan_all(procedure(goal), np.array([-0.006, -0.004]), 0.3)
    wanted = angle if sense == "counterclockwise" else -angle
    assert swept(path, np.array([0.001, 0.002])) == pytest.approx(wanted, abs=0.35)
    assert abs(swept(path, np.array([0.008, 0.001]))) < math.pi  # not around the other one
    assert clearance(path, scene, planner.needle) > KEEP_OUT - 5e-6


def test_a_needle_turns_round_in_a_dead_end():
    """Driven in between two rows of posts, and out again."""
    rows = [(x, y, 0.0012) for x in (-0.004, -0.0015, 0.001, 0.0035) for y in (-0.003, 0.003)]
    scene = posts(*rows, (0.0055, 0.0, 0.0012))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.02)
    goals = [{"go_to": {"position": [0.002, 0.0]}}, {"go_to": {"position": [-0.009, 0.0], "heading": [math.pi]}}]
    paths = planner.plan_all(procedure(*goals), np.array([-0.009, 0.0]), 0.0)
    assert paths[-1].middles[-1] == pytest.approx([-0.009, 0.0], abs=6e-4)
    assert math.cos(paths[-1].angles[-1] - math.pi) > math.cos(0.4)
    assert min(clearance(path, scene, planner.needle) for path in paths) > KEEP_OUT - 5e-6


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ({"wrap": {"around": "post_9", "angle": 1.0}}, "goals[0].wrap.around: got 'post_9', expected a shape"),
        ({"wrap": {"around": "post_0", "angle": 30.0}}, "of thread are enough"),
        ({"go_to": {"position": [0.0, 0.002]}}, "around the needle in some direction"),
        ({"go_to": {"position": [0.03, 0.0]}}, "around the needle in some direction"),
        ({"tighten": {"tension": 1e-4, "toward": [0.0, 0.002]}}, "goals[0].tighten.toward"),
        ({"pass_through": {"between": ["post_0", "post_2"], "direction": [1.0, 0.0]}}, "a gap of 0.3"),
        ({"pass_through": {"between": ["post_0", "post_1"], "direction": [0.0, 1.0]}}, "one along a gap between them"),
        ({"pass_through": {"between": ["post_0", "post_1"], "direction": [0.0, 1.0]}}, "as [-1, 0] or [1, 0]"),
        ({"pass_through": {"between": ["post_1", "post_2"], "direction": [0.0, 1.0]}}, "in which no other shape lies"),
        ({"go_to": {"position": [0.0169, 0.0], "heading": [0.0]}}, "around the needle at its heading"),
        (
            {"tighten": {"tension": 2e-4, "toward": [0.012, 0.0]}, "limits": {"tension": 1e-4}},
            "goals[0].tighten.tension: got 0.0002, expected at most the limit of the tension, 0.0001 N",
        ),
    ],
)
def test_what_can_be_known_to_fail_is_refused_before_anything_moves(goal: dict[str, Any], message: str):
    scene = posts((0.0, 0.0, 0.003), (0.0, 0.008, 0.002), (0.0, -0.0053, 0.002))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.05)
    with pytest.raises(ConfigurationError) as caught:
        planner.check(procedure(goal))
    assert message in str(caught.value)


def test_wraps_that_follow_each_other_need_the_thread_of_them_all():
    scene = posts((0.0, 0.0, 0.002), (0.009, 0.0, 0.002))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.03)
    once, back, other = (
        {"wrap": {"around": name, "angle": 8.0, "sense": sense}}
        for name, sense in (("post_0", "clockwise"), ("post_0", "counterclockwise"), ("post_1", "clockwise"))
    )
    planner.check(procedure(once))  # 16 of 30 mm
    planner.check(procedure(once, back, once))
    planner.check(procedure(once, {"go_to": {"position": [0.0, 0.006]}}, once))  # which may have unwound it
    for second in (once, other):
        with pytest.raises(ConfigurationError, match=r"goals\[1\]\.wrap\.angle.*with the wraps before it"):
            planner.check(procedure(once, second))


def test_a_place_behind_a_closed_wall_of_posts_cannot_be_reached():
    count = 14
    ring = [(0.006 * math.cos(a), 0.006 * math.sin(a), 0.0013) for a in np.linspace(0.0, math.tau, count, False)]
    planner = NeedlePlanner(posts(*ring), NeedleKinematics(0.0025), KEEP_OUT, 0.05)
    with pytest.raises(PlanningError, match=r"goals\[0\]: no way for the needle to go_to from 12.0, 0.0 mm"):
        planner.plan_all(procedure({"go_to": {"position": [0.0, 0.0]}}), np.array([0.012, 0.0]), 0.0)
    later: list[dict[str, Any]] = [{"wrap": {"around": "post_0", "angle": 0.1}}, {"go_to": {"position": [0.0, 0.0]}}]
    with pytest.raises(PlanningError, match=r"goals\[1\]: no way for the needle to go_to"):
        planner.plan_all(procedure(*later), np.array([0.012, 0.0]), 0.0)
