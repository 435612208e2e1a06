"""A session: what waits, what time set back does, friction, the needle's motion, and how other settings take over."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import NeedleMotionFilter, PredictionResult, ThreadSession
from magnetosuture_thread.forecast.forecaster import make_forecaster
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings.configuration import from_mapping
from magnetosuture_thread.thread.margins import Friction, FrictionState
from magnetosuture_thread.thread.prediction import NeedlePose, Prediction
from test.shared import known, run_python
from test.thread.worlds import polygon, scene_with

EAST = np.array([1.0, 0.0])
SECOND = 1_000_000_000


def made(**values: Any) -> ThreadModelSettings:
    """Return settings from what a setup file would hold."""
    return from_mapping(ThreadModelSettings, values)


def straight(scene: Scene | None = None, **values: Any) -> ThreadSession:
    """Return a session that needs no camera."""
    return ThreadSession(made(initial_shape="straight", **values), scene)


def pose(stamp: int, x: float = 0.0, y: float = 0.0, angle: float = 0.0) -> NeedlePose:
    """Return a needle pose at a stamp [ns]."""
    return NeedlePose(stamp * 1e-9, np.array([x, y]), np.array([np.cos(angle), np.sin(angle)]))


def go(session: ThreadSession, stamp: float, x: float = 0.0, y: float = 0.0, angle: float = 0.0) -> PredictionResult:
    """Show a session a pose at a stamp [s]."""
    at = round(stamp * SECOND)
    return session.on_pose(at, pose(at, x, y, angle))


def predicted(outcome: PredictionResult) -> Prediction:
    """Return the prediction that there must be."""
    assert outcome.problem is None
    return known(outcome.prediction)


def seen(x: float = 0.0, y: float = 0.0) -> Points:
    """Return a thread that lies straight behind a needle that points east."""
    return np.column_stack([x - np.linspace(0.0, 0.019, 60), np.full(60, y)])


def on_a_curve(session: ThreadSession, first: int, last: int) -> list[PredictionResult]:
    """Return what comes of a needle that is driven in a curve, at 30 Hz."""
    turns = np.arange(first, last) / 40.0
    return [go(session, 1.0 + 4.0 / 3.0 * k, 0.01 * np.sin(k), 0.01 - 0.01 * np.cos(k), k) for k in turns]


@pytest.mark.parametrize("values", [{}, {"thread_length": 0.15, "segments": 60}])
@pytest.mark.parametrize("depth", [2e-5, 3e-3])
def test_a_scene_without_room_for_the_thread_keeps_no_kernel_from_being_loaded(values: dict[str, Any], depth: float):
    square = polygon(-4e-3, -4e-3, 4e-3, -4e-3, 4e-3, 4e-3, -4e-3, 4e-3)
    scene = scene_with(square, Disc((-8e-3, 0.0), 2e-3), diameter=0.022)
    scene = replace(scene, dish=replace(scene.dish, depth=depth))
    assert ThreadSession(made(**values), scene).scene is scene
    make_forecaster(made(**values), scene).warm_up()


def test_a_pose_waits_for_the_thread_of_its_frame():
    session = ThreadSession(made(), None)
    assert [go(session, 1.0 + 0.1 * k, 1e-4 * k).waiting for k in range(4)] == [True] * 4
    # The first frame's thread was never seen.
    found = list(session.on_measured_thread(1_100_000_000, seen(1e-4)))
    assert [outcome.stamp for outcome in found] == [1_100_000_000, 1_200_000_000, 1_300_000_000]
    assert [predicted(outcome).status for outcome in found] == ["started", "solved", "solved"]
    assert predicted(go(session, 1.4, 4e-4)).interval == pytest.approx(0.1)


def test_time_set_back_starts_anew():
    session = ThreadSession(made(), None)
    session.on_measured_thread(100 * SECOND, seen())
    go(session, 100.0)
    go(session, 100.1)
    assert go(session, 1.0).waiting  # for a thread of that time
    assert [predicted(outcome).status for outcome in session.on_measured_thread(SECOND, seen())] == ["started"]
    assert predicted(go(session, 1.1)).interval == pytest.approx(0.1)


@pytest.mark.parametrize("stamp", [-(2**31) * SECOND, (2**31 - 1) * SECOND + SECOND - 1, 0])
def test_any_stamp_that_a_message_can_hold_is_taken(stamp: int):
    session = straight()
    assert session.on_pose(stamp, pose(stamp)).stamp == stamp
    assert predicted(session.on_pose(stamp + SECOND, pose(stamp + SECOND))).interval == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("attachment", ["pinned", "clamped"])
@pytest.mark.parametrize("offset", [[-2e-3, 0.0], [0.01, 0.01]])
def test_the_thread_hangs_where_it_is_fixed(offset: list[float], attachment: str):
    session = straight(attachment_offset=offset, attachment=attachment)
    for k in range(20):
        angle = 0.02 * k
        prediction = predicted(go(session, 1.0 + k / 30.0, 1e-4 * k, 0.0, angle))
        along, left = offset
        e = np.array([np.cos(angle), np.sin(angle)])
        expected = 1e-4 * k * EAST + along * e + left * np.array([-e[1], e[0]])
        np.testing.assert_allclose(prediction.positions[0], expected, atol=1e-12)
    assert np.abs(prediction.strain).max() < 1e-3


@pytest.mark.parametrize(
    "begin",
    [2e-3, -2e-3],  # in front of the tail, what is between them is covered; behind it, it belongs to the needle
)
def test_a_seen_thread_begins_where_it_is_fixed(begin: float):
    session = ThreadSession(made(attachment_offset=[begin, 0.0]), None)
    go(session, 1.0)
    prediction = predicted(next(iter(session.on_measured_thread(SECOND, seen()))))
    np.testing.assert_allclose(prediction.positions[0], [begin, 0.0], atol=1e-12)
    np.testing.assert_allclose(prediction.positions[-1], [begin - 0.019, 0.0], atol=1e-9)


@pytest.mark.parametrize("formulation", ["rod", "paper"])
def test_a_dish_that_gets_smaller_takes_the_thread_in(formulation: str):
    session = straight(scene_with(), formulation=formulation, attachment="clamped")
    go(session, 1.0, x=0.007, angle=0.2)
    session.change(session.settings, scene_with(diameter=0.02))
    outcomes = [go(session, 1.0 + k / 30.0, x=0.007, angle=0.2) for k in range(1, 20)]
    last = predicted(outcomes[-1])
    away = np.linalg.norm(last.positions[1:], axis=1).max()
    assert away < 0.01 - 30e-6 + 1e-6
    assert formulation == "paper" or away > 0.0099  # in which a thread that is pushed shrinks instead
    assert formulation == "paper" or known(outcomes[-1].margins).in_contact


@pytest.mark.parametrize("formulation", ["rod", "paper"])
@pytest.mark.parametrize(
    ("offsets", "leaves"),
    [
        ([(0.0, 0.0)], True),  # of posts of 0.6 mm from the node
        ([(0.0, 4e-4), (0.0, -4e-4)], False),  # in both at once, each pushes it into the other
        ([(3e-4 * np.cos(k), 3e-4 * np.sin(k)) for k in range(7)], True),  # more shapes than it has friction with
    ],
)
def test_shapes_that_appear_around_a_moving_node_are_resolved_or_reported(
    formulation: str, offsets: list[tuple[float, float]], leaves: bool
):
    """No step hangs or raises, and no margins are given of a thread of which a node is still inside."""
    session = straight(formulation=formulation)
    node = predicted(on_a_curve(session, 0, 30)[-1]).positions[12]
    posts = [Disc(tuple(node + offset), 6e-4) for offset in offsets]
    session.change(session.settings, scene_with(*posts))
    given = []
    for outcome in on_a_curve(session, 30, 45):
        given.append(outcome.margins is not None)
        if outcome.margins is None:
            assert outcome.reason
            continue
        nodes = predicted(outcome).positions[1:]
        least = min(float(np.linalg.norm(nodes - post.centre, axis=1).min()) - post.radius for post in posts) - 30e-6
        assert least > -1e-6
        assert outcome.margins["obstacle"].minimum_clearance <= least + 1e-12
    assert sum(given) > 10 if leaves else sum(given) < 5


def test_no_kernel_is_compiled_by_a_change():
    """In a process of its own: in this one others have compiled what they need."""
    code = """
