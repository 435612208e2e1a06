"""Barriers that a user adds: rows of the same program, with margins beside the built-in ones."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread import (
    Barrier,
    ConfigurationError,
    Disc,
    Gradient,
    InvalidInputError,
    NeedlePose,
    Prediction,
    Scene,
    ThreadPredictor,
    check_gradient,
)
from magnetosuture_thread.geometry.barrier import load_barriers
from test.examples import FOLDER, load_example
from test.shared import known

TipKeepIn = load_example("barriers/tip_keep_in").TipKeepIn
CurvatureBound = load_example("barriers/curvature_bound").CurvatureBound
MovingDisc = load_example("barriers/moving_disc").MovingDisc
HOLDS = 1.1e-7  # m; what a barrier may be short of


class EndsApart(Barrier):
    """The ends of the thread keep a distance: one row over the first and the last node."""

    name = "ends_apart"

    def __init__(self, least: float = 0.0175) -> None:
        self.least = least

    def value(self, positions: np.ndarray) -> np.ndarray:
        """Return the one row."""
        return np.array([np.linalg.norm(positions[-1] - positions[0]) - self.least])

    def gradient(self, positions: np.ndarray) -> Gradient:
        """Return its gradient."""
        along = (positions[-1] - positions[0]) / np.linalg.norm(positions[-1] - positions[0])
        return Gradient(np.array([[0, len(positions) - 1]]), np.array([[-along, along]]))


def around(step: int) -> NeedlePose:
    """Return a needle that drives a circle of 4 mm at 6 mm/s."""
    angle = 0.025 * step
    tail = 0.004 * np.array([math.sin(angle), 1.0 - math.cos(angle)])
    return NeedlePose(step / 60.0, tail, np.array([math.cos(angle), math.sin(angle)]))


def predicted(*barriers: Barrier, steps: int = 150, **options: Any) -> list[Prediction]:
    """Return the predictions of a thread that starts straight behind its needle."""
    predictor = ThreadPredictor.create("polyamide_7_0", length=0.019, segments=25, barriers=barriers, **options)
    predictor.start(around(0))
    return [predictor.step(around(step)) for step in range(1, steps + 1)]


def least(barrier: Barrier, predictions: list[Prediction]) -> float:
    """Return the least clearance of a barrier over predictions that may not have known it [m]."""
    found = []
    for prediction in predictions:
        barrier.set_time(prediction.stamp)
        found.append(float(barrier.clearance(prediction.positions).min()))
    return min(found)


BROKEN = [TipKeepIn(), CurvatureBound(20.0), MovingDisc(), EndsApart(0.0185)]


@pytest.mark.parametrize("solver", ["banded", "osqp"])
@pytest.mark.parametrize("barrier", BROKEN, ids=lambda barrier: barrier.name)
def test_a_barrier_holds_that_the_thread_would_leave(barrier: Barrier, solver: str):
    assert least(barrier, predicted()) < -5e-6
    held = predicted(barrier, solver=solver)
    assert all(prediction.converged for prediction in held)
    assert least(barrier, held) > -HOLDS
    # And its margins are there, of the same rows.
    for prediction in held[::10]:
        barrier.set_time(prediction.stamp)
        np.testing.assert_array_equal(prediction.margins[barrier.name].value, barrier.value(prediction.positions))
    assert max(np.abs(prediction.strain).max() for prediction in held) < 5e-3


def skewed(barrier: Barrier, change: Callable[[Gradient], Gradient]) -> Barrier:
    """Return a barrier with another gradient."""
    return type("Skewed", (type(barrier),), {"gradient": lambda self, x: change(type(barrier).gradient(self, x))})()


@pytest.mark.parametrize(
    ("barrier", "change", "words"),
    [
        (TipKeepIn(), lambda found: Gradient(found.nodes, -found.values), "derivative -1 of row .* by node 25, axis 1"),
        (CurvatureBound(), lambda found: Gradient(found.nodes[:, :2], found.values[:, :2]), "derivative 0 of row"),
        (MovingDisc(), lambda found: Gradient(found.nodes[::-1], found.values), "as the values change"),
        (MovingDisc(), lambda found: Gradient(found.nodes, found.values[:, 0]), "derivatives of shape"),
    ],
)
def test_a_gradient_that_is_wrong_is_named(barrier: Barrier, change: Callable[[Gradient], Gradient], words: str):
    positions = np.cumsum(np.random.default_rng(5).uniform(-1e-3, 1e-3, (26, 2)), axis=0)
    barrier.set_time(0.5)
    assert check_gradient(barrier, positions) < 1e-6
    with pytest.raises(InvalidInputError, match=f"barrier {barrier.name}: .*{words}"):
        check_gradient(skewed(barrier, change), positions)


def test_several_barriers_hold_together_beside_the_wall_and_a_post():
    scene = Scene.create(dish_diameter=0.045, shapes={"post": Disc((-0.004, -0.004), 0.002)})
    barriers = [TipKeepIn(), MovingDisc()]
    held = predicted(*barriers, scene=scene)
    assert all(prediction.converged for prediction in held)
    for barrier in barriers:
        assert least(barrier, held) > -HOLDS
    assert min(prediction.margins["obstacle"].minimum for prediction in held) > -HOLDS
    assert list(held[-1].margins) == ["connectivity", "compression", "obstacle", "wall", "tip_keep_in", "moving_disc"]


def test_a_barrier_knows_where_the_needle_is():
    """The end of the thread stays near the needle's axis, which turns."""

    class LeftOfNeedle(Barrier):
        name, most = "left_of_needle", 2e-3

        def value(self, positions: np.ndarray) -> np.ndarray:
            tail, (x, y) = known(self.needle)
            off = positions[-1] - tail
            return np.array([self.most - x * off[1] + y * off[0]])

        def gradient(self, positions: np.ndarray) -> Gradient:
            _, (x, y) = known(self.needle)
            return Gradient(np.array([[len(positions) - 1]]), np.array([[[y, -x]]]))

    least_margins = []
    for run in (predicted(), predicted(LeftOfNeedle())):
        left, margins = LeftOfNeedle(), []
        for step, prediction in enumerate(run, 1):
            left.move_to(prediction.stamp, 0.0, (prediction.positions[0], around(step).heading))
            margins.append(float(left.value(prediction.positions)[0]))
        least_margins.append(min(margins))
    assert least_margins[0] < -1e-4
    assert least_margins[1] > -HOLDS


