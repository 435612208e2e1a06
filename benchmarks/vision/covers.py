"""Classes of frames in which something hides a part of the thread, so that it is seen in pieces."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from benchmarks.vision.cases import (
    COVER_BGR,
    MAX_TRIES,
    SKIN_BGR,
    TURN_STEP,
    MakeCase,
    Random,
    depth_inside,
    is_inside,
    random_lighting,
    random_needle,
    smooth_line,
    straight_strip,
    thread_with_loop,
    unit_vector,
    usual_case,
    winding_line,
)
from benchmarks.vision.frames import Case
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.rig.camera import Cover

OFF_NEEDLE = 1.2e-3  # m; of a cover from the needle and the thread's beginning
TURNS = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
STEEL_BGR = (120.0, 118.0, 115.0)


def _post(at: Points, width: float) -> Points:
    return at + 0.5 * width * np.column_stack([np.cos(TURNS), np.sin(TURNS)])


def _off_needle(case: Case, *outlines: Points) -> bool:
    axis, _ = case.needle.axis(np.linspace(0.0, 1.0, 40))
    keep = np.vstack([axis, case.thread[:20]])
    return all(depth_inside(outline, keep) < -OFF_NEEDLE for outline in outlines)


def _colour(random: Random) -> tuple[float, float, float]:
    return COVER_BGR[int(random.integers(len(COVER_BGR)))]


def _two_covers(random: Random) -> Case:
    """Return a thread below two posts."""
    for _ in range(MAX_TRIES):
        case = usual_case(random, thread=0.028)
        widths, middles = random.uniform(2e-3, 5e-3, 2), (random.uniform(5e-3, 10e-3), random.uniform(16e-3, 22e-3))
        posts = [_post(points_at(case.thread, np.array([at]))[0], w) for at, w in zip(middles, widths, strict=True)]
        apart = np.linalg.norm(posts[0].mean(axis=0) - posts[1].mean(axis=0)) - 0.5 * widths.sum()
        if apart > 1e-3 and _off_needle(case, *posts):
            return replace(case, hidden_by=tuple(Cover(post, _colour(random), 1.0) for post in posts))
    raise RuntimeError("no two posts fit")


def _cover_end(random: Random) -> Case:
    """Return a thread whose free end lies below a post."""
    for _ in range(MAX_TRIES):
        case = usual_case(random, thread=0.024)
        width = random.uniform(1.5e-3, 6e-3)
        at = case.thread[-1] + random.uniform(0.0, 0.3) * width * unit_vector(random.uniform(-np.pi, np.pi))
        post = _post(at, width)
        if _off_needle(case, post):
            return replace(case, hidden_by=(Cover(post, _colour(random), 1.0),))
    raise RuntimeError("no post fits")


def _cover_crossing(random: Random) -> Case:
    """Return a thread with a loop, whose crossing lies below a post."""
    for _ in range(MAX_TRIES):
        case = thread_with_loop(random)
        line = case.thread
        apart = np.linalg.norm(line[:, None] - line[None], axis=2)
        apart[np.abs(np.subtract.outer(np.arange(len(line)), np.arange(len(line)))) < 60] = 1.0
        first, _ = np.unravel_index(int(np.argmin(apart)), apart.shape)
        post = _post(line[first], random.uniform(1.5e-3, 2.5e-3))
        if _off_needle(case, post):
            return replace(case, hidden_by=(Cover(post, _colour(random), 1.0),))
    raise RuntimeError("no post fits")


def _glare_thread(random: Random) -> Case:
    """Return a thread a part of which the lamp's reflection outshines."""
    for _ in range(MAX_TRIES):
        case = usual_case(random, thread=0.024)
        at = points_at(case.thread, np.array([random.uniform(5e-3, 19e-3)]))[0]
        axes, turn = random.uniform(0.5e-3, 2e-3, 2), random.uniform(0.0, np.pi)
        spot = axes * np.column_stack([np.cos(TURNS), np.sin(TURNS)])
        spot = at + spot @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
        if _off_needle(case, spot):
            return replace(case, hidden_by=(Cover(spot, (262.0, 262.0, 262.0), 2.0),))
    raise RuntimeError("no reflection fits")


def _below_needle(random: Random) -> Case:
    """Return a thread that comes back and lies below its needle for a part of the needle's length."""
    for _ in range(MAX_TRIES):
        needle = random_needle(random, within=0.011)
        side, low, high = random.choice((-1.0, 1.0)), random.uniform(0.15, 0.35), random.uniform(0.5, 0.8)
        (enter, leave), (way_in, way_out) = needle.axis(np.array([low, high]))
        aside = side * np.array([-way_in[1], way_in[0]])
        back = -unit_vector(needle.heading)
        knots = [needle.tail, needle.tail + 0.9e-3 * back, needle.tail + 2.2e-3 * back - 1.2e-3 * aside]
        knots += [needle.tail + 1.2e-3 * back - 3.0e-3 * aside, enter - 1.6e-3 * aside - 0.6e-3 * way_in]
        knots += [enter, leave, leave + 1.6e-3 * side * np.array([-way_out[1], way_out[0]]) + 1.0e-3 * way_out]
        line = smooth_line(np.array(knots))
        leaving = math.atan2(*(line[-1] - line[-2])[::-1])
        line = np.vstack([line, winding_line(random, line[-1], leaving, random.uniform(6e-3, 9e-3), 150.0)[1:]])
        hidden = needle.distances(line[::4][8:]) < 0.5 * needle.width
        if is_inside(line) and 4 * TURN_STEP * hidden.sum() > 1.5e-3 and arc_lengths(line)[-1] < 0.034:
            return Case(needle, line, lighting=random_lighting(random))
    raise RuntimeError("no thread fits below the needle")


def _hand_instrument(random: Random) -> Case:
    """Return an instrument that a hand holds over the thread."""
    for _ in range(MAX_TRIES):
        case = usual_case(random, thread=0.026)
        at = points_at(case.thread, np.array([random.uniform(6e-3, 20e-3)]))[0]
        outward = at / max(float(np.hypot(*at)), 1e-6)
        way = math.cos(lean := random.uniform(-0.8, 0.8)) * outward + math.sin(lean) * np.array(
            [-outward[1], outward[0]]
        )
        instrument = straight_strip(at - 2e-3 * way, way, 0.06, random.uniform(1.5e-3, 3e-3))
        hand = straight_strip(at + random.uniform(6e-3, 10e-3) * way, way, 0.06, random.uniform(8e-3, 14e-3))
        if _off_needle(case, instrument, hand):
            return replace(case, hidden_by=(Cover(instrument, STEEL_BGR, 1.0), Cover(hand, SKIN_BGR, 2.5)))
    raise RuntimeError("no instrument fits")


COVERED_CLASSES: dict[str, MakeCase] = {
    "two_covers": _two_covers,
    "cover_end": _cover_end,
    "cover_crossing": _cover_crossing,
    "glare_thread": _glare_thread,
    "below_needle": _below_needle,
    "hand_instrument": _hand_instrument,
}