import gc
import numpy as np
from numba.core.registry import CPUDispatcher
from magnetosuture_thread import Disc, NeedlePose, Polygon, Scene
from magnetosuture_thread.estimator.thread_session import ThreadSession
from magnetosuture_thread.estimator.settings import ThreadModelSettings

def scene(diameter=0.1, **shapes):
    return Scene.create(dish_diameter=diameter, shapes=shapes)

square = Polygon(((-0.012, 0.001), (-0.006, 0.001), (-0.006, 0.007), (-0.012, 0.007)))
session, stamp = ThreadSession(ThreadModelSettings(initial_shape="straight"), None), 0

def kernels():
    ours = (found for found in gc.get_objects() if isinstance(found, CPUDispatcher))
    return sum(len(f.signatures) for f in ours if f.py_func.__module__.startswith("magnetosuture_thread"))

before = kernels()
for values, around in (
    ({"segments": 60}, None), ({"medium": "air", "gravity": (0.0, -1.0)}, None), ({"fixed_nodes": (20,)}, None),
    ({}, scene(0.036, disc=Disc((-0.01, 1e-4), 0.001), square=square)),
    ({"attachment": "clamped", "rest_curvature": 20.0, "attachment_offset": (1e-3, 0.0)}, None),
):
    session.change(ThreadModelSettings(initial_shape="straight", **values), around)
    for _ in range(40):
        stamp += 33_000_000
        at = np.array([0.0, stamp * 5e-12])
        pose = NeedlePose(stamp * 1e-9, at, np.array([1.0, 0.0]), deviation=(1e-5, 1e-2))
        outcome = session.on_pose(stamp, pose)
        assert outcome.prediction is None or outcome.prediction.margins
