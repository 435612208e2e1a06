"""Forecasts against stepping filter, needle and predictor by hand; batches; and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread import (
    ConfigurationError,
    Disc,
    ForecastStart,
    InvalidInputError,
    NeedlePose,
    NeedleSafetyFilter,
    Polygon,
    Prediction,
    Scene,
    SceneShape,
    Thread,
    ThreadForecaster,
    ThreadPredictor,
)
from magnetosuture_thread.forecast.forecaster import NeedleDrag
from magnetosuture_thread.geometry.scene import Dish
from magnetosuture_thread.thread.margins import FrictionLaw, NodeMotion
from magnetosuture_thread.thread.material import MATERIALS, Attachment
from test.shared import known

EAST = np.array([1.0, 0.0])
LAW = FrictionLaw(threshold=1e-3, beta=0.9, stuck_speed=1e-5)
AVERAGING, STEP, HORIZON = 0.3, 1.0 / 66.0, 1.0
OFFSET = (2e-4, -1e-4)
START = NeedlePose(5.0, np.array([0.003, -0.0002]), EAST)
UP, HARD = np.array([-0.002, 0.004]), np.array([0.015, 0.03])


def scene(friction: float = 0.0) -> Scene:
    """Return a dish with two posts and a block, and a channel between them that the thread lies in."""
    block = Polygon(((-0.009, -0.004), (-0.005, -0.004), (-0.005, -0.0009), (-0.009, -0.0009)))
    shapes: dict[str, Disc | Polygon] = {
        "post": Disc((-0.007, 0.0011), 0.0008),
        "far post": Disc((0.006, 0.006), 0.0015),
        "block": block,
    }
    return Scene(Dish(0.035), tuple(SceneShape(name, "tissue", shape, {}, friction) for name, shape in shapes.items()))


def thread(segments: int = 40, attachment: Attachment = Attachment.PINNED) -> Thread:
    """Return a thread that is shorter than the dish."""
    return Thread.of(MATERIALS["polyamide_7_0"], length=0.012, segments=segments, attachment=attachment)


def safety(of: Scene) -> NeedleSafetyFilter:
    """Return a filter with every limit, for a bent needle."""
    return NeedleSafetyFilter(
        of, needle_length=0.004, needle_curvature=60.0, max_speed=0.008, max_acceleration=0.04, hold_time=0.15
    )


@pytest.fixture(scope="module")
def forecaster() -> ThreadForecaster:
    """Return a forecaster; kernels are compiled once for all."""
    return ThreadForecaster(thread(), scene(), safety(scene()), law=LAW, friction_averaging=AVERAGING)


def by_hand(
    predictor: ThreadPredictor, filters: NeedleSafetyFilter, start: ForecastStart, command: np.ndarray, steps: int
) -> list[tuple[np.ndarray, Prediction, tuple[int, ...]]]:
    """Step the loop's own classes: filtered velocity, prediction, nodes under friction."""

    def fixed(pose: NeedlePose) -> NeedlePose:
        (x, y), (along, left) = pose.heading, OFFSET
        return replace(pose, tail=pose.tail + np.array([along * x - left * y, along * y + left * x]))

    motion, slowdown, previous, found, pose = NodeMotion(AVERAGING), 1.0, None, [], start.pose
    motion.update(start.vertices, 0.0)
    for k in range(steps):
        velocity = filters.filter(
            command, pose.tail, pose.heading, slowdown=slowdown, previous=previous, elapsed=STEP
        ).filtered
        body = filters.kinematics.body_velocity(pose.heading, velocity)
        tail, heading = filters.kinematics.moved(pose.tail, pose.heading, *body, STEP)
        pose, previous = NeedlePose(start.pose.stamp + (k + 1) * STEP, tail, heading), velocity
        prediction = predictor.step(fixed(pose))
        friction = LAW.classify(prediction.margins, motion.update(prediction.positions, prediction.interval))
        slowdown = friction.slowdown
        found.append((velocity, prediction, friction.nodes))
    return found


