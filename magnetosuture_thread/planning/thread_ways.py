"""Ways of the needle by which the thread comes to lie as a goal asks: candidates, and what forecasts make of them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.forecast.forecaster import ForecastStart, ThreadForecaster
from magnetosuture_thread.forecast.published import follow_plan
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, chain_inside, points_at
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.procedure import BringEnd, Lay, TakeOff, ThreadGoal, Unwind
from magnetosuture_thread.planning.verdict import part_along, resampled
from magnetosuture_thread.thread.prediction import NeedlePose

Vector = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A way of the needle, which is corrected by what a forecast makes of it.

    The needle winds the thread, or goes to a place, leads the thread along a line, and goes on from place to place,
    whichever is given; or it goes a path that is known.

    Attributes:
        path: x, y [m] and angle [rad] of the chord, shape (k, 3); empty for none.
        via: x and y of a place [m]; empty for none.
        more: that is wound beyond what is missing [rad]; NaN where nothing is wound.
        line: which the tail is to follow, shape (k, 2) [m]; empty for none.
        passes: of the line, to and fro, the last one in its direction: each leaves the thread straighter.
        onward: places, shape (j, 2) [m].
    """

    path: Points = field(default_factory=lambda: np.empty((0, 3)))
    via: Vector = field(default_factory=lambda: np.empty(0))
    more: float = math.nan
    line: Points = field(default_factory=lambda: np.empty((0, 2)))
    passes: int = 1
    onward: Points = field(default_factory=lambda: np.empty((0, 2)))

    def places(self, lever: float, before: float, beyond: float) -> Points:
        """Return all places that the middle of the needle goes to, see `line_places`, shape (k, 2) [m]."""
        parts = [self.via.reshape(-1, 2)]
        for k in range(self.passes if len(self.line) else 0, 0, -1):
            parts.append(line_places(self.line if k % 2 else self.line[::-1], lever, before, beyond))
        return np.vstack([*parts, self.onward])

    def corrected(self, goal: ThreadGoal, thread: Points, left: float) -> Candidate | None:
        """Return the candidate moved against the error that a forecast of it shows; None where that is not possible.

        Args:
            goal: that is missed.
            thread: as it is forecast to lie, the tail first, shape (n + 1, 2) [m].
            left: by how much its winding has to change [rad].
        """
        if isinstance(goal, Lay) and len(self.line):
            wanted = resampled(np.reshape(goal.along, (-1, 2)))
            part = part_along(thread, wanted, goal.stretch)
            part = points_at(part, np.linspace(0.0, arc_lengths(part)[-1], 400))
            nearest = np.linalg.norm(wanted[:, None] - part, axis=2).argmin(axis=1)
            # Smoothed over a twentieth of the line, as a thread has no corners.
            error = gaussian_filter1d(part[nearest] - wanted, 2.0, axis=0, mode="nearest")
            is_reversed = np.linalg.norm(self.line[0] - wanted[0]) > np.linalg.norm(self.line[0] - wanted[-1])
            return replace(self, line=self.line - (error[::-1] if is_reversed else error))
        if isinstance(goal, BringEnd):
            return replace(self, via=self.via - (thread[-1] - goal.position)) if len(self.via) else None
        return None if math.isnan(self.more) else replace(self, more=self.more + left)

    def varied(self, rng: np.random.Generator, scale: float) -> Candidate:
        """Return the candidate with all that it has moved at random.

        Args:
            rng: random numbers.
            scale: of the variation: 1 is a move of 2 mm of each place, of 1 mm of the line, and of half a radian.
        """
        # A line is moved, turned and bent, a path so that it begins where it did.
        share = np.linspace(-1.0, 1.0, len(self.line))[:, None] ** np.arange(3)
        ahead = np.linspace(0.0, 1.0, len(self.path))[:, None] ** np.arange(1, 4)
        moved = np.column_stack([2e-3 * scale * ahead @ rng.standard_normal((3, 2)), np.zeros(len(self.path))])
        return replace(
            self,
            path=self.path + moved,
            via=self.via + 2e-3 * scale * rng.standard_normal(len(self.via)),
            more=self.more + 0.5 * scale * rng.standard_normal(),
            line=self.line + 1e-3 * scale * share @ rng.standard_normal((3, 2)),
            onward=self.onward + 2e-3 * scale * rng.standard_normal(2),
        )


