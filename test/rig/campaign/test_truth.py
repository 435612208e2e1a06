"""Ground truth of goals: what was not made is named, whatever the nodes say."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape
from magnetosuture_thread.planning.procedure import parse_procedure
from magnetosuture_thread.rig.ground_truth import GoalTruth

SCENE = Scene(
    Dish(), tuple(SceneShape(name, "instrument", Disc((x, 0.0), 0.002)) for name, x in (("a", -4e-3), ("b", 4e-3)))
)
UP = {"pass_through": {"between": ["a", "b"], "direction": [0.0, 1.0]}}
WALL = {"pass_through": {"between": ["wall", "b"], "direction": [0.0, 1.0]}}
AROUND = {"wrap": {"around": "b", "angle": 6.0}}
PLACE = {"go_to": {"position": [0.0, 0.008], "heading": [0.0]}}
LINE: dict[str, Any] = {"lay": {"along": [[0.0062, 0.0], [0.004, 0.0022]]}}
STRAIGHT = np.array([[0.0, 0.0], [0.0, 0.0]])


def judged(goals: list[dict[str, Any]], frames: list[tuple[int, tuple[float, float], np.ndarray]]) -> list[str]:
    """Return the failures of frames: goals met, middle of a needle along x, and thread, the tail first."""
    truth = GoalTruth(parse_procedure({"goals": goals}, "test"), SCENE)
    for met, (x, y), thread in frames:
        truth.update(met, np.array([x, y]), np.array([x - 1e-3, y]), thread)
    return truth.failures(ended=frames[-1][0] == len(goals))


def around(degrees: float) -> np.ndarray:
    """Return a thread that winds about b, counterclockwise from its free end to its tail."""
    angles = np.radians(np.linspace(degrees, 0.0, 60))
    return np.column_stack([4e-3 + 2.2e-3 * np.cos(angles), 2.2e-3 * np.sin(angles)])


@pytest.mark.parametrize(
    ("ys", "failures"),
    [
        ([-2e-3, 1e-3], []),
        ([-2e-3, 1e-3, -1e-3, 2e-3], []),
        ([1e-3, 2e-3], ["0 net crossings between a and b"]),
        ([2e-3, -1e-3], ["-1 net crossings between a and b"]),
    ],
)
def test_a_pass_is_a_net_crossing_in_its_direction(ys: list[float], failures: list[str]):
    frames = [(0, (0.0, y), STRAIGHT) for y in ys]
    found = judged([UP], [*frames, (1, (0.0, ys[-1]), STRAIGHT)])
    assert [text.split(": ")[1] for text in found] == failures


def test_a_pass_beside_the_gap_does_not_count_and_one_at_the_wall_does():
    beside = [(0, (0.010, -2e-3), STRAIGHT), (0, (0.010, 2e-3), STRAIGHT), (1, (0.010, 2e-3), STRAIGHT)]
    assert judged([UP], beside) == ["goal 1 in truth: 0 net crossings between a and b"]
    assert judged([WALL], beside) == []


@pytest.mark.parametrize(("then", "last", "failures"), [(350.0, 300.0, 0), (300.0, 300.0, 1), (350.0, 100.0, 1)])
def test_a_wrap_is_of_the_thread_when_it_is_met_and_at_the_end(then: float, last: float, failures: int):
    goals: list[dict[str, Any]] = [AROUND, PLACE]
    at = (0.0, 0.008)
    found = judged(goals, [(0, at, around(then)), (1, at, around(then)), (2, at, around(last))])
    assert len(found) == failures
    assert all(
        "winds 300 of 344 degrees" in text or "at the end, the thread winds 100 of 344" in text for text in found
    )


def test_a_lost_wrap_is_named_whatever_follows_it():
    both: list[dict[str, Any]] = [{"wrap": {"around": name, "angle": 6.0}} for name in ("a", "b")]
    tight = {"tighten": {"clearance": 0.05, "around": "a", "toward": [0.0, 0.015]}}
    on_a = around(350.0) - (8e-3, 0.0)
    frames = [(0, (0.0, 0.008), on_a), (1, (0.0, 0.008), on_a), (2, (0.0, 0.008), around(350.0))]
    found = judged([*both, tight], [*frames, (3, (0.0, 0.008), around(350.0))])
    assert [text for text in found if "at the end" in text] == [
        "at the end, the thread winds -2 of 344 degrees about a in truth"
    ]


@pytest.mark.parametrize(
    ("goal", "thread", "words"),
    [
        ({"wind": {"around": "b", "angle": 5.0}}, around(290.0), ""),
        ({"wind": {"around": "b", "angle": 5.0}}, around(350.0), "winds 350 of"),
        ({"unwind": {"around": "b"}}, around(200.0), "winds 200 of -180 to 180"),
        ({"take_off": {"around": "b"}}, around(90.0), "0.20 mm from b"),
        ({"keep_side": {"around": "b", "side": "right", "to": [0.0, 0.008]}}, around(90.0), ""),
        ({"keep_side": {"around": "b", "side": "right", "to": [0.0, 0.004]}}, around(90.0), "4.00 mm from its place"),
        (LINE, around(90.0), ""),
        ({"lay": {**LINE["lay"], "tolerance": 3e-4}}, around(90.0), "mm off its line"),
        ({"lay": {**LINE["lay"], "stretch": [0.0, 0.002]}}, around(90.0), "mm off its line"),
        ({"bring_end": {"position": [0.0062, 0.0]}}, around(90.0), ""),
    ],
)
def test_goals_of_the_thread_are_compared_with_the_thread(goal: dict[str, Any], thread: np.ndarray, words: str):
    at = (0.0, 0.008)
    found = judged([goal, PLACE], [(0, at, thread), (1, at, thread)])
    assert (len(found) == 0) if not words else (words in found[0])


def test_a_place_and_its_heading_are_compared_with_the_needle():
    off = [(0, (0.0, 0.0), STRAIGHT), (1, (6e-4, 0.008), STRAIGHT)]
    assert judged([PLACE], off) == ["goal 1 in truth: 0.60 mm from its place"]
    turned = {"go_to": {"position": [0.0, 0.008], "heading": [math.pi / 2.0]}}
    assert judged([turned], [(0, (0.0, 0.0), STRAIGHT), (1, (0.0, 0.008), STRAIGHT)]) == [
        "goal 1 in truth: -1.57 rad from its heading"
    ]