@pytest.mark.parametrize("command", [UP, HARD], ids=["up", "hard against a post"])
@pytest.mark.parametrize(
    ("attachment", "friction"), [(Attachment.PINNED, 0.0), (Attachment.CLAMPED, 0.0), (Attachment.PINNED, 0.2)]
)
def test_forecast_equals_stepping_by_hand(attachment: Attachment, friction: float, command: np.ndarray):
    where = scene(friction)
    filters, of = safety(where), thread(attachment=attachment)
    forecaster = ThreadForecaster(
        of, where, filters, law=LAW, friction_averaging=AVERAGING, attachment_offset=OFFSET, step=STEP
    )
    predictor, start = ThreadPredictor(of, where), forecaster.straight(START)
    fixed = replace(START, tail=START.tail + OFFSET)
    predictor.start_at(fixed, start.vertices)
    forecast = forecaster.forecast(start, command, HORIZON)
    expected = by_hand(predictor, filters, start, command, len(forecast.filtered))
    assert len(expected) == round(HORIZON / STEP)
    rubbed = False
    for k, (velocity, prediction, nodes) in enumerate(expected):
        forces = known(prediction.forces)
        np.testing.assert_allclose(forecast.filtered[k], velocity, rtol=0.0, atol=1e-10)
        np.testing.assert_allclose(forecast.vertices[k + 1], prediction.positions, rtol=0.0, atol=1e-9)
        assert tuple(np.flatnonzero(forecast.friction[k + 1]).tolist()) == nodes
        rubbed = rubbed or bool(nodes)
        assert forecast.tension[k + 1] == pytest.approx(forces.peak_tension, rel=1e-4, abs=1e-9)
        np.testing.assert_allclose(forecast.needle_force[k + 1], forces.needle_force, rtol=1e-4, atol=1e-9)
        for name in ("obstacle", "wall", "connectivity", "compression"):
            near = min(prediction.margins[name].minimum_clearance, 1e-3)
            assert min(forecast.margins[name][k + 1], 1e-3) == pytest.approx(near, abs=2e-9)
    touched = [bool(prediction.margins.in_contact) for _, prediction, _ in expected]
    contact = forecast.first_contact
    assert (contact is not None) == any(touched)
    assert contact is None or contact.time == pytest.approx((touched.index(True) + 1) * STEP)
    assert rubbed, "the thread lies between two shapes, so that the friction law slows the needle"
    assert forecast.converged
    assert not forecast.problem


def test_a_command_that_friction_does_not_slow_is_forecast_so(forecaster: ThreadForecaster):
    start = forecaster.straight(START)
    slowed, free = (forecaster.forecast(start, UP, HORIZON, slowed=each) for each in (True, False))
    assert all(each.friction[1:].any() for each in (slowed, free)), "nodes are under friction in both"
    assert slowed.slowdown.min() < 1.0
    assert free.slowdown.tolist() == [1.0] * len(free.slowdown)
    assert np.hypot(*free.filtered[-1]) > np.hypot(*slowed.filtered[-1])


