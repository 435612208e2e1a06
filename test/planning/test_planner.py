"""Paths of the needle's body: clear of everything, the right way round, and refused where there is none."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
import shapely

from magnetosuture_thread.coils.filter import NeedleSafetyFilter
from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.planner import NeedlePlanner, PlanningError
from magnetosuture_thread.planning.procedure import Procedure, parse_procedure
from magnetosuture_thread.settings.errors import ConfigurationError

KEEP_OUT = 2.5e-4


def posts(*discs: tuple[float, float, float]) -> Scene:
    """Return a scene of posts in a dish of 35 mm: x, y and radius of each [m]."""
    return Scene.create(shapes={f"post_{k}": Disc((x, y), r) for k, (x, y, r) in enumerate(discs)})


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
    """Return the angle that the needle's tail, which leads the thread, sweeps about a point [rad]."""
    tails = path.middles - path.lever * np.column_stack([np.cos(path.angles), np.sin(path.angles)])
    turns = np.unwrap(np.arctan2(*(tails - centre).T[::-1]))
    return float(turns[-1] - turns[0])


def net_crossings(path: BodyPath, line: list[tuple[float, float]], first: float = 0.0, last: float = math.inf) -> int:
    """Return how often the middle crosses a line from right to left, less the other way round, between two ways."""
    points = path.middles[(path.travel >= first) & (path.travel <= last)]
    (ax, ay), (bx, by) = line
    count = 0
    for before, after in itertools.pairwise(points):
        step = shapely.LineString([before, after])
        if step.crosses(shapely.LineString(line)):
            count += 1 if (bx - ax) * (after[1] - ay) > (by - ay) * (after[0] - ax) else -1
    return count


@pytest.mark.parametrize("sense", ["clockwise", "counterclockwise"])
@pytest.mark.parametrize("angle", [2.0, 6.5, 9.4])
def test_a_wrap_goes_around_by_its_angle_in_its_sense(sense: str, angle: float):
    scene = posts((0.001, 0.002, 0.002), (0.008, 0.001, 0.0015))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.05)
    goal = {"wrap": {"around": "post_0", "angle": angle, "sense": sense}}
    (path,) = planner.plan_all(procedure(goal), np.array([-0.006, -0.004]), 0.3)
    wanted = angle if sense == "counterclockwise" else -angle
    about = swept(path, np.array([0.001, 0.002]))
    assert abs(wanted) <= abs(about) < abs(wanted) + 0.35
    assert about * wanted > 0.0
    assert abs(swept(path, np.array([0.008, 0.001]))) < math.pi  # not around the other one
    assert clearance(path, scene, planner.needle) > KEEP_OUT - 5e-6


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ({"wrap": {"around": "post_9", "angle": 1.0}}, "goals[0].wrap.around: got 'post_9', expected a shape"),
        ({"go_to": {"position": [0.0, 0.002]}}, "around the needle in some direction"),
        ({"tighten": {"tension": 1e-4, "toward": [0.012, 0.0]}}, "expected a wrap before, as else there is nothing"),
        ({"wrap": {"around": "post_0", "angle": 45.0}}, "degrees? 45 degrees are 0.7854 rad"),
        ({"pass_through": {"between": ["post_0", "post_2"], "direction": [1.0, 0.0]}}, "a gap of 0.3"),
        ({"pass_through": {"between": ["post_0", "post_1"], "direction": [0.0, 1.0]}}, "as [-1, 0] or [1, 0]"),
        ({"pass_through": {"between": ["post_1", "fence"], "direction": [1.0, 0.0]}}, "got 'fence', expected a shape"),
        ({"go_to": {"position": [0.0169, 0.0], "heading": [0.0]}}, "around the needle at its heading"),
    ],
)
def test_what_can_be_known_to_fail_is_refused_before_anything_moves(goal: dict[str, Any], message: str):
    scene = posts((0.0, 0.0, 0.003), (0.0, 0.008, 0.002), (0.0, -0.0053, 0.002))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.05)
    with pytest.raises(ConfigurationError) as caught:
        planner.check(procedure(goal))
    assert message in str(caught.value)


def test_the_wraps_of_a_procedure_need_the_thread_of_them_all():
    scene = posts((0.0, 0.0, 0.002), (0.009, 0.0, 0.002))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.03)
    once, back, other = (
        {"wrap": {"around": name, "angle": 8.0, "sense": sense}}
        for name, sense in (("post_0", "clockwise"), ("post_0", "counterclockwise"), ("post_1", "clockwise"))
    )
    place = {"go_to": {"position": [0.0, 0.006]}}
    planner.check(procedure(once))  # 16 of 30 mm
    planner.check(procedure(once, other))  # 10 mm around each, which half a turn is passed by, and 5 mm between
    for goals in ((once, once), (once, place, once), (once, other, once)):
        with pytest.raises(ConfigurationError, match=r"mm of thread with the wraps before.*30 mm of thread"):
            planner.check(procedure(*goals))
    with pytest.raises(ConfigurationError, match=r"goals\[2\]\.wrap\.sense.*expected clockwise, as post_0 is wrapped"):
        planner.check(procedure(once, place, back))


