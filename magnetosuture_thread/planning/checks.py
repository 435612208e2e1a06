"""What of a procedure can be seen to be impossible in a scene, before any path is planned."""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING

import numpy as np

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.planning.clearance_map import body_clearance
from magnetosuture_thread.planning.lattice import DIRECTIONS, turn_of
from magnetosuture_thread.planning.procedure import (
    HEADING_TOLERANCE,
    GoTo,
    PassThrough,
    Procedure,
    Tighten,
    Withdraw,
    Wrap,
)

if TYPE_CHECKING:
    from magnetosuture_thread.planning.planner import NeedlePlanner


def check_procedure(procedure: Procedure, planner: NeedlePlanner) -> None:
    """Refuse what can be seen to be impossible without planning.

    Args:
        procedure: to check.
        planner: of the scene and the needle.

    Raises:
        ConfigurationError: a name is not of the scene, a place is not free, a gap is too narrow or not there, the
            thread is too short for wraps that follow each other, or a tension is over the goal's own limit.
    """
    wrapped: defaultdict[str, float] = defaultdict(float)  # about each shape, by the wraps one after the other
    for index, (goal, limits) in enumerate(zip(procedure.goals, procedure.limits, strict=True)):
        where, required = f"goals[{index}].{goal.GROUP}", max(planner.keep_out, limits.clearance)
        if not isinstance(goal, Wrap):
            wrapped.clear()  # another goal may unwind the thread
        if isinstance(goal, PassThrough):
            _check_gap(planner, where, goal, required)
        elif isinstance(goal, Wrap):
            _check_name(planner, f"{where}.around", goal.around)
            wrapped[goal.around] += goal.swept
            needed = sum(abs(angle) / (2.0 * math.pi) * planner.girth(name) for name, angle in wrapped.items())
            if needed > planner.thread_length:
                before = ", with the wraps before it" if index and isinstance(procedure.goals[index - 1], Wrap) else ""
                expected = f"an angle for which {1e3 * planner.thread_length:.3g} mm of thread are enough{before}"
                raise ConfigurationError(f"{where}.angle", goal.angle, expected)
        elif isinstance(goal, Tighten):
            if goal.around:
                _check_name(planner, f"{where}.around", goal.around)
            if goal.tension > limits.tension:
                expected = f"at most the limit of the tension, {limits.tension:.3g} N"
                raise ConfigurationError(f"{where}.tension", goal.tension, expected)
            _check_place(planner, f"{where}.toward", goal.toward, required)
        elif isinstance(goal, GoTo):
            _check_place(planner, f"{where}.position", goal.position, required)
            if goal.heading:
                _check_place(planner, f"{where}.position", goal.position, required, goal.heading[0])
        elif isinstance(goal, Withdraw) and goal.to:
            _check_place(planner, f"{where}.to", goal.to, required)


def _check_gap(planner: NeedlePlanner, where: str, goal: PassThrough, required: float) -> None:
    for name in goal.between:
        _check_name(planner, f"{where}.between", name)
    between = planner.gaps_between(*goal.between)
    if not between:
        expected = "two shapes with a gap between them, in which no other shape lies"
        raise ConfigurationError(f"{where}.between", list(goal.between), expected)
    gaps = planner.gaps(goal)
    if not gaps:
        x, y = np.round(min(between, key=lambda gap: gap.width).along, 2) + 0.0
        expected = f"one along a gap between them, as [{x:g}, {y:g}] or [{0.0 - x:g}, {0.0 - y:g}]"
        raise ConfigurationError(f"{where}.direction", list(goal.direction), expected)
    width = max(gap.width for gap in gaps)
    if width <= 2.0 * required:
        expected = f"a gap wider than {2e3 * required:.3g} mm, twice the needle's clearance"
        raise ConfigurationError(f"{where}.between", f"a gap of {1e3 * width:.3g} mm", expected)


def _check_name(planner: NeedlePlanner, where: str, name: str) -> None:
    names = planner.scene.names
    if name not in names:
        raise ConfigurationError(where, name, f"a shape of the scene: {', '.join(names) or 'it has none'}")


def _check_place(
    planner: NeedlePlanner, where: str, place: tuple[float, ...], required: float, heading: float | None = None
) -> None:
    (x, y), directions, words = place, DIRECTIONS, "in some direction"
    if heading is not None:
        directions, words = DIRECTIONS[np.abs(turn_of(DIRECTIONS - heading)) <= HEADING_TOLERANCE], "at its heading"
    if not any(body_clearance(x, y, angle, planner.body, planner.near) >= required for angle in directions):
        expected = f"a place with {1e3 * required:.3g} mm around the needle {words}"
        raise ConfigurationError(where, [x, y], expected)
