"""The cases of the estimator's benchmark: what the model is told, what is true, and what the camera gives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import TypedDict

import numpy as np

from benchmarks.estimator.camera import CameraModel
from benchmarks.estimator.truth import LENGTH, Run, model_thread, simulate, wander
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points

RATE = 30.0  # frames [1/s]
SPEED = 1.5e-3  # of the needle [m/s]
DURATION = 25.0  # s
POST_RADIUS = 1.2e-3  # m
HIDDEN_TIME = (10.0, 15.0)  # s


class TrueThread(TypedDict, total=False):
    """What of thread and liquid is not as told; see `simulate`."""

    stiffness: float
    viscosity: float
    flow: tuple[float, float]


@dataclass(frozen=True)
class Case:
    """A case.

    Attributes:
        name: of the case.
        limits: of the mean and the greatest error, in % of the length.
        truth: arguments of `simulate`.
        camera: what is seen.
        post: whether a post stands in the thread's way; `known` or `unknown` to the model, or empty.
        every: frames a pose, 1 for each.
        lost: part of the frames that never come.
        latency: of the camera, in frames.
        start: `measured`, `straight`, or `bent`: wrong by a fifth of the length.
        second: whether another thread lies in the dish.
        judged: what of the run counts: `settled` (after the first second), `hidden` (the part that is hidden, while it
            is), or `contact` (from the first contact on).
        learned: slow parameters that the estimator is asked to learn.
        better: whether the estimate must be better than the prediction alone, too.
    """

    name: str
    limits: tuple[float, float]
    truth: TrueThread = field(default_factory=TrueThread)
    camera: CameraModel = field(default_factory=CameraModel)
    post: str = ""
    every: int = 1
    lost: float = 0.0
    latency: int = 0
    start: str = "measured"
    second: bool = False
    judged: str = "settled"
    learned: tuple[str, ...] = ()
    better: bool = False


def _hidden(first: float, last: float) -> CameraModel:
    return CameraModel(hidden=(first * LENGTH, last * LENGTH), hidden_time=HIDDEN_TIME)


WRONG, USUAL, LEARNED = (0.3, 1.5), (0.3, 1.5), ("stiffness_over_drag",)
CASES = {
    case.name: case
    for case in (
        Case("right, free", (0.03, 0.15), better=True),
        Case("right, post", (0.03, 0.15), post="known", better=True),
        Case("stiffness x 5", WRONG, {"stiffness": 5.0}),
        Case("stiffness / 5", WRONG, {"stiffness": 0.2}),
        Case("viscosity x 2", WRONG, {"viscosity": 2.0}),
        Case("viscosity / 2", WRONG, {"viscosity": 0.5}),
        Case("flow 1 mm/s", WRONG, {"flow": (1e-3, 0.0)}),
        Case("camera scale + 1 %", WRONG, camera=CameraModel(scale=1.01)),
        Case("starts straight", (0.3, 1.5), start="straight"),
        Case("starts wrong by 20 %", (0.3, 1.5), start="bent"),
        Case("first half hidden", (0.3, 1.5), camera=_hidden(0.0, 0.5), judged="hidden"),
        Case("middle hidden", (0.3, 1.5), camera=_hidden(0.25, 0.75), judged="hidden"),
        Case("last half hidden", (0.3, 1.5), camera=_hidden(0.5, 1.0), judged="hidden"),
        Case("middle, stiffness x 5", (2.0, 6.0), {"stiffness": 5.0}, camera=_hidden(0.25, 0.75), judged="hidden"),
        *(
            Case(name, (2.0, 6.0), {"stiffness": factor}, _hidden(0.5, 1.0), judged="hidden", learned=learned)
            for name, factor, learned in (
                ("last half, stiffness x 5", 5.0, ()),
                ("last half, stiffness / 5", 0.2, ()),
                ("last half, x 5, learned", 5.0, LEARNED),
                ("last half, / 5, learned", 0.2, LEARNED),
            )
        ),
        Case("5 frames a second", USUAL, every=6),
        Case("30 % lost", USUAL, lost=0.3),
        Case("latency 0.2 s", USUAL, latency=6),
        Case("all three", USUAL, every=6, lost=0.3, latency=6),
        Case("10 % outliers", USUAL, camera=CameraModel(outliers=0.1)),
        Case("second thread", USUAL, second=True),
        Case("unknown post", (0.5, 2.0), post="unknown", judged="contact"),
    )
}


@cache
def free_run(material: str, attachment: str, seed: int, duration: float) -> Run:
    """Return a run in which nothing stands in the way."""
    tails, headings = wander(seed, duration, RATE, SPEED)
    return simulate(model_thread(material, 25, attachment), tails, headings, RATE)


@cache
def post_in_the_way(material: str, attachment: str, seed: int, duration: float) -> Disc | None:
    """Return a post that the thread of a free run would sweep over, not at once, and the needle not; None for none."""
    run, rng = free_run(material, attachment, seed, duration), np.random.default_rng(seed)
    tails, third = np.array([pose.tail for pose in run.poses]), len(run.threads) // 3
    for _ in range(2000):
        centre = rng.uniform(-0.011, 0.011, 2)
        gap = np.array([np.min(np.linalg.norm(thread - centre, axis=1)) for thread in run.threads[::10]]) - POST_RADIUS
        apart = float(np.min(np.linalg.norm(tails - centre, axis=1))) - POST_RADIUS
        if gap[: third // 10].min() > 3e-4 and gap[third // 10 : third // 5].min() < -2e-4 and apart > 1e-4:
            return Disc((float(centre[0]), float(centre[1])), POST_RADIUS)
    return None


def run_of(case: Case, material: str, attachment: str, seed: int, duration: float = DURATION) -> Run | None:
    """Return what happens in a case; None where the seed has no post that could stand in the way."""
    if not case.truth and not case.post:
        return free_run(material, attachment, seed, duration)
    posts: tuple[Disc, ...] = ()
    if case.post:
        post = post_in_the_way(material, attachment, seed, duration)
        if post is None:
            return None
        posts = (post,)
    tails, headings = wander(seed, duration, RATE, SPEED)
    return simulate(model_thread(material, 25, attachment), tails, headings, RATE, posts=posts, **case.truth)


def contact_frame(run: Run) -> int:
    """Return the first frame in which the thread touches a post; the number of frames if it never does."""
    for index, thread in enumerate(run.threads):
        for post in run.posts:
            gap = float(np.min(np.linalg.norm(thread - np.array(post.centre), axis=1))) - post.radius
            if gap < 0.5 * run.thread.diameter + 3e-6:
                return index
    return len(run.threads)


def second_thread(seed: int) -> Callable[[float], Points]:
    """Return where another thread lies at a time: across the dish, waving slowly."""
    angle = float(np.random.default_rng(seed).uniform(0.0, math.pi))
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    along = np.linspace(-0.009, 0.009, 60)

    def at(time: float) -> Points:
        return np.asarray(np.column_stack([along, 2e-3 * np.sin(400.0 * along + 0.3 * time)]) @ turn)

    return at