print(kernels() - before)
"""
    assert run_python("-c", code).strip() == "0"


def half_seen(first: PieceEnd) -> ThreadObservation:
    """Return an observation of half of the thread."""
    return ThreadObservation((ThreadPiece(seen()[:30], np.full(30, 1e-5), first, PieceEnd.COVERED, (0.0, 0.0)),))


@pytest.mark.parametrize("first", [PieceEnd.TAIL, PieceEnd.COVERED])
def test_the_model_starts_from_a_part_at_the_needle_if_the_rest_is_long_in_coming(first: PieceEnd):
    session = ThreadSession(made(), None)
    for k in range(10):
        assert go(session, 1.0 + 0.1 * k).waiting
        assert not list(session.on_observation(SECOND + k * SECOND // 10, half_seen(first)))
    go(session, 2.0)
    outcomes = list(session.on_observation(2 * SECOND, half_seen(first)))
    assert [predicted(outcome).status for outcome in outcomes] == (["started"] if first is PieceEnd.TAIL else [])


def gated(first: int, last: int, session: ThreadSession, speed: float, x: float) -> tuple[float, Friction]:
    """Drive a needle east [m/s] from x [m]; return where it is then, and the friction."""
    for k in range(first, last):
        outcome = go(session, 1.0 + k / 30.0, x + speed * (k - first) / 30.0)
        friction = known(outcome.margins).friction
    return x + speed * (last - 1 - first) / 30.0, friction


def test_friction_slows_a_needle_that_pulls_and_no_other_and_a_change_of_settings_keeps_the_motion():
    """Between two discs, 0.8 mm from the thread on either side, 6 mm behind the needle."""
    gate = scene_with(Disc((-0.006, 0.0018), 0.001), Disc((-0.006, -0.0018), 0.001))
    values = {"friction_threshold": 1.2e-3}
    model, averaged = straight(gate, friction_averaging=0.0, **values), straight(gate, **values)
    x, pulled = gated(0, 5, model, 3e-3, 0.0)
    assert pulled.state is FrictionState.SLIDING
    assert 0.5 < pulled.slowdown < 1.0
    _, resting = gated(5, 10, model, 0.0, x)
    assert (resting.state, resting.slowdown) == (FrictionState.STUCK, 1.0)
    x, before = gated(0, 9, averaged, 3e-3, 0.0)
    averaged.change(made(initial_shape="straight", contact_tolerance=2e-5, **values), gate)
    _, after = gated(9, 10, averaged, 0.0, x)  # averaged, it still moves
    assert after.slowdown == pytest.approx(before.slowdown, rel=0.2)
    assert before.slowdown < 1.0


RATE = 60.0
PLACE, ANGLE = 1e-5, 5e-3  # m and rad; deviations of a tracked needle
SPEED, RADIUS = 4e-3, 6e-3  # m/s and m; of a needle on a circle


def on_circle(time: float) -> NeedlePose:
    """Return the exact pose of a needle that goes round."""
    turn = SPEED * time / RADIUS
    tail = RADIUS * np.array([math.sin(turn), 1.0 - math.cos(turn)])
    return NeedlePose(time, tail, np.array([math.cos(turn), math.sin(turn)]))


def measured(pose: NeedlePose, random: np.random.Generator) -> NeedlePose:
    """Return a pose with a tracker's noise."""
    angle = math.atan2(pose.heading[1], pose.heading[0]) + ANGLE * random.standard_normal()
    tail = pose.tail + PLACE * random.standard_normal(2)
    return NeedlePose(pose.stamp, tail, np.array([math.cos(angle), math.sin(angle)]), (PLACE, ANGLE))


