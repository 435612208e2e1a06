"""Classes of frames with another suture thread in the dish, which looks like the needle's own and does not leave it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.vision.cases import (
    MAX_TRIES,
    MakeCase,
    Random,
    is_inside,
    unit_vector,
    usual_case,
    winding_line,
)
from benchmarks.vision.frames import Case, drawn_thread
from magnetosuture_thread.geometry.polyline import Points, arc_lengths

STEEP, SHALLOW = (30.0, 90.0), (10.0, 30.0)  # degrees; at which the other thread crosses the needle's
CROSSING_AT = (3e-3, 15e-3)  # m; of the thread's arc length
LENGTHS = (12e-3, 22e-3)  # m; of the other thread
CLEARANCE = 1.2e-3  # m; of the other thread from the needle
BENDS = 200.0  # 1/m; of the other thread, at most
BESIDE = (0.6e-3, 2.0e-3)  # m; from a thread to one that comes near without a crossing


def _apart(one: Points, other: Points) -> np.ndarray:
    return np.asarray(np.linalg.norm(one[:, None] - other[None], axis=2))


def _crossed(low: float, high: float, random: Random) -> Case:
    """Return the usual frame with another thread that crosses the needle's once, at an angle of some degrees."""
    for _ in range(MAX_TRIES):
        case = usual_case(random)
        at = int(np.searchsorted(arc_lengths(case.thread), random.uniform(*CROSSING_AT)))
        along = case.thread[at + 1] - case.thread[at - 1]
        angle = math.radians(random.uniform(low, high)) * random.choice((-1.0, 1.0))
        way, place = math.atan2(along[1], along[0]) + angle, case.thread[at]
        halves = [
            winding_line(random, place, way + turn, 0.5 * random.uniform(*LENGTHS), BENDS) for turn in (math.pi, 0)
        ]
        other = np.vstack([halves[0][::-1], halves[1][1:]])
        apart = _apart(other[::4], case.thread[::4])
        near = np.flatnonzero(
            (apart.min(axis=1) < 0.5e-3) & (np.abs(4 * np.arange(len(other[::4])) - len(halves[0])) > 4)
        )
        # Nowhere near but where it crosses: as long as two lines at that angle are.
        reach = 0.8e-3 / math.sin(abs(angle))
        again = np.abs(arc_lengths(other)[::4][near] - arc_lengths(halves[0])[-1]) > reach
        if is_inside(other) and not again.any() and case.needle.distances(other[::4]).min() > CLEARANCE:
            return _with(case, other, {"angle": math.degrees(angle)})
    raise RuntimeError("no second thread fits into the dish")


def _beside(random: Random) -> Case:
    """Return the usual frame with another thread that runs beside the needle's for a while and does not touch it."""
    for _ in range(MAX_TRIES):
        case = usual_case(random)
        at = int(np.searchsorted(arc_lengths(case.thread), random.uniform(*CROSSING_AT)))
        along = case.thread[at + 1] - case.thread[at - 1]
        direction = math.atan2(along[1], along[0])
        side = random.choice((-1.0, 1.0)) * random.uniform(*BESIDE)
        place = case.thread[at] + side * unit_vector(direction + 0.5 * math.pi)
        halves = [
            winding_line(random, place, direction + turn, 0.5 * random.uniform(*LENGTHS), BENDS)
            for turn in (math.pi, 0)
        ]
        other = np.vstack([halves[0][::-1], halves[1][1:]])
        clear = _apart(other[::4], case.thread[::4]).min() > 0.9 * BESIDE[0]
        if clear and is_inside(other) and case.needle.distances(other[::4]).min() > CLEARANCE:
            return _with(case, other, {"distance": abs(side)})
    raise RuntimeError("no second thread fits into the dish")


def _with(case: Case, other: Points, labels: dict[str, float]) -> Case:
    width = case.thread_px * case.view.metres_per_pixel
    return replace(case, hidden_by=(drawn_thread(other, width, case.thread_bgr),), labels=labels)


SECOND_THREAD_CLASSES: dict[str, MakeCase] = {
    "second_thread": partial(_crossed, *STEEP),
    "second_thread_shallow": partial(_crossed, *SHALLOW),
    "second_thread_beside": _beside,
}
