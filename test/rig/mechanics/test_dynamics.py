"""Needle and thread in motion, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread import Polygon
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, Surface, ThreadProperties

Vector = NDArray[np.float64]
NEEDLE = NeedleBody(7e-3, 4e-4, 0.0, 1e6, 1.0)
POLYAMIDE = ThreadProperties(19e-3, 60, 1.2723e-9, 5.65, 0.974, 0.487, NeedleJoint.PINNED, diameter=60e-6)
CLAMPED = replace(POLYAMIDE, attachment=NeedleJoint.CLAMPED)
SLIGHT = ThreadProperties(1e-3, 4, 1e-14, 1e-3, 1e-7, 5e-8, NeedleJoint.PINNED)
OPEN = Surface()
FRAME = 1.0 / 60.0
SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


class PlainField:
    """A field that is not of coils: B = I (b + g (x, -y)), for closed forms."""

    def __init__(self, constant: tuple[float, float], gradient: float) -> None:
        self._constant, self._gradient = np.array(constant), gradient

    def at(self, point: Vector, currents: Vector) -> Vector:
        return np.asarray(currents[0] * (self._constant + self._gradient * point * [1.0, -1.0]))


def rig(
    thread: ThreadProperties = POLYAMIDE,
    *,
    surface: Surface = OPEN,
    field: PlainField | None = None,
    heading: float = 0.0,
    points: Vector | None = None,
    largest_step: float = 2e-3,
) -> RigDynamics:
    """Return a rig whose thread, where no points are given, lies straight behind the needle."""
    if points is None:
        points = np.outer([0.0, -thread.length], [math.cos(heading), math.sin(heading)])
    return RigDynamics(NEEDLE, thread, surface, field, points[0], heading, points, largest_step=largest_step)


@pytest.mark.parametrize(("attachment", "root"), [(NeedleJoint.PINNED, 3.926602), (NeedleJoint.CLAMPED, 1.875104)])
def test_a_bent_thread_relaxes_as_its_slowest_mode(attachment: NeedleJoint, root: float):
    # Against a needle that is held: EI k^4 / drag, with tan kL = tanh kL, or cos kL cosh kL = -1.
    thread = replace(POLYAMIDE, attachment=attachment)
    k, s = root / thread.length, np.linspace(0.0, thread.length, 800)
    if attachment is NeedleJoint.PINNED:
        shape = np.sin(k * s) / math.sin(root) + np.sinh(k * s) / math.sinh(root)
    else:
        ratio = (math.cosh(root) + math.cos(root)) / (math.sinh(root) + math.sin(root))
        shape = np.cosh(k * s) - np.cos(k * s) - ratio * (np.sinh(k * s) - np.sin(k * s))
    made = rig(thread, points=np.column_stack([-s, 2e-4 * shape / np.abs(shape).max()]))
    rate = thread.bending_stiffness * k**4 / thread.drag_across
    heights = []
    for _ in range(6):
        made.drive((0.0, 0.0), 0.0, 0.2 / rate)
        heights.append(made.thread[-1, 1])
    decay = -np.log(np.array(heights[1:]) / np.array(heights[:-1]))
    np.testing.assert_allclose(decay[1:], 0.2, rtol=4e-3)


def test_a_needle_in_a_uniform_gradient_moves_at_its_mobility():
    made = rig(SLIGHT, field=PlainField((0.1, 0.0), 0.5))
    for _ in range(60):
        made.step([1.0], FRAME)
    speed = NEEDLE.pole * 0.5 * NEEDLE.length / NEEDLE.drag[0]
    assert made.tail[0] == pytest.approx(speed, rel=1e-4)
    assert abs(made.tail[1]) < 1e-9
    assert abs(made.heading) < 1e-9


def test_a_needle_turns_into_a_uniform_field():
    made = rig(SLIGHT, field=PlainField((0.005, 0.0), 0.0), heading=2.0, largest_step=5e-4)
    middle = made.tail + 0.5 * (made.tip - made.tail)
    # d angle / dt = -rate sin angle, and no force: the middle stays.
    rate = NEEDLE.pole * NEEDLE.length * 0.005 / NEEDLE.drag[2]
    for _ in range(6):
        made.step([1.0], FRAME)
    expected = 2.0 * math.atan(math.tan(1.0) * math.exp(-rate * made.time))
    assert made.heading == pytest.approx(expected, rel=2e-4)
    np.testing.assert_allclose(made.tail + 0.5 * (made.tip - made.tail), middle, atol=1e-6)


@pytest.mark.parametrize("heading", [0.0, 0.6])
def test_the_wall_stops_the_needle(heading: float):
    surface = Surface(wall_radius=17.5e-3)
    made = rig(surface=surface, heading=heading, field=PlainField((0.05, 0.0), 1.0))
    for _ in range(120):
        made.step([1.0], FRAME)
    assert np.hypot(*made.tip) == pytest.approx(17.3e-3, abs=2e-6)
    before = made.tip
    made.step([1.0], FRAME)
    # Nothing rubs, so one that does not stand upright on the wall creeps along it.
    assert np.linalg.norm(made.tip - before) < (1e-9 if heading == 0.0 else 1e-5)
    assert np.hypot(*made.thread.T).max() < 17.5e-3


def test_the_thread_goes_round_an_obstacle():
    square = 2e-3 * SQUARE
    start = np.array([[-1e-3, 2.5e-3], [-20e-3, 2.5e-3]])
    made = rig(surface=Surface(polygons=(Polygon(tuple(map(tuple, square))),)), points=start)
    # Once around and off to the left below, so that the thread is pulled over two corners.
    path = 3.2e-3 * np.array([[-0.3, 0.8], [1.2, 1.0], [1.2, -1.2], [-4.0, -1.2]])
    path[0] = start[0]
    corners = np.concatenate([np.linspace(a, b, 60)[1:] for a, b in pairwise(path)])
    radius, deepest, touched = 0.5 * POLYAMIDE.diameter, 0.0, 0
    for place in corners:
        made.drive(place, 0.0, float(np.linalg.norm(place - made.tail)) / 4e-3)
        outside = np.abs(made.thread[1:]) - 2e-3
        gap = np.hypot(*np.maximum(outside, 0.0).T) + np.minimum(outside.max(axis=1), 0.0)
        # Corners do not cut the thread between its nodes either.
        for corner in square:
            a, b = made.thread[:-1], made.thread[1:]
            part = np.clip(np.sum((corner - a) * (b - a), axis=1) / np.sum((b - a) ** 2, axis=1), 0.0, 1.0)
            near = a + part[:, None] * (b - a)
            gap = np.append(gap, np.linalg.norm(near - corner, axis=1))
            assert not (np.abs(near) < 2e-3).all(axis=1).any()
        deepest, touched = max(deepest, radius - float(gap.min())), touched + int(gap.min() < radius + 2e-6)
    assert touched > 60
    assert deepest < 1e-6
    assert np.abs(made.tension).max() / POLYAMIDE.stretching_stiffness < 1e-3
    # It hangs over the far side.
    assert made.thread[:, 0].max() > 2e-3
