"""Model predictive control along a path: the tracker's command, slowed and turned as forecasts of the thread advise."""

from __future__ import annotations

import math
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import MagnetosutureError
from magnetosuture_thread.forecast import Forecast, ForecastStart, ThreadForecaster
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.model.prediction import NeedlePose
from magnetosuture_thread.planning.clearance_map import body_clearance
from magnetosuture_thread.planning.path import BodyPath
from magnetosuture_thread.planning.planner import NeedlePlanner
from magnetosuture_thread.planning.procedure import ProcedureLimits
from magnetosuture_thread.planning.tracking import MAX_INTERVAL, PathTracker, TrackingCommand

if TYPE_CHECKING:
    from magnetosuture_thread.planning.executor import ThreadCondition

Vector = NDArray[np.float64]

FORECAST_STEP, FORECAST_STEPS = 0.06, 10  # s, and of these a horizon
SAMPLES, ROUNDS, ELITE = 3, 2, 2  # candidates that are drawn in a round, rounds, and those that the next is drawn about
DEVIATIONS, NARROWED = np.array([0.4, 0.12]), 0.35  # of share and turn [rad] in the first round; of it in the second
LOWEST, HIGHEST = np.array([0.2, -0.3]), np.array([1.0, 0.3])  # share and turn [rad]
TRACKED = np.array([1.0, 0.0])  # what leaves the tracker's command as it is
TURN_TIME = 0.25  # s; in which a candidate turns
ERROR_SCALE, CLEARANCE_RANGE = 1.5e-4, 1.5e-4  # m; error of weight 1, and clearance beyond the limit that costs nothing
LIMIT_RANGE = 0.3  # of a limit, in which it begins to cost
ERROR_WEIGHT, CLEARANCE_WEIGHT, LIMIT_WEIGHT = 0.1, 1.0, 4.0  # against all of the progress that is allowed
PREFERENCE = 0.2  # of cost, by which another candidate has to be better than the tracker's command
DISTURBANCE_TIME, MAX_DISTURBANCE = 0.3, 2e-3  # s and m/s; of the filter of what forecasts miss, and its bound
UNLIMITED = 10_000  # friction nodes; a limit that is none


@dataclass(frozen=True, eq=False)
class _Candidate:
    """What may be commanded over the horizon.

    Attributes:
        parameters: share of the tracker's speed, and turn [rad], shape (2,).
        velocities: of the tip, shape (k, 2) [m/s].
        cost: of it; inf where its forecast fails.
        times: of the forecast's instants, shape (k + 1,) [s].
        poses: of the needle at these: x and y of the middle [m], and the chord's angle [rad], shape (k + 1, 3).
    """

    parameters: Vector
    velocities: Points
    cost: float
    times: Vector
    poses: Points