def test_forecast_goes_on_from_where_a_predictor_is(forecaster: ThreadForecaster):
    """With the last step's velocities and its solver's guess, one forecast is the end of a longer one."""
    start = forecaster.straight(START)
    predictor = ThreadPredictor(forecaster.thread, forecaster.scene)
    predictor.start_at(START, start.vertices)
    plain = ThreadForecaster(forecaster.thread, forecaster.scene, forecaster.safety)
    whole = plain.forecast(start, UP, HORIZON)
    half = len(whole.filtered) // 2
    for k in range(1, half + 1):
        predictor.step(NeedlePose(START.stamp + k * STEP, whole.tails[k], whole.headings[k]))
    later = ForecastStart.of_predictor(predictor, tip_velocity=whole.filtered[half - 1])
    rest = plain.forecast(later, UP, (len(whole.filtered) - half) * STEP)
    np.testing.assert_allclose(rest.vertices[-1], whole.vertices[-1], rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(rest.tails[-1], whole.tails[-1], rtol=0.0, atol=1e-12)


def test_sequence_and_controller_equal_held_command(forecaster: ThreadForecaster):
    start, steps = forecaster.straight(START), round(HORIZON / STEP)
    held = forecaster.forecast(start, UP, HORIZON)
    sequence = forecaster.forecast(start, np.tile(UP, (steps, 1)), HORIZON)
    np.testing.assert_array_equal(sequence.vertices, held.vertices)
    asked: list[float] = []

    def controller(time: float, tail: np.ndarray, heading: np.ndarray) -> np.ndarray:
        expected = np.append(held.tails[len(asked)], held.headings[len(asked)])
        np.testing.assert_array_equal(np.append(tail, heading), expected)
        asked.append(time)
        return UP

    np.testing.assert_array_equal(forecaster.forecast(start, controller, HORIZON).vertices, held.vertices)
    np.testing.assert_allclose(asked, held.times[:-1])
    with pytest.raises(InvalidInputError, match="controller"):
        forecaster.forecast(start, lambda time, tail, heading: np.full(2, np.nan), HORIZON)


def test_needle_that_is_driven_against_a_shape_comes_to_rest_there():
    """A needle that is a point is driven straight at a post: the filter lets it approach, and then it rests."""
    where = Scene.create(shapes={"post": Disc((0.006, 0.0), 0.001), "other": Disc((-0.004, 0.003), 0.001)})
    forecaster = ThreadForecaster(thread(), where, NeedleSafetyFilter(where, keep_out=5e-4))
    start = forecaster.straight(NeedlePose(0.0, np.array([0.003, 0.0]), EAST))
    forecast = forecaster.forecast(start, 0.002 * EAST, 5.0)
    assert 0.5 < known(forecast.rest_time) < 4.0  # 1.5 mm at 2 mm/s, the last of it slower and slower
    assert forecast.stopped_by == ("post",)
    assert forecast.minima["needle"].shape == "post"
    assert 0.0 < forecast.minima["needle"].value < 1e-5
    assert forecaster.forecast(start, -0.002 * EAST, 1.0).rest_time is None
    assert forecaster.forecast(start, np.zeros(2), 1.0).rest_time is None, "nobody commands it to move"


def test_needle_with_drag_moves_by_the_balance_of_command_and_pull():
    """Behind a straight thread as commanded, and with one that lies across it more slowly: that has to be turned."""
    where, drag = Scene.create(), NeedleDrag(along=0.0255, across=0.033, turning=1.6e-7)
    filters = NeedleSafetyFilter(where, needle_length=0.007)
    exact, pulled = (ThreadForecaster(thread(), where, filters, drag=each) for each in (None, drag))
    start = exact.straight(NeedlePose(0.0, np.zeros(2), EAST))
    ahead, steps = 0.003 * EAST, 60
    free, drawn = (forecaster.forecast(start, ahead, steps * STEP) for forecaster in (exact, pulled))
    assert drawn.tails[-1, 0] == pytest.approx(free.tails[-1, 0], rel=0.05)
    turning = np.array([0.0, 0.003])
    free, drawn = (each.forecast(start, turning, steps * STEP) for each in (exact, pulled))
    turns = [math.atan2(each.headings[-1, 1], each.headings[-1, 0]) for each in (free, drawn)]
    assert 0.1 * turns[0] < turns[1] < 0.95 * turns[0]
    left = np.array([-drawn.headings[-1, 1], drawn.headings[-1, 0]])
    balance, across = drawn.needle_force[-1] @ left, turning @ left
    rate = (math.atan2(*drawn.headings[-1][::-1]) - math.atan2(*drawn.headings[-2][::-1])) / STEP
    assert rate == pytest.approx(across / 0.0035 - 0.0035 * balance / 1.6e-7, rel=0.1)
    still = pulled.forecast(replace(start, vertices=start.vertices), np.zeros(2), 0.2)
    np.testing.assert_array_equal(still.tails[-1], still.tails[0])  # nothing moves a needle that nobody commands


def test_first_contact_names_shape_and_time():
    """A straight thread is carried sideways onto a post, at a known speed."""
    where = Scene.create(shapes={"post": Disc((-0.004, 0.002), 0.001)})
    forecaster = ThreadForecaster(thread(80), where, NeedleSafetyFilter(where))
    start = forecaster.straight(NeedlePose(0.0, np.zeros(2), EAST))
    forecast = forecaster.forecast(start, np.array([0.0, 0.003]), 3.0)
    contact = known(forecast.first_contact)
    assert contact.shape == "post"
    before = forecast.margins["obstacle"][: round(contact.time / STEP)]
    assert before.min() > 2e-6
    from_centre = np.linalg.norm(forecast.vertices - (-0.004, 0.002), axis=2)
    assert from_centre.min() - 0.001 - 0.5 * thread(80).diameter > -2e-7
    assert forecaster.forecast(start, np.array([0.0, -0.003]), 2.0).first_contact is None


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"vertices": np.zeros((40, 2))}, "nodes"),
        ({"velocities": np.full((41, 2), np.inf)}, "velocities"),
        ({"pose": NeedlePose(0.0, np.array([0.006, 0.0]), EAST)}, "first node"),
        ({"pose": NeedlePose(0.0, np.array([0.005, 0.0055]), EAST), "vertices": None}, "inside of a shape"),
        ({"pose": NeedlePose(0.0, np.array([0.015, 0.0]), EAST), "vertices": None}, "inside of a shape or the wall"),
    ],
)
def test_start_that_cannot_be_used_is_refused(forecaster: ThreadForecaster, change: dict, match: str):
    start = forecaster.straight(START)
    if "vertices" in change and change["vertices"] is None:
        change = {**change, "vertices": start.vertices + (change["pose"].tail - START.tail)}
    with pytest.raises(InvalidInputError, match=match):
        forecaster.forecast(replace(start, **change), UP, HORIZON)


@pytest.mark.parametrize(
    ("commands", "horizon", "match"),
    [
        *((UP, horizon, "horizon") for horizon in (0.0, math.nan, math.inf, 1e9, 1e-4)),
        *((commands, HORIZON, "command") for commands in (np.zeros(3), np.zeros((5, 2)), np.array([np.nan, 0.0]))),
    ],
)
def test_horizon_and_commands_that_cannot_be_used_are_refused(
    forecaster: ThreadForecaster, commands: np.ndarray, horizon: float, match: str
):
    with pytest.raises(InvalidInputError, match=match):
        forecaster.forecast(forecaster.straight(START), commands, horizon)


def test_a_safety_filter_of_another_scene_is_refused():
    with pytest.raises(ConfigurationError, match="scene"):
        ThreadForecaster(thread(), scene(), NeedleSafetyFilter(Scene.create()))