@pytest.mark.parametrize(
    ("tighten", "message"),
    [
        ({"tension": 1e-4, "toward": [0.0, 0.002]}, "goals[1].tighten.toward"),
        ({"clearance": 1e-3, "around": "post_1", "toward": [0.012, 0.0]}, "expected a wrap around post_1 before"),
        ({"tension": 1e-4, "toward": [-0.016, 0.0]}, "a place within 5.25 mm of post_0, which the thread reaches"),
        ({"tension": 2e-4, "toward": [0.0, 0.006]}, "goals[1].tighten.tension: got 0.0002, expected at most the limit"),
    ],
)
def test_a_thread_is_tightened_around_what_it_is_wrapped_around_and_within_its_length(
    tighten: dict[str, Any], message: str
):
    scene = posts((0.0, 0.0, 0.002), (0.009, 0.0, 0.002))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.02)
    goals: list[dict[str, Any]] = [{"wrap": {"around": "post_0", "angle": 8.0}}]
    planner.check(procedure(*goals, {"tighten": {"tension": 1e-4, "toward": [0.0, 0.006]}}))
    with pytest.raises(ConfigurationError) as caught:
        planner.check(procedure(*goals, {"tighten": tighten, "limits": {"tension": 1e-4}}))
    assert message in str(caught.value)


def test_slits_that_are_passed_in_the_same_direction_are_each_crossed_and_none_is_undone():
    """Between one pass and the next the needle comes back around the ends of the row, not through a slit."""
    scene = posts(*[(x, 0.0, 0.002) for x in (-0.009, -0.003, 0.003, 0.009)])
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.05)
    between = [(f"post_{k}", f"post_{k + 1}") for k in range(3)]
    goals = [{"pass_through": {"between": list(pair), "direction": [0.0, 1.0]}} for pair in between]
    (path,) = planner.plan_all(procedure(*goals), np.array([-0.006, -0.006]), 1.5)
    for k, end in enumerate(path.ends):
        line = [(6e-3 * k - 0.007, 0.0), (6e-3 * k - 0.005, 0.0)]  # from post to post, passed upwards to its left
        before = path.ends[k - 1] if k else 0.0
        assert net_crossings(path, line, before, end) == 1
        assert net_crossings(path, line) == 1
    assert clearance(path, scene, planner.needle) > KEEP_OUT - 5e-6


@pytest.mark.slow
def test_a_shape_that_is_hidden_behind_another_is_wrapped_and_one_is_not_from_inside_of_it():
    planner = NeedlePlanner(posts((0.006, 0.0, 0.002), (0.0, 0.0, 0.003)), NeedleKinematics(0.0025), KEEP_OUT, 0.05)
    goal = {"wrap": {"around": "post_0", "angle": 6.0}}
    (path,) = planner.plan_all(procedure(goal), np.array([-0.006, 0.0]), 0.0)
    assert swept(path, np.array([0.006, 0.0])) > 6.0
    ring = [(0.007 * math.cos(a), 0.007 * math.sin(a)) for a in np.linspace(0.0, math.tau, 64, False)]
    hole = [(0.005 * math.cos(a), 0.005 * math.sin(a)) for a in np.linspace(math.tau, 0.0, 64, False)]
    shape = SceneShape("ring", "tissue", Polygon(tuple(ring), (tuple(hole),)))
    planner = NeedlePlanner(Scene(Dish(), (shape,)), NeedleKinematics(0.0025), KEEP_OUT, 0.1)
    with pytest.raises(PlanningError, match="no way for the needle to wrap"):
        planner.plan_all(procedure({"wrap": {"around": "ring", "angle": 6.0}}), np.array([0.001, 0.0]), 0.0)


def test_a_bar_is_wrapped_by_less_thread_than_a_disc_of_its_girth():
    """A straight thread of 12 mm beside a bar of 18 mm winds about its middle by 2.9 rad."""
    outline = ((-0.009, -0.0005), (0.009, -0.0005), (0.009, 0.0005), (-0.009, 0.0005))
    scene = Scene(Dish(), (SceneShape("bar", "tissue", Polygon(outline)),))
    planner = NeedlePlanner(scene, NeedleKinematics(0.0025), KEEP_OUT, 0.012)
    planner.check(procedure({"wrap": {"around": "bar", "angle": 2.2}}))
    with pytest.raises(ConfigurationError, match="mm of thread"):
        planner.check(procedure({"wrap": {"around": "bar", "angle": 6.4}}))