class PredictiveController:
    """Searches, at each pose, for a command that costs less than the tracker's over a forecast of needle and thread.

    A candidate has two parameters: the share s of the tracker's speed, and the angle by which the needle is turned
    besides within `TURN_TIME`. Its commands are those that the tracker would give an ideal needle in the time s t,
    times s, turned by the angle; the tracker's own, with share 1 and angle 0, is always among them. Each is rolled out
    by `ThreadForecaster`, safety filter included, and costs

        J = 1 - p / p_max + w_e mean (e / e_0)^2 + w_c mean phi((c - c_min) / c_0)
            + w_l mean phi((1 - T / T_max) / r) + w_l mean phi((1 - m / m_max) / r),    phi(x) = max(0, 1 - x)^2

    with the progress p along the path and p_max that at the allowed speed [m], the error e of the body from the path,
    sqrt(|dx|^2 + (l / 2)^2 dangle^2) [m] with the chord l, the clearance c of the body [m], the peak tension T of the
    thread [N], and the number m of its nodes under friction; c_min, T_max and m_max are the limits of the goal. The
    means are over the horizon.

    What the forecast does not know of, as a pull that the coils do not compensate, is added to the needle's motion: the
    difference between the last forecast and the pose that followed, low-passed. The search draws `SAMPLES` candidates
    about that of the last command, and as many about the best of these; the best of all is commanded where it costs
    less than the tracker's by `PREFERENCE`. The tracker's setpoint moves by the same share as the needle.

    Source: the cross-entropy method, Rubinstein 1999, as a search in model predictive control. Deviation: two
    parameters in place of a sequence of commands, and the best candidate is commanded, not the mean of the last round,
    so that what is commanded has been forecast.

    It is no safety function: the safety filter of the coil bridge stays last.

    Args:
        planner: whose needle and scene it is.
        forecaster: of needle and thread, with steps of `FORECAST_STEP`.
        seed: of the search; the same poses give the same commands.
        slowed: whether the bridge slows the commands by the thread's friction.
    """

    def __init__(
        self, planner: NeedlePlanner, forecaster: ThreadForecaster, *, seed: int = 0, slowed: bool = False
    ) -> None:
        self._planner, self._forecaster, self._slowed = planner, forecaster, slowed
        self._random = np.random.default_rng(seed)
        self._to_chord = np.column_stack([planner.needle.chord_direction(axis) for axis in np.eye(2)])
        self._last: tuple[float, _Candidate] | None = None  # with its stamp [s]
        self._disturbance = np.zeros(3)  # along the chord, across it, and of the turning tip [m/s]

    def compute_command(
        self,
        tracker: PathTracker,
        stamp: float,
        middle: Vector,
        angle: float,
        speed: float,
        thread: ThreadCondition,
        limits: ProcedureLimits,
    ) -> TrackingCommand:
        """Compute the command for a pose; the tracker's where nothing can be forecast from it.

        Its speed is at most the allowed one, or that of the tracker's command if that is more.

        Args:
            tracker: of the path; its setpoint waits for a needle that is slowed.
            stamp: of the pose [s].
            middle: of the chord, shape (2,) [m].
            angle: of the chord [rad].
            speed: of the tip that is allowed now [m/s].
            thread: what is known of it.
            limits: of the goal.
        """
        before = tracker.travel
        command = tracker.compute_command(stamp, middle, angle, speed, thread.slowdown, thread.drift)
        self._update_disturbance(stamp, middle, angle)
        found = None
        if thread.vertices is not None and command.velocity.any():
            try:
                found = self._search(tracker, command, stamp, middle, angle, speed, thread, limits)
            except MagnetosutureError:  # the thread does not fit the needle, or the needle is inside of a shape
                found = None
        if found is None:
            self._last = None
            return command
        self._last = stamp, found
        if found.parameters is TRACKED:
            return command
        tracker.travel = before + float(found.parameters[0]) * (tracker.travel - before)
        return replace(command, velocity=found.velocities[0], travel=tracker.travel)

    def _update_disturbance(self, stamp: float, middle: Vector, angle: float) -> None:
        """Compare a pose with the last forecast."""
        if self._last is None:
            return
        began, candidate = self._last
        interval = stamp - began
        if not 0.0 < interval <= MAX_INTERVAL:
            self._last = None
            return
        x, y, turned = (float(np.interp(interval, candidate.times, column)) for column in candidate.poses.T)
        c, s, dx, dy = math.cos(angle), math.sin(angle), middle[0] - x, middle[1] - y
        turn = self._planner.lever * math.remainder(angle - turned, math.tau)
        found = np.array([c * dx + s * dy, c * dy - s * dx, turn]) / interval
        found = np.clip(found, -MAX_DISTURBANCE, MAX_DISTURBANCE)
        self._disturbance += (1.0 - math.exp(-interval / DISTURBANCE_TIME)) * (found - self._disturbance)

    def _search(
        self,
        tracker: PathTracker,
        command: TrackingCommand,
        stamp: float,
        middle: Vector,
        angle: float,
        speed: float,
        thread: ThreadCondition,
        limits: ProcedureLimits,
    ) -> _Candidate | None:
        """Return the candidate to command; None where that of the tracker cannot be forecast."""
        chord = np.array([math.cos(angle), math.sin(angle)])
        pose = NeedlePose(stamp, middle - self._planner.lever * chord, self._to_chord.T @ chord)
        assert thread.vertices is not None
        last = None if self._last is None else self._last[1]
        start = ForecastStart(pose, thread.vertices, tip_velocity=None if last is None else last.velocities[0])
        nominal, end = self._nominal(tracker, command, pose, angle, speed, thread)
        bound = max(speed, math.hypot(*command.velocity))
        tested: list[_Candidate] = []
        mean, deviation = TRACKED if last is None else last.parameters, DEVIATIONS
        batch = [TRACKED] if last is None or last.parameters is TRACKED else [TRACKED, last.parameters]
        for _ in range(ROUNDS):
            drawn = mean + deviation * self._random.standard_normal((SAMPLES, 2))
            batch += list(np.clip(drawn, LOWEST, HIGHEST))
            sequences = np.array([self._sequence(nominal, parameters, bound) for parameters in batch])
            forecasts = self._forecaster.forecasts(
                start, sequences, FORECAST_STEPS * FORECAST_STEP, slowed=self._slowed
            )
            for parameters, sequence, forecast in zip(batch, sequences, forecasts, strict=True):
                poses = self._poses(forecast, angle)
                cost = math.inf
                if not forecast.problem:
                    moved = self._disturbed(forecast.times, poses)
                    cost = self._cost(forecast, moved, tracker, end, speed, limits)
                tested.append(_Candidate(parameters, sequence, cost, forecast.times, poses))
            if not math.isfinite(tested[0].cost):
                return None
            elite = np.array([each.parameters for each in sorted(tested, key=lambda each: each.cost)[:ELITE]])
            mean, deviation = elite.mean(axis=0), np.maximum(NARROWED * deviation, elite.std(axis=0))
            batch = []
        best = min(tested, key=lambda each: each.cost)
        return best if best.cost < tested[0].cost - PREFERENCE else tested[0]

    def _nominal(
        self,
        tracker: PathTracker,
        command: TrackingCommand,
        pose: NeedlePose,
        angle: float,
        speed: float,
        thread: ThreadCondition,
    ) -> tuple[Points, float]:
        """Return what the tracker makes an ideal needle do, and how far it gets on the path [m].

        Of each step and the one after the horizon the tip's velocity along the chord and across it [m/s], and the
        chord's angle when it begins [rad], shape (k + 1, 3).
        """
        imagined = deepcopy(tracker, {id(tracker.path): tracker.path})
        needle, tail, heading, velocity = self._planner.needle, pose.tail, pose.heading, command.velocity
        found = np.empty((FORECAST_STEPS + 1, 3))
        for k in range(FORECAST_STEPS + 1):
            along, across = needle.body_velocity(heading, velocity)
            found[k] = along, across, angle
            tail, heading = needle.moved(tail, heading, along, across, FORECAST_STEP)
            middle, turned = self._planner.pose(tail, heading)
            angle += math.remainder(turned - angle, math.tau)
            stamp = pose.stamp + FORECAST_STEP * (k + 1)
            velocity = imagined.compute_command(stamp, middle, angle, speed, thread.slowdown, thread.drift).velocity
        return found, imagined.travel

    def _sequence(self, nominal: Points, parameters: Vector, bound: float) -> Points:
        """Return the velocities of a candidate, shape (k, 2), none of them faster than a bound [m/s]."""
        share, turn = parameters.tolist()
        step = np.arange(float(FORECAST_STEPS))
        along, across, angle = (np.interp(share * step, np.arange(len(nominal)), column) for column in nominal.T)
        time = FORECAST_STEP * step
        angle += turn * np.minimum(1.0, time / TURN_TIME)
        along *= share
        across = share * across + self._planner.lever * turn / TURN_TIME * (time < TURN_TIME)
        scale = np.minimum(1.0, bound / np.maximum(np.hypot(along, across), 1e-12))
        c, s = scale * np.cos(angle), scale * np.sin(angle)
        return np.column_stack([c * along - s * across, s * along + c * across])

    def _poses(self, forecast: Forecast, angle: float) -> Points:
        """Return middles [m] and angles of the chord [rad] of a forecast, these unwrapped, shape (k + 1, 3)."""
        chords = forecast.headings @ self._to_chord.T
        angles = np.unwrap(np.concatenate([[angle], np.arctan2(chords[:, 1], chords[:, 0])]))[1:]
        return np.column_stack([forecast.tails + self._planner.lever * chords, angles])

    def _disturbed(self, times: Vector, poses: Points) -> Points:
        """Return poses of a forecast, shape (k + 1, 3), with what it does not know of."""
        along, across, turning = self._disturbance[:, None] * times
        c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        moved = np.column_stack([c * along - s * across, s * along + c * across, turning / self._planner.lever])
        return np.asarray(poses + moved)

    def _cost(
        self,
        forecast: Forecast,
        poses: Points,
        tracker: PathTracker,
        end: float,
        speed: float,
        limits: ProcedureLimits,
    ) -> float:
        """Return the cost of a candidate; see the class.

        Args:
            forecast: of it.
            poses: middles [m] and angles [rad], shape (k + 1, 3).
            tracker: of the path.
            end: how far the tracker gets on the path [m].
            speed: that is allowed [m/s].
            limits: of the goal.
        """
        left = tracker.path.length - tracker.travel
        errors, travel = _on_path(tracker.path, poses, tracker.travel, end)
        cost = 1.0 - (travel - tracker.travel) / max(2e-4, min(speed * forecast.horizon, left))
        cost += ERROR_WEIGHT * float(np.mean((errors / ERROR_SCALE) ** 2))
        near, body = self._planner.near, self._planner.body
        clearance = np.array([body_clearance(x, y, angle, body, near) for x, y, angle in poses.tolist()])
        required = max(self._forecaster.safety.keep_out, limits.clearance)
        cost += CLEARANCE_WEIGHT * _penalty((clearance - required) / CLEARANCE_RANGE)
        cost += LIMIT_WEIGHT * _penalty((1.0 - forecast.tension[1:] / limits.tension) / LIMIT_RANGE)
        if limits.friction_nodes < UNLIMITED:
            free = 1.0 - forecast.friction[1:].sum(axis=1) / max(1, limits.friction_nodes)
            cost += LIMIT_WEIGHT * _penalty(free / LIMIT_RANGE)
        return cost


