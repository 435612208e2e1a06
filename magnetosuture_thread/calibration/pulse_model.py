"""The motion of a bare needle under pulses of the coils, and the fit of coils and needle to what a camera showed of it.

Only field times moment over drag shows in a motion. So the mean strength of the coils and the needle's moment are held,
and the drags carry the rest: every prediction is the same in this gauge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from magnetosuture_thread.coils.field import loop_field
from magnetosuture_thread.geometry.compiled import compiled
from magnetosuture_thread.geometry.polyline import Vector

Residuals = Callable[[Vector], Vector]

RESIDUAL_UNIT, DELAY_UNIT, LIGHT_UNIT = 1e-4, 0.01, 1e-5  # T, s and m
OUTLIER = 3.0  # standard deviations, beyond which a residual counts less (Huber)
# Kinds of parameters, the first two of each coil: standard deviation of what a ruler and a label say before, and the
# 95 % interval that is narrow enough; of the logarithm, but of angles [rad], delay, residual field and light in units.
KINDS = {
    "angle": (3.0, 0.01),
    "field": (1.5, 0.02),
    "distance": (0.15, 0.06),
    "radius": (0.25, 0.3),
    "drag along": (3.0, 0.04),
    "drag across": (3.0, 0.06),
    "turning drag": (3.0, 0.06),
    "length": (0.01, 0.03),
    "delay": (5.0, 0.4),
    "residual x": (3.0, 0.1),
    "residual y": (3.0, 0.1),
    "light x": (3.0, math.inf),
    "light y": (3.0, math.inf),
}
# Errors of a needle's end that are the same in all frames [m]: along the needle, 0.15 px of 0.08 mm, and across it
# beside that of the light, 0.06 px.
END_BIAS, AXIS_BIAS = 1.2e-5, 5e-6


@dataclass(frozen=True, eq=False)
class Pulse:
    """Currents that were on for a while, and what the camera showed of the needle from shortly before until it rested.

    Attributes:
        currents: of each coil, shape (m,) [A].
        on: time at which they were commanded [s].
        off: time at which zeros were [s].
        times: stamps of the frames, by the same clock, shape (k,) [s].
        poses: tail [m] and heading, not wrapped [rad], shape (k, 3).
        ended: why it was ended early; empty if it was not.
    """

    currents: Vector
    on: float
    off: float
    times: Vector
    poses: Vector
    ended: str = ""


@compiled
def _rates(coils: Vector, needle: Vector, residual: Vector, currents: Vector, pose: Vector, rates: Vector) -> float:
    """Write the velocity of a needle's middle and its turn rate; return the rate at which it turns to the field [1/s].

    v = R diag(1 / along, 1 / across) R' m / l (B_tip - B_tail),    omega = m / turning n . (B_tip + B_tail) / 2
    """
    moment, length, along, across, turning = needle[0], needle[1], needle[2], needle[3], needle[4]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    sum_x, sum_y, difference_x, difference_y = 2.0 * residual[0], 2.0 * residual[1], 0.0, 0.0
    for side in (-1.0, 1.0):
        x, y = pose[0] + 0.5 * side * length * c, pose[1] + 0.5 * side * length * s
        for k in range(len(currents)):
            if currents[k] != 0.0:
                ux, uy = math.cos(coils[k, 0]), math.sin(coils[k, 0])
                b, a = loop_field(ux * x + uy * y, ux * y - uy * x, coils[k, 1], coils[k, 2], coils[k, 3])
                fx, fy = currents[k] * (b * ux - a * uy), currents[k] * (b * uy + a * ux)
                sum_x, sum_y = sum_x + fx, sum_y + fy
                difference_x, difference_y = difference_x + side * fx, difference_y + side * fy
    pole = moment / length
    v = pole * (difference_x * c + difference_y * s) / along
    w = pole * (difference_y * c - difference_x * s) / across
    rates[0], rates[1] = v * c - w * s, v * s + w * c
    rates[2] = 0.5 * moment / turning * (sum_y * c - sum_x * s)
    return float(0.5 * moment / turning * math.hypot(sum_x, sum_y))


@compiled
def pulse_motion(
    coils: Vector,
    needle: Vector,
    residual: Vector,
    currents: Vector,
    on: float,
    off: float,
    times: Vector,
    start: Vector,
) -> Vector:
    """Return the needle's poses, tail and heading, at times, by the method of Runge and Kutta of fourth order.

    Args:
        coils: angle [rad], distance [m], radius [m] and field at the dish's centre [T/A] of each, shape (m, 4).
        needle: moment [A m^2], length [m], drag along and across [N s/m], turning drag [N m s].
        residual: field without currents, shape (2,) [T].
        currents: of the coils, shape (m,) [A].
        on: from when on they act [s].
        off: until when they do [s].
        times: shape (k,) [s].
        start: pose at the first of them, shape (3,).
    """
    poses, off_currents = np.empty((len(times), 3)), np.zeros(len(currents))
    half, at = 0.5 * needle[1], np.empty(3)
    pose = np.array([start[0] + half * math.cos(start[2]), start[1] + half * math.sin(start[2]), start[2]])
    slope, total = np.empty(3), np.empty(3)
    now = times[0]
    for j in range(len(times)):
        while now < times[j] - 1e-9:
            acting = on - 1e-9 <= now < off - 1e-9
            until = min(times[j], off) if acting else (min(times[j], on) if now < on - 1e-9 else times[j])
            flowing = currents if acting else off_currents
            # A step is 0.3 of the time in which the needle turns to its field. More than a thousand of them between two
            # frames need parameters that no needle has, as a fit may try on its way.
            turns = (until - now) * _rates(coils, needle, residual, flowing, pose, slope) / 0.3
            steps = max(1, math.ceil(min(turns, 1000.0)))
            h = (until - now) / steps
            for _ in range(steps):
                total[:] = 0.0
                for stage in range(4):
                    ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
                    for i in range(3):
                        at[i] = pose[i] + ahead * slope[i]
                    _rates(coils, needle, residual, flowing, at, slope)
                    for i in range(3):
                        total[i] += slope[i] * (1.0 if stage in (0, 3) else 2.0)
                for i in range(3):
                    pose[i] += h / 6.0 * total[i]
            now = until
        c, s = math.cos(pose[2]), math.sin(pose[2])
        poses[j, 0], poses[j, 1], poses[j, 2] = pose[0] - half * c, pose[1] - half * s, pose[2]
    return poses


@dataclass(frozen=True, eq=False)
class RigParameters:
    """Coils and needle, as they show in a needle's motion.

    Attributes:
        angles: of the coils in the camera's image, shape (m,) [rad].
        fields: of the coils at the dish's centre, signed, shape (m,) [T/A].
        distance: of the coils [m].
        radius: of the coils [m].
        moment: of the needle [A m^2].
        length: of the needle [m].
        drag: along and across [N s/m], turning [N m s].
        delay: from a command to the motion that frames show, by their stamps [s].
        residual: field without currents, shape (2,) [T].
        light: by how much the tip shows off more than the tail, away from a lamp that steel reflects, shape (2,) [m].
    """

    angles: Vector
    fields: Vector
    distance: float
    radius: float
    moment: float
    length: float
    drag: tuple[float, float, float]
    delay: float
    residual: Vector
    light: Vector

    def poses(self, pulse: Pulse, start: Vector) -> Vector:
        """Return the poses that frames of a pulse are predicted to show, from the first one on, shape (k, 3).

        Args:
            pulse: of currents.
            start: pose at the first frame, as it is and not as it shows, shape (3,).
        """
        on, off = pulse.on + self.delay, pulse.off + self.delay
        poses = pulse_motion(self._coils, self._needle, self.residual, pulse.currents, on, off, pulse.times, start)
        poses[:, 2] += (self.light[1] * np.cos(poses[:, 2]) - self.light[0] * np.sin(poses[:, 2])) / self.length
        return poses

    @cached_property
    def _coils(self) -> Vector:
        sizes = np.full(len(self.angles), self.distance), np.full(len(self.angles), self.radius)
        return np.ascontiguousarray(np.column_stack([self.angles, *sizes, self.fields]))

    @cached_property
    def _needle(self) -> Vector:
        return np.array([self.moment, self.length, *self.drag])


def kind_of(name: str) -> str:
    """Return the kind of a parameter: its name without the number of a coil."""
    return name.rstrip(" 0123456789")


def difference(poses: Vector, others: Vector) -> Vector:
    """Return by how much poses differ from others, the heading by less than half a turn, shape (k, 3)."""
    apart = poses - others
    apart[..., 2] -= math.tau * np.round(apart[..., 2] / math.tau)
    return np.asarray(apart)


def derivative(function: Residuals, p: Vector, steps: Sequence[float] | float = 1e-4) -> Vector:
    """Return the derivative of a function of parameters of order one by differences of a step, shape (rows, n)."""
    here, rows = function(p), np.diag(np.broadcast_to(steps, p.shape))
    return np.asarray(np.array([(function(p + row) - here) / row.sum() for row in rows]).T)


class PulseModel:
    """Fits `RigParameters` to pulses.

    The pose from which each pulse starts is unknown too; residuals are projected off what it changes, so that the fit
    has as many unknowns as the rig. Intervals are those of least squares, or of the scatter from pulse to pulse
    (White's estimate, clustered by pulse), whichever is wider: the errors of frames are alike within a pulse.

    Args:
        guess: where the fit begins; its lengths, moment and mean field are what a ruler and the setup say.
        deviations: of a measured pose, shape (3,) [m, m, rad].
        check: called all the time while it fits; raises what interrupts.

    Attributes:
        names: of the parameters in `interval` and `information`.
        information: J' J of the last fit, shape (n, n).
        chi_square: mean square of the residuals, in units of the deviations.
    """

    def __init__(self, guess: RigParameters, deviations: Vector, check: Callable[[], None] = lambda: None) -> None:
        self._guess, self._sigma, count, self._check = guess, deviations, len(guess.angles), check
        self._signs, self._field = np.sign(guess.fields), math.exp(np.log(np.abs(guess.fields)).mean())
        of_each, shared = [*KINDS][:2], [*KINDS][2:]
        self.names = [f"{kind} {k}" for kind in of_each for k in range(count)] + shared
        logs = np.log([guess.distance, guess.radius, *guess.drag, guess.length])
        others = guess.delay / DELAY_UNIT, *(guess.residual / RESIDUAL_UNIT), *(guess.light / LIGHT_UNIT)
        self._p = np.array([*guess.angles, *np.log(np.abs(guess.fields) / self._field), *logs, *others])
        self._prior, self._weak = self._p.copy(), np.array([KINDS[kind_of(name)][0] for name in self.names])
        self.information, self.chi_square = np.diag(self._weak**-2.0), 1.0
        self._starts: list[Vector] = []

    @property
    def intervals(self) -> dict[str, float]:
        """Half of the 95 % interval of each parameter by its name, after a fit; see `KINDS` for the units."""
        return dict(zip(self.names, (1.96 * self.deviations).tolist(), strict=True))

    @property
    def parameters(self) -> RigParameters:
        """The parameters of the last fit."""
        return self._at(self._p)

    def _at(self, p: Vector) -> RigParameters:
        count = len(self._signs)
        gains, (distance, radius, *drag, length) = p[count : 2 * count], np.exp(p[2 * count : 2 * count + 6]).tolist()
        fields = self._signs * self._field * np.exp(gains - gains.mean())
        delay, fixed = max(0.0, float(p[-5])) * DELAY_UNIT, (p[-4:-2] * RESIDUAL_UNIT, p[-2:] * LIGHT_UNIT)
        drags = (drag[0], drag[1], drag[2])
        return RigParameters(p[:count], fields, distance, radius, self._guess.moment, length, drags, delay, *fixed)

    def by_parameters(self, pulse: Pulse, start: Vector) -> Vector:
        """Return how the predicted poses change by the parameters, in deviations, shape (3 k, n)."""
        return derivative(lambda p: (self._at(p).poses(pulse, start) / self._sigma).ravel(), self._p)

    def by_start(self, pulse: Pulse, start: Vector) -> Vector:
        """Return how the predicted poses change by the pose at the start, in deviations, shape (3 k, 3)."""
        rig = self.parameters
        return derivative(lambda pose: (rig.poses(pulse, pose) / self._sigma).ravel(), start, (1e-6, 1e-6, 1e-4))

    def start_of(self, pulse: Pulse, start: Vector) -> Vector:
        """Return the start that fits a pulse's frames best, by two steps of Gauss and Newton from a guess."""
        for _ in range(2):
            error = difference(pulse.poses, self.parameters.poses(pulse, start)) / self._sigma
            change = np.linalg.lstsq(self.by_start(pulse, start), error.ravel(), rcond=None)[0]
            start = start + change * min(1.0, 0.3 / max(1e-9, abs(float(change[2]))))
        return start

    def fit(self, pulses: Sequence[Pulse], rounds: int = 4) -> None:
        """Fit to pulses, from the last fit on, in rounds, each with the starts of the one before.

        The first fit has one round more, in which sizes are held.
        """
        from scipy.optimize import least_squares  # here, as it takes long to import

        # The first pulses tell drags and strengths from a bad guess only if sizes are held as a ruler has them.
        held = np.where(np.isin(self.names, ("distance", "radius", "length")), 0.05, 1.0)
        ways = ([self._weak * held] if not self._starts else []) + [self._weak] * rounds
        self._starts += [pulse.poses[0].copy() for pulse in pulses[len(self._starts) :]]
        before = math.inf
        for weak in ways:
            self._starts = [self.start_of(pulse, start) for pulse, start in zip(pulses, self._starts, strict=True)]
            # An orthonormal basis of what the start of a pulse can change.
            bases = [np.linalg.qr(self.by_start(q, s))[0] for q, s in zip(pulses, self._starts, strict=True)]
            residuals = partial(self._residuals, pulses, bases, weak)
            options: dict[str, Any] = {"loss": "huber", "f_scale": OUTLIER, "ftol": 1e-4, "max_nfev": 12}
            solved = least_squares(residuals, self._p, partial(derivative, residuals), **options)
            self._p = solved.x
            if solved.cost > before * (1.0 - 1e-3):
                break
            before = solved.cost
        weights = np.minimum(1.0, OUTLIER / np.maximum(np.abs(solved.fun), 1e-9))
        self._estimate(pulses, solved.fun, weights, derivative(residuals, self._p))

    def _residuals(self, pulses: Sequence[Pulse], bases: Sequence[Vector], weak: Vector, p: Vector) -> Vector:
        """Return what is left of all pulses, and of what was known before, in deviations."""
        self._check()
        rig, blocks = self._at(p), []
        for pulse, start, basis in zip(pulses, self._starts, bases, strict=True):
            block = (difference(rig.poses(pulse, start), pulse.poses) / self._sigma).ravel()
            blocks.append(block - basis @ (basis.T @ block))
        return np.concatenate([*blocks, (p - self._prior) / weak])

    def _estimate(self, pulses: Sequence[Pulse], residuals: Vector, weights: Vector, jacobian: Vector) -> None:
        """Estimate the covariance of the parameters from residuals, their weights and derivatives at the solution."""
        count = len(self._p)
        self.information = jacobian.T @ (weights[:, None] * jacobian)
        freedom = max(1, len(residuals) - count - 3 * len(pulses))
        self.chi_square = float(weights[:-count] @ residuals[:-count] ** 2) / freedom
        inverse = np.linalg.inv(self.information)
        ends = np.cumsum([pulse.poses.size for pulse in pulses])
        scores = np.array(
            [jacobian[a:b].T @ (weights[a:b] * residuals[a:b]) for a, b in zip([0, *ends], ends, strict=False)]
        )
        clustered = inverse @ scores.T @ scores @ inverse * len(pulses) / max(1, len(pulses) - count)
        plain = inverse * max(1.0, self.chi_square)
        gains = slice(len(self._signs), 2 * len(self._signs))
        about = np.eye(count)
        about[gains, gains] -= 1.0 / len(self._signs)
        sizes = [np.diag(about @ covariance @ about.T) for covariance in (plain, clustered)]
        self.deviations = np.sqrt(np.maximum(*sizes) + self._bias() ** 2)

    def _bias(self) -> Vector:
        """Return deviations of the parameters by errors that no number of frames averages out.

        A needle of length l whose end shows off by `END_BIAS` along it seems longer by that share, by both ends, and a
        way by half of it, as both ends show off alike. By `AXIS_BIAS` across it, its axis seems turned by that over l.
        """
        share, turn, count = END_BIAS / self.parameters.length, AXIS_BIAS / self.parameters.length, len(self._signs)
        size = float(np.hypot(*self._p[-4:-2]))
        # Of a drag there is 0.004 besides, of coils that are one loop here, and of the camera's scale.
        drag, both = math.hypot(0.004, share), math.sqrt(2.0) * share
        others = (drag, drag, drag, both, 0.0, turn * size, turn * size, 0.0, 0.0)
        return np.array([*[turn] * count, *[0.5 * share] * count, 0.0, 0.0, *others])