@pytest.mark.parametrize("seed", range(3))
def test_velocity_and_pose_of_a_needle_on_a_circle(seed: int):
    random, motion, filtered = np.random.default_rng(seed), NeedleMotionFilter(), []
    for k in range(600):
        filtered.append(motion.update(measured(on_circle(k / RATE), random)))
    errors, shifts, turnings = [], [], []
    for pose in filtered[60:]:
        exact, found = on_circle(pose.stamp), known(pose.motion)
        errors.append((found.velocity - SPEED * exact.heading) / pose.deviation[0])
        shifts.append((pose.tail - exact.tail) / pose.deviation[0])
        turnings.append(found.turning)
    # As good as its own covariance says, and better than a difference of poses, of 0.85 mm/s.
    assert 0.7 < np.sqrt(np.mean(np.square(shifts))) < 1.3
    assert filtered[-1].deviation[0] < 0.8 * PLACE
    assert np.sqrt(np.mean(np.square(errors))) * filtered[-1].deviation[0] < 0.25e-3
    assert np.mean(turnings) == pytest.approx(SPEED / RADIUS, rel=0.03)


def test_the_pull_of_a_session_is_that_of_the_needle_and_not_of_noise():
    """Of a thread drawn along itself: 22 % of the peak by differences of poses, in closed loop."""
    random, settings = np.random.default_rng(7), ThreadModelSettings(initial_shape="straight", estimator=False)
    session, pulls = ThreadSession(settings, None), []
    for k in range(300):
        exact = NeedlePose(k / RATE, SPEED * k / RATE * EAST, EAST)
        result = session.on_pose(round(1e9 * k / RATE), measured(exact, random))
        if k > 60:
            pulls.append(known(known(result.prediction).forces).needle_force)
    drag = session.thread.medium.drag_along * session.thread.length * SPEED
    off = np.linalg.norm(np.array(pulls) + np.array([drag, 0.0]), axis=1) / drag
    assert np.sqrt(np.mean(off**2)) < 0.06