def _penalty(margin: Vector) -> float:
    """Return the mean of the penalty phi of margins, shape (k,), in units of their range."""
    return float(np.mean(np.maximum(0.0, 1.0 - margin) ** 2))


def _on_path(path: BodyPath, poses: Points, travel: float, end: float) -> tuple[Vector, float]:
    """Return how far poses are from a path, shape (k,), and where on it the last is nearest [m].

    Args:
        path: of the body.
        poses: middles [m] and angles [rad], shape (k, 3).
        travel: where the first is about [m].
        end: how far the last may be [m].
    """
    first, last = np.searchsorted(path.travel, [travel - 6e-4, end + 2e-4]).tolist()
    last = min(len(path.travel), last + 1)
    first = max(0, min(first, last - 3))
    planned = np.column_stack([path.middles[first:last], path.lever * path.angles[first:last]])
    turns = round((path.angles[first] - poses[0, 2]) / math.tau) * math.tau
    at = np.column_stack([poses[:, :2], path.lever * (poses[:, 2] + turns)])
    nearest = np.linalg.norm(at[:, None] - planned, axis=2).argmin(axis=1)
    tangent = planned[np.minimum(nearest + 1, len(planned) - 1)] - planned[np.maximum(nearest - 1, 0)]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1), 1e-12)[:, None]
    off = at - planned[nearest]
    along = (off * tangent).sum(axis=1)
    errors = np.linalg.norm(off - along[:, None] * tangent, axis=1)
    return errors, float(path.travel[first + nearest[-1]] + along[-1])
