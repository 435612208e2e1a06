"""What a forecast goes by, the plan of the needle or the command that is held, and whether it is good enough."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.estimator.estimator import ThreadEstimate
from magnetosuture_thread.forecast.forecaster import Forecast, ForecastStart, ThreadForecaster
from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.geometry.polyline import Points, Vector
from magnetosuture_thread.thread.prediction import NeedlePose

APPROACH = 4.0  # 1/s; at which a needle that is off its plan comes back to it


@compiled
def follow_plan(
    plan: Points, travel: Vector, lever: float, pose: Vector, begin: float, speed: float, step: float, steps: int
) -> Points:
    """Return the velocity of the tip in each step of a needle that follows a plan, shape (k, 2) [m/s].

    With the planned pose (p, theta_p) at the way s, which grows by the speed w, and the drive d and rate r of the plan
    for each metre of that way, the middle x and angle theta of the chord move with

        u = w d + k (p - x) . e(theta),    omega = w r + k (theta_p + atan(d y / lever) - theta)

    where y is the error across the plan, to its left, and k is `APPROACH`.

    Args:
        plan: x, y [m] and angle [rad] of the chord at each pose, shape (m, 3).
        travel: way of the tip up to each pose, rising, shape (m,) [m].
        lever: half of the chord [m].
        pose: x, y and angle of the chord now, shape (3,).
        begin: way of the tip at which the needle is [m].
        speed: w, until the end of the plan [m/s].
        step: [s]
        steps: k.
    """
    x, y, angle, at, i = pose[0], pose[1], pose[2], begin, 1
    velocities = np.zeros((steps, 2))
    for k in range(steps):
        ahead = min(travel[-1], at + speed * step)
        while i < len(travel) - 1 and travel[i] < ahead:
            i += 1
        length, w = max(travel[i] - travel[i - 1], 1e-12), (ahead - at) / step
        share = (ahead - travel[i - 1]) / length
        along, left, turned = plan[i, 0] - plan[i - 1, 0], plan[i, 1] - plan[i - 1, 1], plan[i, 2] - plan[i - 1, 2]
        off_x, off_y = plan[i - 1, 0] + share * along - x, plan[i - 1, 1] + share * left - y
        planned = plan[i - 1, 2] + share * turned
        c, s = math.cos(planned), math.sin(planned)
        drive, rate = (along * c + left * s) / length, turned / length
        turn = planned + math.atan(drive * (c * off_y - s * off_x) / lever) - angle
        turn -= 2.0 * math.pi * math.floor(0.5 * turn / math.pi + 0.5)
        e_x, e_y = math.cos(angle), math.sin(angle)
        u, omega = w * drive + APPROACH * (off_x * e_x + off_y * e_y), w * rate + APPROACH * turn
        velocities[k, 0], velocities[k, 1] = u * e_x - lever * omega * e_y, u * e_y + lever * omega * e_x
        x, y, angle, at = x + step * u * e_x, y + step * u * e_y, angle + step * omega, ahead
    return velocities


class NeedlePlan:
    """Poses that the needle is to go through, where it is on them, and how fast it gets on.

    The way s is that of the tip in the needle's frame, |dx| + lever |dangle| summed up. The needle is at the nearest
    pose by that measure, within `lever` of where it was if it was near there; of poses that are about as near, as where
    a plan goes back over itself, at one from which the plan goes on as the needle is commanded. Its speed is measured
    over the time T,

        w = sum of exp(-age / T) ds / sum of exp(-age / T) dt

    as friction, tension and the coils slow it: a plan has no times. Until 0.3 s are measured, it is the commanded one.

    Args:
        poses: x, y [m] and angle [rad] of the chord, shape (m, 3), m >= 2.
        lever: half of the chord [m].
        speed: measured on the plan before, as its two sums [m, s].

    Attributes:
        poses: with angles that do not jump.
        at: s of the needle [m].
        speed: the two sums.
    """

    def __init__(self, poses: Points, lever: float, speed: tuple[float, float] = (0.0, 0.0)) -> None:
        self.poses, self._lever = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]), lever
        steps = np.diff(self.poses, axis=0) * (1.0, 1.0, lever)
        lengths = np.hypot(steps[:, 0], steps[:, 1]) + np.abs(steps[:, 2])
        self._travel = np.concatenate([[0.0], np.cumsum(lengths)])
        ways = steps / np.maximum(lengths, 1e-12)[:, None]
        self._ways = np.concatenate([ways, ways[-1:]])  # for each metre, from each pose on
        self.at, self.speed = 0.0, speed
        self._error, self._commanded, self._stamp = math.inf, 0.0, math.inf  # from the plan [m]; its part along it; [s]

    def rest(self) -> None:
        """Forget how fast a needle got on that is not commanded any more."""
        self._stamp, self.speed = math.inf, (0.0, 0.0)

    def update(self, stamp: float, pose: Vector, command: Vector, memory: float) -> bool:
        """Take where the needle is; return whether it follows the plan: it is near, not at the end, and gets on.

        Args:
            stamp: of the pose [s].
            pose: of the chord, shape (3,).
            command: velocity of its middle, and `lever` times its turn rate, shape (3,) [m/s].
            memory: T [s].
        """
        was_near = self._error < self._lever
        reach = self._lever if was_near else math.inf
        first, last = np.searchsorted(self._travel, (self.at - reach, self.at + reach))
        part = slice(first, last + 1)
        off, ways = pose - self.poses[part], self._ways[part]
        off[:, 2] = self._lever * (np.remainder(off[:, 2] + math.pi, 2.0 * math.pi) - math.pi)
        errors, commanded = np.linalg.norm(off, axis=1), ways @ command / np.maximum((ways**2).sum(axis=1), 1e-18)
        against = 0.1 * self._lever * (commanded <= 0.0)
        nearest = int((errors + against + 0.01 * np.abs(self._travel[part] - self.at)).argmin())
        ends = [max(first + nearest - 1, 0), min(first + nearest + 1, len(self._travel) - 1)]
        way = np.diff(self.poses[ends], axis=0)[0] * (1.0, 1.0, self._lever)
        beyond = float(off[nearest] @ way / max(way @ way, 1e-18))  # between the poses beside the nearest one
        at = float(self._travel[first + nearest] + np.clip(beyond, -0.5, 0.5) * np.diff(self._travel[ends])[0])
        at = min(at, float(self._travel[-1]))
        self._error, self._commanded = float(errors[nearest]), float(commanded[nearest])
        interval = stamp - self._stamp
        if was_near and self._error < self._lever and 0.0 < interval < memory:
            kept = math.exp(-interval / memory)
            self.speed = kept * self.speed[0] + at - self.at, kept * self.speed[1] + interval
        self._stamp, self.at = stamp, at
        return self._error < self._lever and self._pace() > 0.0 and at < self._travel[-1]

    def commands(self, pose: Vector, step: float, steps: int) -> Points:
        """Return the velocity of the tip in each step from a pose of the chord on, shape (steps, 2) [m/s]."""
        moves = self._travel, self._lever, pose, self.at, max(0.0, self._pace()), step, steps
        return np.asarray(follow_plan(self.poses, *moves))

    def _pace(self) -> float:
        """Return w [m/s]."""
        return self.speed[0] / self.speed[1] if self.speed[1] > 0.3 else self._commanded  # s


class PublishedForecasts:
    """Forecasts by the plan of the needle, else by the command that is held, and judges them by what came of them.

    A needle that is nearer to its plan than half its chord, and gets on along it as a program commands, is taken along
    the plan at the speed at which it got on so far. Forecasts that were made within their horizon, up to thirty, are
    compared with the thread now: where their nodes are farther off, in the mean, than those of the threads that they
    began from, by more than the deviation of the estimate, they are worse than a forecast that nothing moves.

    Args:
        needle: that is planned for.
    """

    def __init__(self, needle: NeedleKinematics) -> None:
        self._needle = needle
        NeedlePlan(np.zeros((2, 3)), 1e-3).commands(np.zeros(3), 1.0, 1)  # compiled before anybody waits for it
        self._plan: NeedlePlan | None = None
        self._made: deque[tuple[float, Vector, Vector]] = deque()  # stamp, times and vertices
        self._commanded, self._filtered, self._source = np.zeros(2), np.zeros(2), ""
        self._command_stamp = -math.inf

    def reset(self) -> None:
        """Forget the command and all forecasts, also those that are being made; the plan stays."""
        self._made, self._command_stamp = deque(), -math.inf

    def on_needle(self, needle: NeedleKinematics) -> None:
        """Take another needle, which is on the same plan."""
        self._needle = needle
        if self._plan is not None:
            self.on_plan(self._plan.poses)

    def on_plan(self, poses: Points) -> None:
        """Take a plan: x, y [m] and angle [rad] of the needle's chord, shape (m, 3); fewer than 2 poses for none."""
        before = self._plan.speed if self._plan is not None else (0.0, 0.0)
        self._plan = NeedlePlan(poses, 0.5 * self._needle.chord, before) if len(poses) > 1 else None

    def on_command(self, stamp: float, commanded: Vector, filtered: Vector, source: str) -> None:
        """Take the command that the coil bridge follows from a stamp on [s], shapes (2,) [m/s], and its input."""
        self._command_stamp, self._commanded, self._filtered, self._source = stamp, commanded, filtered, source

    def update(self, pose: NeedlePose, horizon: float) -> bool:
        """Follow the needle to a pose on its plan; return whether it goes by that."""
        if self._plan is None:
            return False
        if self._source != "needle" or not self._commanded.any() or not self._holds(pose.stamp):
            self._plan.rest()
            return False
        along, across = self._needle.body_velocity(pose.heading, self._commanded)
        command = np.append(along * self._needle.chord_direction(pose.heading), across)
        return self._plan.update(pose.stamp, self._chord(pose), command, horizon)

    def prepare(
        self, forecaster: ThreadForecaster, estimate: ThreadEstimate, pose: NeedlePose, horizon: float, *, slowed: bool
    ) -> Callable[[], Forecast]:
        """Return what makes the forecast from an estimate, in any thread, and remembers it for `judge`.

        Args:
            forecaster: of thread and needle.
            estimate: of the thread.
            pose: of the needle's tail, at the same instant.
            horizon: of the forecast [s].
            slowed: whether friction slows every command that is held, and not those of an operator alone.
        """
        holds, made = self._holds(pose.stamp), self._made
        start = ForecastStart.of_estimate(estimate, pose, self._filtered if holds else None)
        if self.update(pose, horizon) and self._plan is not None:
            steps = max(1, round(horizon / forecaster.step))
            commands = self._plan.commands(self._chord(pose), forecaster.step, steps)
            slowed = False  # the measured speed is
        else:
            commands = self._commanded if holds else np.zeros(2)
            slowed = slowed or (holds and self._source == "operator")

        def make() -> Forecast:
            forecast = forecaster.forecast(start, commands, horizon, slowed=slowed)
            if not any(abs(forecast.stamp - stamp) < horizon / 30.0 for stamp, _, _ in tuple(made)[-1:]):
                made.append((forecast.stamp, forecast.times, forecast.vertices.copy()))
            return forecast

        return make

    def judge(self, estimate: ThreadEstimate) -> str:
        """Return why forecasts are not to be published, by the thread as it is now; empty if they are."""
        made, now, nodes = self._made, estimate.stamp, estimate.positions
        while made and not 0.0 <= now - made[0][0] <= made[0][1][-1]:
            made.popleft()
        off, moved = [], []
        for stamp, times, vertices in tuple(made):
            index = int(np.searchsorted(times, now - stamp))
            if index < len(times):
                off.append(np.linalg.norm(vertices[index] - nodes, axis=1).mean())
                moved.append(np.linalg.norm(vertices[0] - nodes, axis=1).mean())
        if not off or np.mean(off) <= np.mean(moved) + estimate.deviation.mean():
            return ""
        return "the last forecasts are farther off than a thread that does not move"

    def _holds(self, stamp: float) -> bool:
        """Return whether there is a command, which is held for no longer than half a second when none follows."""
        return abs(stamp - self._command_stamp) <= 0.5

    def _chord(self, pose: NeedlePose) -> Vector:
        """Return x, y [m] and angle [rad] of the needle's chord, shape (3,)."""
        along = self._needle.chord_direction(pose.heading)
        middle = pose.tail + 0.5 * self._needle.chord * along
        return np.array([middle[0], middle[1], math.atan2(along[1], along[0])])
