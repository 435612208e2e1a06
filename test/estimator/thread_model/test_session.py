"""A session: what waits, what is refused, what time set back does, friction, and how other settings take over."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.estimator import settings as model_settings
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import PredictionResult, ThreadSession
from magnetosuture_thread.forecast import make_forecaster
from magnetosuture_thread.geometry.barrier import Barrier, Gradient
from magnetosuture_thread.geometry.obstacles import Disc, Polygon
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.geometry.thread_observation import PieceEnd, ThreadObservation, ThreadPiece
from magnetosuture_thread.settings.configuration import from_mapping
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError, SolverError
from magnetosuture_thread.thread.margins import Friction, FrictionState
from magnetosuture_thread.thread.prediction import NeedlePose, Prediction
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
    assert outcome.prediction is not None
    return outcome.prediction


def seen(x: float = 0.0, y: float = 0.0) -> Points:
    """Return a thread that lies straight behind a needle that points east."""
    return np.column_stack([x - np.linspace(0.0, 0.019, 60), np.full(60, y)])


def on_a_curve(session: ThreadSession, first: int, last: int) -> list[PredictionResult]:
    """Return what comes of a needle that is driven in a curve, at 30 Hz."""
    turns = np.arange(first, last) / 40.0
    return [go(session, 1.0 + 4.0 / 3.0 * k, 0.01 * np.sin(k), 0.01 - 0.01 * np.cos(k), k) for k in turns]


class OverTheDish(Barrier):
    """A barrier that cannot be evaluated of a thread behind the dish's centre."""

    name = "over_the_dish"

    def value(self, positions: Points) -> Points:
        """Return the root of where the free end is."""
        return np.sqrt(positions[-1:, 0])

    def gradient(self, positions: Points) -> Gradient:
        """Return its gradient."""
        return Gradient(np.array([[len(positions) - 1]]), np.array([[[0.5 / np.sqrt(positions[-1, 0]), 0.0]]]))


@pytest.mark.parametrize(
    "values", [{}, {"thread_length": 0.15, "segments": 60}, {"barriers": [f"{__name__}:OverTheDish"]}]
)
@pytest.mark.parametrize("depth", [2e-5, 3e-3])
def test_kernels_are_loaded_outside_of_the_scene(values: dict[str, Any], depth: float):
    random, shapes = np.random.default_rng(4), list[Disc | Polygon]()
    for _ in range(3):
        centres, turns = random.uniform(-0.01, 0.01, (2, 2)), np.arange(0.0, 6.2, 0.9)
        outline = centres[1] + 0.004 * np.column_stack([np.cos(turns), np.sin(turns)])
        shapes += [Disc(tuple(centres[0].tolist()), 0.004), polygon(*outline.ravel().tolist())]
    for diameter, count in ((0.012, 0), (0.022, 2), (0.035, 6)):
        scene = scene_with(*shapes[:count], diameter=diameter)
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


@pytest.mark.parametrize(
    "bad",
    [
        NeedlePose(1.1, np.array([np.nan, 0.0]), EAST),
        NeedlePose(1.1, np.array([1e300, 0.0]), EAST),
        NeedlePose(1.1, np.zeros(2), 2.0 * EAST),
        NeedlePose(0.9, np.zeros(2), EAST),
    ],
)
@pytest.mark.parametrize("offset", [[], [1e-3, 5e-4]])
def test_a_bad_pose_is_refused_and_changes_nothing(bad: NeedlePose, offset: list[float]):
    session, other = straight(attachment_offset=offset), straight(attachment_offset=offset)
    for one in (session, other):
        go(one, 1.0)
    refused = session.on_pose(round(bad.stamp * SECOND), bad)
    assert isinstance(refused.problem, InvalidInputError)
    assert not refused.waiting
    np.testing.assert_array_equal(
        predicted(go(session, 1.2, 1e-3)).positions, predicted(go(other, 1.2, 1e-3)).positions
    )


