"""Where a walk could have gone on along another strand, and the way that it takes there; see `arms`."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.compiled import compiled
from magnetosuture_thread.geometry.polyline import arc_lengths
from magnetosuture_thread.vision.sampling import within
from magnetosuture_thread.vision.thread.appearance import runs
from magnetosuture_thread.vision.thread.arms import (
    RADIUS_PX,
    SHOWN,
    Arm,
    arm_of,
    continuations,
    find_arms,
    joining_curve,
    walk_along,
    without_walked,
)
from magnetosuture_thread.vision.thread.ridge import Ridge
from magnetosuture_thread.vision.thread.walk import STEP_PX

RING = 48  # places around a vertex where other strands are looked for
REACH = round(RADIUS_PX / STEP_PX)  # vertices
MAX_GAP = 3  # vertices without another strand within a crossing
FORK = 3  # arms, where two strands become one
MERGED = 24  # vertices, over which two strands may be seen as one
MAX_TURN = 1.5  # rad; of the arms within a crossing's length, beyond which the walk's way isn't overruled
MAX_CROSSINGS = 16


@dataclass(frozen=True)
class Crossing:
    """A place where a walk could have gone on along another strand.

    Attributes:
        first: vertex of the walk's path where it enters.
        last: vertex where it leaves.
        confidence: how probable the way is that was taken, 0 to 1.
    """

    first: int
    last: int
    confidence: float


def resolve_crossings(
    ridge: Ridge,
    dish: tuple[float, float, float],
    max_length: float,
    path: NDArray[np.float64],
    strong: NDArray[np.bool_],
    count: int,
) -> tuple[int, tuple[Crossing, ...]]:
    """Take the most probable way wherever other strands meet a path, and walk on from there.

    Strands meet where more than two of them cross a ring around the path's vertices. Where three arms meet, and soon
    after that three again, two strands are merged in between: both places are one crossing.

    Args:
        ridge: that is followed.
        dish: see `walk_on`.
        max_length: of the path [px].
        path: see `walk_on`; changed where another way is taken.
        strong: see there.
        count: vertices that there are.

    Returns:
        The number of vertices, and the crossings in their order.
    """
    crossings: list[Crossing] = []
    begin = 1
    for _ in range(MAX_CROSSINGS):
        places = _meetings(ridge, path[:count], begin)
        if not places:
            break
        low, high = places.pop(0)
        arms = find_arms(ridge, dish, path[low - 1 : high])
        if len(arms) == FORK and places and places[0][0] - high <= MERGED:
            after, end = places[0]
            if len(find_arms(ridge, dish, path[after - 1 : end])) == FORK:
                high, arms = end, find_arms(ridge, dish, path[low - 1 : end])
        begin = high + REACH
        first, beyond = max(0, low - 2 * REACH), min(count, high + 2 * REACH)
        entry = arm_of(arms, path[first : low + 1], leaving=False)
        if len(arms) < 3 or entry < 0:
            continue
        # Bending energies mean little beyond small turns and where an arm is missing. The walk knows the inside better:
        # it isn't overruled, only doubted.
        turn = (path[high - 1, 5] - path[low - 1, 5]) * float(np.mean([abs(arm.curvature) for arm in arms]))
        overrules = turn < MAX_TURN and len(arms) % 2 == 0
        arms, entry = without_walked(arms, entry, path[:first, :2])
        taken = arm_of(arms, path[high - 1 : beyond], leaving=True)
        chances = continuations(ridge, dish, (float(path[low, 5]), max_length), arms, entry)
        best = int(np.argmax(chances))
        if best == entry:  # The thread ends here, or nothing that is seen goes on from it.
            ends = taken < 0 and count <= high + 2 * REACH
            crossings.append(
                Crossing(low, high, float(chances[entry if ends else taken]) if ends or taken >= 0 else 0.0)
            )
            continue
        if best != taken and not overrules:
            crossings.append(Crossing(low, high, 0.0 if taken < 0 else float(chances[taken])))
            continue
        if best == taken:
            crossings.append(Crossing(low, high, float(chances[best])))
            continue
        away = np.hypot(*(path[first : low + 1, :2] - arms[entry].start).T)
        count, begin = _turn(path, strong, first + int(np.argmin(away)) + 1, arms[entry], arms[best])
        crossings.append(Crossing(low, begin, float(chances[best])))
        begin += REACH
        longer = np.flatnonzero(path[:count, 5] > max_length)
        if len(longer):
            count = max(2, int(longer[0]))
            break
        count = walk_along(ridge, dish, max_length, path, strong, count)
    return count, tuple(crossing for crossing in crossings if crossing.first < count)


def _meetings(ridge: Ridge, path: NDArray[np.float64], begin: int) -> list[tuple[int, int]]:
    """Return first vertex and the one after the last of each place from a vertex on where strands meet a path."""
    meets = np.zeros(max(0, len(path) - begin), np.bool_)
    if not len(meets):
        return []
    strands_meet(ridge.strength, ridge.hidden, ridge.factor, ridge.noise, ridge.faintest, path[begin:], meets)
    for first, last in runs(~meets):
        if first > 0 and last < len(meets) and last - first <= MAX_GAP:
            meets[first:last] = True
    return [(begin + first, begin + last) for first, last in runs(meets)]


@compiled
def strands_meet(strength, hidden, factor, noise, faintest, path, meets):
    """Fill in at which vertices of a path more than two strands cross a ring around them, of which nothing is hidden.

    Args:
        strength: of the ridge, uint8.
        hidden: where nothing can be seen, not 0 there, `factor` times smaller.
        factor: see `hidden`.
        noise: strength where nothing is.
        faintest: a strength above noise that is no noise.
        path: shape (m, 6), see `walk_on`.
        meets: filled, shape (m,).
    """
    rows, columns = hidden.shape
    values, ways = np.empty(RING), np.empty((RING, 2))
    for place in range(RING):
        ways[place, 0] = RADIUS_PX * math.cos(2.0 * math.pi * place / RING)
        ways[place, 1] = RADIUS_PX * math.sin(2.0 * math.pi * place / RING)
    for index in range(len(path)):
        meets[index] = False
        is_covered = False
        for place in range(RING):
            u, v = path[index, 0] + ways[place, 0], path[index, 1] + ways[place, 1]
            column = min(max(int(u + 0.5) // factor, 0), columns - 1)
            row = min(max(int(v + 0.5) // factor, 0), rows - 1)
            if hidden[row, column] != 0:
                is_covered = True
                break
            values[place] = within(strength, u, v) - noise
        if is_covered:
            continue
        bound, peaks = max(SHOWN * path[index, 4], faintest), 0
        for place in range(RING):
            value = values[place]
            if value <= bound:
                continue
            before = value > values[place - 1] and value > values[place - 2]
            after = value >= values[(place + 1) % RING] and value >= values[(place + 2) % RING]
            peaks += before and after
        meets[index] = peaks > 2


def _turn(path: NDArray[np.float64], strong: NDArray[np.bool_], at: int, entry: Arm, out: Arm) -> tuple[int, int]:
    """Lead a path from a vertex on from one arm to another; return how many vertices it has, and where that begins."""
    curve = joining_curve(entry, out)[1:]
    rows = np.vstack([np.zeros((len(curve), 6)), out.path[1:]])[: len(path) - at]
    shown = np.concatenate([np.ones(len(curve), np.bool_), out.strong[1:]])[: len(rows)]
    curve = curve[: len(rows)]
    along = np.gradient(np.vstack([path[at - 1, :2], curve]), axis=0)[1:]
    rows[: len(curve), :2], rows[: len(curve), 2] = curve, np.arctan2(along[:, 1], along[:, 0])
    rows[: len(curve), 3], rows[: len(curve), 4] = out.curvature, path[at - 1, 4]
    count = at + len(rows)
    path[at:count], strong[at:count] = rows, shown
    path[at - 1 : count, 5] = path[at - 1, 5] + arc_lengths(path[at - 1 : count, :2])
    return count, at + len(curve)