def test_a_failed_row_leaves_the_thread_where_it_was():
    class Fragile(MovingDisc):  # type: ignore[misc, valid-type]
        broken = False

        def value(self, positions: np.ndarray) -> np.ndarray:
            return np.full(3, math.nan) if self.broken else np.asarray(super().value(positions))

    barrier = Fragile()
    predictor = ThreadPredictor.create("polyamide_7_0", length=0.019, segments=25, barriers=[barrier])
    predictor.start(around(0))
    before = predictor.step(around(1))
    barrier.broken = True
    with pytest.raises(InvalidInputError, match="moving_disc"):
        predictor.step(around(2))
    np.testing.assert_array_equal(known(predictor.state).positions, before.positions)
    barrier.broken = False
    assert predictor.step(around(3)).interval == pytest.approx(2.0 / 60.0)


def test_a_gain_slows_how_fast_the_margin_falls():
    """h(next) >= (1 - gain dt) h(last), as far as the rows are linear, which these are."""

    class Slow(TipKeepIn):  # type: ignore[misc, valid-type]
        gain = 3.0

    given = ((-0.03, -0.001), (0.01, -0.001), (0.01, 0.0008), (-0.03, 0.0008))
    barrier = Slow(given)
    found = [prediction.margins["tip_keep_in"].value for prediction in predicted(barrier)]
    for before, after in pairwise(found):
        assert (after >= (1.0 - 3.0 / 60.0) * before - HOLDS).all()
    fast = [prediction.margins["tip_keep_in"].value for prediction in predicted(TipKeepIn(given))]
    assert any((after < (1.0 - 3.0 / 60.0) * before - 1e-6).any() for before, after in pairwise(fast))


def test_a_slack_lets_a_barrier_give_way():
    class Soft(TipKeepIn):  # type: ignore[misc, valid-type]
        slack_weight = 1e-3

    found = predicted(Soft())
    assert all(prediction.converged for prediction in found)
    assert least(TipKeepIn(), found) < -5e-5


def test_a_hard_barrier_that_cannot_hold_gives_no_margin_as_proven():
    """The ends cannot be farther apart than the thread is long."""
    found = predicted(EndsApart(0.025), steps=3)
    assert not any(prediction.converged for prediction in found)


def test_the_papers_formulation_takes_them_too():
    barrier = TipKeepIn(((-0.022, -0.001), (-0.0188, -0.001), (-0.0188, 0.001), (-0.022, 0.001)))
    held = predicted(barrier, formulation="paper")
    # The gains are the paper's: one linearisation a step, of rows that are linear here.
    assert least(barrier, held) > -HOLDS
    assert least(barrier, predicted(formulation="paper")) < -5e-5
    assert held[-1].margins["tip_keep_in"].minimum > -HOLDS


@pytest.mark.parametrize(
    ("value", "nodes", "values"),
    [
        ([1.0, 2.0], np.array([[0]]), np.ones((1, 1, 2))),
        ([1.0], np.array([[26]]), np.ones((1, 1, 2))),
        ([1.0], np.array([[1]]), np.ones((1, 1, 3))),
        ([math.nan], np.array([[1]]), np.ones((1, 1, 2))),
    ],
)
def test_rows_that_make_no_sense_are_refused_by_the_barriers_name(value: Any, nodes: Any, values: Any):
    methods = {"value": lambda self, x: np.array(value), "gradient": lambda self, x: Gradient(nodes, values)}
    with pytest.raises(InvalidInputError, match="barrier bad"):
        predicted(type("Bad", (Barrier,), {"name": "bad", **methods})(), steps=1)


def test_barriers_must_be_told_apart():
    for barriers, words in (
        ([TipKeepIn(), TipKeepIn()], "a name that no other barrier has"),
        ([type("Wall", (TipKeepIn,), {"name": "wall"})()], "a name that no other barrier has"),
        ([type("None", (TipKeepIn,), {"name": ""})()], "printable characters"),
        ([object()], "an instance of Barrier"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            ThreadPredictor.create("polyamide_7_0", length=0.019, segments=25, barriers=barriers)  # type: ignore[arg-type]


@pytest.fixture
def my_barriers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Make a module of a user's importable, and return its name."""
    source = FOLDER / "barriers/tip_keep_in.py"
    (tmp_path / "my_barriers.py").write_text(source.read_text() + "\nbroken = 3\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "my_barriers", raising=False)
    return "my_barriers"


def test_barriers_are_loaded_by_the_name_of_their_class(my_barriers: str):
    (barrier,) = load_barriers([f"{my_barriers}:TipKeepIn"])
    assert barrier.name == "tip_keep_in"
    assert load_barriers([]) == ()
    for name, words in (
        ("nothing", "module:class"),
        ("my_barriers:Nothing", "AttributeError"),
        ("my_barriers:broken", "a subclass of magnetosuture_thread.Barrier"),
        ("no_such_module:Class", "ModuleNotFoundError"),
    ):
        with pytest.raises(ConfigurationError, match=words):
            load_barriers([name])