def test_a_step_that_is_not_solved_is_told_and_the_next_goes_on_from_before():
    session = straight(residual_tolerance=1e-12)
    go(session, 1.0)
    failed = go(session, 1.001, 0.017, 0.013)
    assert isinstance(failed.problem, SolverError)
    assert go(session, 1.1, 1e-5).stamp == 1_100_000_000


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
@pytest.mark.parametrize("offset", [[-2e-3, 0.0], [0.0, 7e-4], [0.01, 0.01]])
def test_the_thread_hangs_where_it_is_fixed(offset: list[float], attachment: str):
    session = straight(attachment_offset=offset, attachment=attachment)
    for k in range(20):
        angle = 0.02 * k
        prediction = predicted(go(session, 1.0 + k / 30.0, 1e-4 * k, 0.0, angle))
        along, left = offset
        expected = [
            1e-4 * k + along * np.cos(angle) - left * np.sin(angle),
            along * np.sin(angle) + left * np.cos(angle),
        ]
        np.testing.assert_allclose(prediction.positions[0], expected, atol=1e-12)
    assert np.abs(prediction.strain).max() < 1e-3


@pytest.mark.parametrize(
    "begin",
    [2e-3, -2e-3, 0.0],  # in front of the tail, what is between them is covered; behind it, it belongs to the needle
)
def test_a_seen_thread_begins_where_it_is_fixed(begin: float):
    session = ThreadSession(made(attachment_offset=[begin, 0.0]), None)
    go(session, 1.0)
    prediction = predicted(next(iter(session.on_measured_thread(SECOND, seen()))))
    np.testing.assert_allclose(prediction.positions[0], [begin, 0.0], atol=1e-12)
    np.testing.assert_allclose(prediction.positions[-1], [begin - 0.019, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    "values",
    [
        {"material": "silk_6_0"},
        {"viscosity": 0.3, "drag_anisotropy": 0.7},
        {"attachment": "clamped"},
        {"attachment_offset": [1e-3, 1e-3]},
        {"margin_range": 1e-2},
        {"medium": "air", "gravity": [0.0, -0.01]},
    ],
)
def test_it_goes_on_from_the_present_shape(values: dict[str, Any]):
    session = straight()
    before = predicted(on_a_curve(session, 0, 30)[-1])
    session.change(made(initial_shape="straight", **values), None)
    assert session.settings == made(initial_shape="straight", **values)
    after = predicted(on_a_curve(session, 30, 31)[0])
    assert after.interval == pytest.approx(1 / 30.0)  # no pose was lost, and no time
    assert after.status == "solved"
    assert np.linalg.norm(after.positions[1:] - before.positions[1:], axis=1).max() < 1.5e-3
    assert np.abs(after.strain).max() < 1e-3


def test_a_scene_changes_what_is_around_and_what_the_predictions_name():
    session, scene = straight(), scene_with(Disc((0.0, 0.02), 0.003))
    assert on_a_curve(session, 0, 30)[-1].scene_version == ""
    session.change(session.settings, scene)
    assert (session.scene, session.scene_version) == (scene, scene.version)
    outcome = go(session, 2.0, 0.0068, 0.0026, 0.75)
    assert predicted(outcome).scene_version == outcome.scene_version == scene.version
    assert outcome.margins is not None
    assert outcome.margins.scene_version == scene.version
    assert go(session, 1.5).scene_version == scene.version  # refused, as it is of the past
    session.change(session.settings, None)
    assert go(session, 2.1, 0.0068, 0.0026, 0.75).scene_version == ""


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
    margins = outcomes[-1].margins
    assert margins is not None
    assert formulation == "paper" or margins.in_contact


@pytest.mark.parametrize("values", [{}, {"formulation": "paper"}])
def test_settings_that_cannot_be_used_leave_those_before_in_force(values: dict[str, Any], monkeypatch):
    one, other = straight(**values), straight(**values)
    for session in (one, other):
        on_a_curve(session, 0, 20)
    before = one.settings

    def refuse(*_: Any, **__: Any) -> None:
        raise ConfigurationError("scene.shape_0", 1.0, "something else")

    with monkeypatch.context() as patch:
        patch.setattr(model_settings, "ThreadPredictor", refuse)
        with pytest.raises(ConfigurationError):
            one.change(one.settings, scene_with(Disc((0.0, 0.01), 0.002)))
    assert one.settings is before
    assert one.scene is None
    for first, second in zip(on_a_curve(one, 20, 30), on_a_curve(other, 20, 30), strict=True):
        np.testing.assert_array_equal(predicted(first).positions, predicted(second).positions)


@pytest.mark.parametrize("formulation", ["rod", "paper"])
@pytest.mark.parametrize(
    ("offsets", "leaves"),
    [
        ([(0.0, 4e-4)], True),  # of posts of 0.6 mm from the node
        ([(0.0, 0.0)], True),
        ([(3e-4, 4e-4), (-3e-4, 4e-4), (0.0, 9e-4)], True),
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
        least = min(float(post.signed_distance(nodes)[0].min()) for post in posts) - 30e-6
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
disc = Disc((-0.01, 1e-4), 0.001)
session, stamp = ThreadSession(ThreadModelSettings(initial_shape="straight"), None), 0

def kernels():
    ours = (found for found in gc.get_objects() if isinstance(found, CPUDispatcher))
    return sum(len(f.signatures) for f in ours if f.py_func.__module__.startswith("magnetosuture_thread"))

before = kernels()
for values, around in (
    ({}, None), ({"segments": 60}, None), ({"thread_length": 0.03}, None), ({"material": "silk_6_0"}, None),
    ({"medium": "air", "gravity": (0.0, -1.0)}, None), ({}, scene(0.036)), ({}, scene(disc=disc)),
    ({}, scene(square=square)), ({}, scene(disc=disc, square=square)), ({"fixed_nodes": (20,)}, None),
    ({"attachment": "clamped", "rest_curvature": 20.0}, None), ({"attachment_offset": (1e-3, 0.0)}, None),
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
    found = subprocess.run([sys.executable, "-c", code], check=True, timeout=300, capture_output=True, text=True)
    assert found.stdout.strip() == "0"


def observed(*, complete: bool, first: PieceEnd = PieceEnd.TAIL) -> ThreadObservation:
    """Return an observation of one piece, half of the thread unless it is complete."""
    points = seen() if complete else seen()[: len(seen()) // 2]
    last = PieceEnd.FREE if complete else PieceEnd.COVERED
    piece = ThreadPiece(points, np.full(len(points), 1e-5), first, last, (0.0, 0.0))
    return ThreadObservation((piece,), complete)


def test_the_model_waits_for_the_rest_of_the_thread_before_it_starts_from_a_part():
    session = ThreadSession(made(), None)
    for k in range(10):
        assert go(session, 1.0 + 0.1 * k).waiting
        assert not list(session.on_observation(SECOND + k * SECOND // 10, observed(complete=False)))
    go(session, 2.0)
    (outcome,) = session.on_observation(2 * SECOND, observed(complete=False))
    assert predicted(outcome).status == "started"
    assert len(predicted(outcome).positions) == made().segments + 1  # all of it, the rest straight


def test_the_model_does_not_start_from_a_piece_that_is_not_at_the_needle():
    session = ThreadSession(made(), None)
    for stamp in (SECOND, 3 * SECOND):
        go(session, stamp / SECOND)
        assert not list(session.on_observation(stamp, observed(complete=False, first=PieceEnd.COVERED)))
        assert not list(session.on_observation(stamp, ThreadObservation()))


def gated(first: int, last: int, session: ThreadSession, speed: float, x: float) -> tuple[float, Friction]:
    """Drive a needle east [m/s] from x [m]; return where it is then, and the friction."""
    for k in range(first, last):
        outcome = go(session, 1.0 + k / 30.0, x + speed * (k - first) / 30.0)
        assert outcome.margins is not None
        friction = outcome.margins.friction
    return x + speed * (last - 1 - first) / 30.0, friction


def test_friction_slows_a_needle_that_pulls_and_no_other_and_a_change_of_settings_keeps_the_motion():
    """Between two discs, 0.8 mm from the thread on either side, 6 mm behind the needle."""
    gate, values = (
        scene_with(Disc((-0.006, 0.0018), 0.001), Disc((-0.006, -0.0018), 0.001)),
        {"friction_threshold": 1.2e-3},
    )
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