def candidates(goal: ThreadGoal, reach: float) -> Iterator[Candidate]:
    """Return ways to try for a goal of the thread.

    Places that the needle goes by or on to are around the dish, near the wall or halfway. On it goes either way round,
    until the thread has followed.

    Args:
        goal: of the thread.
        reach: distance from the dish's centre that the middle of the needle may be at [m].
    """
    around = np.linspace(0.0, 2.0 * math.pi, 9)
    rings = [
        share * reach * np.column_stack([np.cos(start + sense * around), np.sin(start + sense * around)])
        for share in (0.8, 0.4)
        for start in np.linspace(0.0, 1.5 * math.pi, 4)
        for sense in (1.0, -1.0)
    ]
    if isinstance(goal, Lay):
        line = resampled(np.reshape(goal.along, (-1, 2)))
        for way in (line, line[::-1]):
            yield from (Candidate(line=way, passes=passes) for passes in (1, 2, 3, 4))
            yield from (Candidate(line=way, via=place) for place in rings[0][:8])
            if goal.stretch:
                yield from (Candidate(line=way, onward=ring) for ring in rings[:8])
    elif isinstance(goal, BringEnd):
        yield from (Candidate(onward=ring) for ring in rings)
        # Pulled round a bend the end comes to lie farther inside than the needle went.
        vias = [share * np.array(goal.position) for share in (1.0, 1.5)]
        yield from (Candidate(via=via, onward=ring) for via in vias for ring in rings)
    else:
        if not isinstance(goal, TakeOff):
            yield Candidate(more=0.0)
        if isinstance(goal, Unwind | TakeOff):
            yield from (Candidate(onward=ring) for ring in rings[:8])
        if isinstance(goal, TakeOff):
            yield from (Candidate(more=0.0, onward=ring) for ring in rings[:8])


def line_places(line: Points, lever: float, before: float, beyond: float) -> Points:
    """Return where the middle of a needle is to go, 2 mm apart, so that its tail follows a line, shape (k, 2) [m].

    Args:
        line: shape (m, 2) [m].
        lever: half of the needle's chord [m].
        before: by how much the line is led on straight at its begin [m].
        beyond: the same at its end [m].
    """
    steps = np.diff(line, axis=0)
    along = steps / np.maximum(np.linalg.norm(steps, axis=1)[:, None], 1e-12)
    whole = np.vstack([line[:1] - before * along[0], line, line[-1:] + (beyond + lever) * along[-1]])
    length = float(arc_lengths(whole)[-1])
    return points_at(whole, np.linspace(lever, length, max(2, math.ceil(length / 2e-3))))


class ThreadRollout:
    """Forecasts how the thread lies while the needle goes a path.

    Args:
        forecaster: of needle and thread.
        needle: its kinematics.

    Attributes:
        steps: of forecasts so far.
    """

    def __init__(self, forecaster: ThreadForecaster, needle: NeedleKinematics) -> None:
        self._forecaster, self._needle, self.steps = forecaster, needle, 0

    def threads(self, path: BodyPath, speed: float, thread: Points) -> Iterator[tuple[float, Points]]:
        """Return ways on a path [m], about 1 mm apart, each with the thread then, shape (n + 1, 2) [m].

        A thread in a liquid lies the same at any speed, but for its stiffness: very slow or fast needles are taken for
        ones between 1 and 5 mm/s.

        Args:
            path: of the needle, which is at its begin.
            speed: of the tip on it [m/s].
            thread: the tail first, shape (k, 2) [m]; empty for one straight behind the needle.

        Raises:
            InvalidInputError: needle or thread lie where they cannot.
        """
        step, speed = self._forecaster.step, min(max(speed, 1e-3), 5e-3)
        plan = path.poses
        pose, start, way = plan[0], self._start(plan[0], thread), 0.0
        yield 0.0, start.vertices
        every = round(1e-3 / (speed * step))
        while way < path.length:
            # In parts of 10 s, as what is good enough ends it.
            steps = min(math.ceil(10.0 / step), math.ceil((path.length - way) / (speed * step)))
            commands = follow_plan(plan, path.travel, path.lever, pose, way, speed, step, steps)
            forecast = self._forecaster.forecast(start, commands, steps * step, slowed=False)
            self.steps += steps
            done = len(forecast.filtered)
            for k in sorted({*range(every, done + 1, every), done}):
                yield min(path.length, way + k * speed * step), forecast.vertices[k]
            if done < steps:
                return
            way += steps * speed * step
            tail, heading = forecast.tails[-1], forecast.headings[-1]
            start = ForecastStart(NeedlePose(0.0, tail, heading), forecast.vertices[-1].copy())
            along = self._needle.chord_direction(heading)
            pose = np.array([*(tail + path.lever * along), math.atan2(along[1], along[0])])

    def _start(self, pose: Vector, thread: Points) -> ForecastStart:
        along = np.array([math.cos(pose[2]), math.sin(pose[2])])
        own, tail = self._forecaster.thread, pose[:2] - 0.5 * self._needle.chord * along
        # The heading at the tail is turned from the chord by half of the needle's bend.
        bend = self._needle.chord_direction(np.array([1.0, 0.0]))
        at = NeedlePose(0.0, tail, np.array([along @ bend, bend[0] * along[1] - bend[1] * along[0]]))
        start = self._forecaster.straight(at)
        if not len(thread):
            return start
        gap = math.dist(thread[0], start.vertices[0])
        if gap > 0.5 * own.segment_length or len(thread) != own.segments + 1:
            radius = self._forecaster.scene.dish.radius - 0.5 * own.diameter
            line = np.vstack([start.vertices[:1], thread])
            thread = chain_inside(line, own.segments, own.segment_length, radius)
        return ForecastStart(at, thread)
