"""A rig measures itself: pulses of the coils, the motion of a bare needle, one fit, and a verdict by pulses not fitted.

Everything is in the frame of the camera: where a coil is, is where it shows to be.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Protocol

import numpy as np

from magnetosuture_thread.calibration.pulse_model import DELAY_UNIT, KINDS, Pulse, PulseModel, RigParameters, kind_of
from magnetosuture_thread.coils.pulses import MAX_TIME
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.settings.errors import InvalidInputError

BEFORE, AFTER = 0.2, 0.35  # s of poses before and after a pulse
PATIENCE = 2.0  # s without a pose, after which there is none
LEAST_CURRENT = 0.01  # A
PULSE_TIME = 0.1, MAX_TIME  # s; of a designed pulse
VERIFIED = 12  # pulses
MEDIAN_ERROR, WORST_ERROR, HEADING_ERROR = 0.05, 0.20, math.radians(3.0)  # of the verdict
SQUARE_ERROR = 1e-3  # m; of the verdict too
FRAME_TIME = 0.02  # s; between predicted poses of a design; no pulse is shorter, however early it ends


class Bench(Protocol):
    """What drives coils and watches a needle. A pulse ends early by displacement, at the wall, or without a pose.

    Attributes:
        needle_length: as the camera measures it [m].
    """

    needle_length: float

    def pulse(self, currents: Vector, seconds: float) -> Pulse:
        """Give currents for a time [s], then zeros until the needle rests, also where this is interrupted.

        Raises:
            InvalidInputError: there is no pose, and why.
        """


@dataclass(frozen=True)
class CoilAnswer:
    """What a coil did to the needle by itself.

    Attributes:
        current: at which the needle moved, nan if it never did [A].
        direction: in which it moved [rad].
        towards: whether it pointed that way.
        speed: of it for one ampere [m/s/A].
        turn_rate: the fastest for one ampere that was seen [rad/s/A].
    """

    current: float
    direction: float = math.nan
    towards: bool = True
    speed: float = math.nan
    turn_rate: float = math.nan

    @property
    def moved(self) -> bool:
        """Whether the needle moved."""
        return math.isfinite(self.current)


@dataclass(frozen=True)
class Commissioned:
    """What a commissioning found.

    Attributes:
        answers: of each coil by itself.
        model: that was fitted; None where there was nothing to fit.
        findings: what is not as the setup says, in words.
        failures: why nothing is written; empty if the verification passed.
        errors: of each pulse that was not fitted: share of its displacement, and heading [rad], shape (k, 2).
        square: largest distance of the needle from a square, steered with what was found; nan if it was not tried [m].
        pulses: all of them.
        open: parameters whose interval is wide.
        history: after each fit, the number of pulses and the widest 95 % intervals: of coil directions [rad], strengths
            and drags, as a share, and of the delay [s].
    """

    answers: tuple[CoilAnswer, ...]
    model: PulseModel | None = None
    findings: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()
    errors: Vector = field(default_factory=lambda: np.empty((0, 2)))
    square: float = math.nan
    pulses: tuple[Pulse, ...] = ()
    open: tuple[str, ...] = ()
    history: tuple[tuple[float, ...], ...] = ()


def middle_of(pose: Vector, length: float) -> Vector:
    """Return the middle of a needle in a pose (tail, heading), shape (..., 3) to (..., 2) [m]."""
    along = np.stack([np.cos(pose[..., 2]), np.sin(pose[..., 2])], axis=-1)
    return np.asarray(pose[..., :2] + 0.5 * length * along)


class Commissioning:
    """Drives a bench through rest, ladder, designed pulses and verification.

    Args:
        bench: to drive.
        believed: what the setup says of coils and needle.
        dish_radius: [m].
        log: called with a line for a person at each step.
        seed: of the designed pulses.
        check_stops: called with the least currents that move the needle [A] and its speed [m/s] once they are
            known; returns why nothing more may be done.
        check: called all the time while it computes, for some ten seconds at once; raises what interrupts.
    """

    def __init__(
        self,
        bench: Bench,
        believed: CoilBridgeSettings,
        dish_radius: float,
        log: Callable[[str], None],
        seed: int = 0,
        check_stops: Callable[[Vector, float], Sequence[str]] = lambda currents, speed: (),
        check: Callable[[], None] = lambda: None,
    ) -> None:
        self._bench, self._believed, self._radius, self._log = bench, believed, dish_radius, log
        self._random, self._length = np.random.default_rng([seed, 7]), bench.needle_length
        self._pulses: list[Pulse] = []
        self._most, self._check_stops = min(3.0, believed.max_current), check_stops  # A
        self._check = check

    def run(self) -> Commissioned:
        """Measure; see the module.

        Raises:
            InvalidInputError: the needle cannot be used where it is, or is lost on the way.
        """
        coils = range(len(self._believed.coil_angles))
        deviations, answers, unsafe = self._rest(), list[CoilAnswer](), None
        for coil in coils:
            answers.append(self._ladder(coil))
            if answers[-1].moved and unsafe is None:
                least = np.where(np.arange(len(coils)) == coil, answers[-1].current, 0.0)
                unsafe = self._check_stops(least, answers[-1].speed * answers[-1].current)
                if unsafe:
                    return Commissioned(tuple(answers), failures=tuple(unsafe), pulses=tuple(self._pulses))
        dead = [coil for coil in coils if not answers[coil].moved]
        if dead:
            return Commissioned(tuple(answers), failures=(no_answer(dead, len(coils)),), pulses=tuple(self._pulses))
        model = PulseModel(
            on_their_sides(self._guess(answers), self._pulses, deviations, self._check), deviations, self._check
        )
        model.fit(self._pulses)
        self._log(f"ladder: {len(self._pulses)} pulses, residual {math.sqrt(model.chi_square):.2f} deviations")
        top = max(answer.current for answer in answers)
        begun, wide, history = len(self._pulses), list(model.names), list[tuple[float, ...]]()
        while wide and len(self._pulses) < begun + 60:
            # Six pulses, each the most telling of eight, are fitted together.
            if not sum(self._designed(model, top, 8) for _ in range(6)):
                break
            model.fit(self._pulses)
            wide = [name for name, width in model.intervals.items() if width > KINDS[kind_of(name)][1]]
            history.append((len(self._pulses), *self._intervals(model)))
            _, angle, gain, drag, delay = history[-1]
            known = (
                f"coils ±{math.degrees(angle):.2f} degrees, ±{gain:.1%}, drags ±{drag:.1%}, delay ±{1e3 * delay:.1f} ms"
            )
            self._log(f"{len(self._pulses)} pulses; {known}; not known well enough: {', '.join(wide) or 'nothing'}")
        fitted, errors = len(self._pulses), []
        for _ in range(3 * VERIFIED):
            if len(self._pulses) < fitted + VERIFIED and self._designed(model, top, 3):
                errors.append(self._error(model, self._pulses[-1]))
        verification = np.array(errors).reshape(-1, 2)
        rig = model.parameters
        findings = (*find_wiring(self._believed, rig.angles, np.sign(rig.fields)), *self._changes(rig))
        failures = tuple(self._failures(verification))
        ends = tuple(self._pulses), tuple(wide), tuple(history)
        return Commissioned(tuple(answers), model, findings, failures, verification, math.nan, *ends)

    def check(self, rig: RigParameters) -> list[str]:
        """Give one pulse a coil; return what is not as a rig that was measured foresees, in words.

        Raises:
            InvalidInputError: as of `run`.
        """
        model, changed = PulseModel(rig, self._rest()), []
        for coil in range(len(rig.angles)):
            chosen, longest = None, 0.0
            for current in np.outer([1.0, -1.0], np.geomspace(5.0 * LEAST_CURRENT, self._most, 16)).ravel():
                currents = np.where(np.arange(len(rig.angles)) == coil, current, 0.0)
                pulse = self._foreseen(model, currents, PULSE_TIME[1])
                if pulse is not None and (way := self._motion(pulse)[0]) > longest:
                    chosen, longest = currents, way
            if chosen is None:
                changed.append(f"coil {coil} cannot be checked from here: turn the needle, or place it in the middle")
                continue
            share, heading = self._error(model, self._pulse(chosen, PULSE_TIME[1]))
            self._log(f"coil {coil}: {share:.1%} of the way, {math.degrees(heading):.1f} degrees off")
            # A coil at 0.8 of its strength is beyond this share of the way.
            if share > 0.12 or heading > 2.0 * HEADING_ERROR:
                off = f"{share:.0%} of the way and {math.degrees(heading):.0f} degrees off"
                changed.append(f"coil {coil} moves the needle {off} from what was measured")
        return changed

    def _foreseen(self, model: PulseModel, currents: Vector, seconds: float) -> Pulse | None:
        """Return a pulse from here as it is predicted; None if it is not gentle, or nobody foresees its way."""
        rig, pose = model.parameters, self._pose
        times = np.arange(0.0, seconds + rig.delay + 0.1, FRAME_TIME)
        pulse = Pulse(currents, 0.0, seconds, times, np.zeros((len(times), 3)))
        pulse = replace(pulse, poses=rig.poses(pulse, pose))
        if not self._is_gentle(pulse.poses):
            return None
        # A doubt of the heading may hardly grow: of a half turn against the field nobody foresees the way.
        turned = model.by_start(pulse, pose)[2::3, 2]
        return None if np.abs(turned).max() > 1.3 * abs(turned[0]) else pulse

    def _pulse(self, currents: Vector, seconds: float) -> Pulse:
        self._pulses.append(self._bench.pulse(np.asarray(currents, dtype=float), seconds))
        return self._pulses[-1]

    @property
    def _pose(self) -> Vector:
        """The last pose, tail and heading."""
        return np.asarray(self._pulses[-1].poses[-1])

    def _rest(self) -> Vector:
        """Watch the needle at rest; return the deviations of a pose."""
        pulse = self._pulse(np.zeros(len(self._believed.coil_angles)), 1.0)  # s
        times = pulse.times - pulse.times.mean()
        # By second differences, whose variance is six times that of white noise, as a field may turn the needle.
        noise = np.sqrt(np.mean(np.diff(pulse.poses, 2, axis=0) ** 2, axis=0) / 6.0)
        middles = middle_of(pulse.poses, self._length)
        if (drift := float(np.hypot(*np.polyfit(times, middles, 1)[0]))) > 1e-4:  # m/s
            expected = "at most 0.1 mm/s: a calm liquid, and nothing that pulls at the needle"
            raise InvalidInputError("needle at rest", f"a drift of {1e3 * drift:.2f} mm/s", expected)
        if (away := float(np.hypot(*middles[-1]))) > (room := 0.6 * self._radius):
            expected = f"at most {1e3 * room:.1f} mm: place it near the middle"
            raise InvalidInputError("needle", f"{1e3 * away:.1f} mm from the dish's centre", expected)
        end = math.hypot(*noise[:2]) / math.sqrt(2.0)
        self._log(f"at rest: {1e6 * end:.0f} µm, {1e3 * noise[2]:.1f} mrad; needle of {1e3 * self._length:.2f} mm")
        return np.array([max(end, 3e-6), max(end, 3e-6), max(float(noise[2]), 5e-4)])

    def _ladder(self, coil: int) -> CoilAnswer:
        """Raise the current of a coil alone until the needle moves, and keep it until that lies along the field."""
        currents, turn_rate = np.zeros(len(self._believed.coil_angles)), 0.0
        currents[coil] = LEAST_CURRENT
        seconds, most = 0.4, self._most  # s; of each pulse
        while True:
            pulse = self._pulse(currents, seconds)
            way, turn = self._motion(pulse)
            turn_rate = max(turn_rate, abs(turn) / (max(FRAME_TIME, pulse.off - pulse.on) * currents[coil]))
            at_most = currents[coil] >= most
            # Fifteen deviations of a tracked end tell a direction; at the greatest current half of them have to.
            if way > (1e-4 if at_most else 2e-4):  # m
                break
            if at_most:
                self._log(f"coil {coil}: no answer up to {most:g} A")
                return CoilAnswer(math.nan)
            noticed = way > 3e-5 or abs(turn) > 0.03  # m, rad; less is no sign that the coil acts
            currents[coil] = min(most, currents[coil] * (2.0 if noticed else 4.0))
        for _ in range(6):
            pulse = self._pulse(currents, seconds)
            way, turn = self._motion(pulse)
            if abs(turn) < 0.2:  # rad; it lies along the field
                break
        middles, on = middle_of(pulse.poses, self._length), pulse.times > pulse.on
        moved = middles[-3:].mean(axis=0) - middles[~on][-1]
        heading = float(pulse.poses[on, 2].max() + pulse.poses[on, 2].min()) / 2.0
        towards = float(moved @ [math.cos(heading), math.sin(heading)]) > 0.0
        speed = way / (max(FRAME_TIME, pulse.off - pulse.on) * currents[coil])
        answer = CoilAnswer(float(currents[coil]), math.atan2(moved[1], moved[0]), towards, speed, turn_rate)
        self._log(
            f"coil {coil}: {answer.current:.2f} A, {math.degrees(answer.direction):.0f} degrees, "
            f"{'towards' if towards else 'away'}, {1e3 * speed:.2f} mm/s/A, {turn_rate:.2f} rad/s/A"
        )
        return answer

    def _motion(self, pulse: Pulse) -> tuple[float, float]:
        """Return by how much a needle moved [m] and turned [rad]."""
        before = pulse.times < pulse.on + 1e-9
        first, last = pulse.poses[before][-1:].mean(axis=0), pulse.poses[-3:].mean(axis=0)
        way = middle_of(last, self._length) - middle_of(first, self._length)
        return float(np.hypot(*way)), float(last[2] - first[2])

    def _guess(self, answers: Sequence[CoilAnswer]) -> RigParameters:
        """Return the rig as the ladder shows it: directions, polarities and strengths, and the drags by the speeds."""
        believed = self._believed.coils_properties()
        needle, fields = self._believed.needle(), np.abs([coil.field_per_current for coil in believed])
        mean, distance = math.exp(np.log(fields).mean()), float(np.mean([coil.distance for coil in believed]))
        radius = float(np.mean([coil.radius for coil in believed]))
        moment = needle.moment * self._length / needle.length
        speeds = np.log([answer.speed for answer in answers])
        signs = np.array([1.0 if answer.towards else -1.0 for answer in answers])
        # The pull on a needle along the axis: moment times the field's gradient at the centre.
        along = moment * mean * 3.0 * distance / (distance**2 + radius**2) / math.exp(speeds.mean())
        share = self._length / needle.length
        turning = needle.turning_drag / needle.slack_drag * along * share**2
        drag = along, along * needle.drag_across / needle.slack_drag, turning
        angles = np.array([answer.direction for answer in answers])
        strengths = signs * mean * np.exp(speeds - speeds.mean())
        return RigParameters(angles, strengths, distance, radius, moment, self._length, drag, 0.03, *np.zeros((2, 2)))

    def _designed(self, model: PulseModel, top: float, tries: int) -> bool:
        """Give the most telling of some pulses that are slow, near and foreseeable; return whether there was one."""
        pose, coils, best, chosen = self._pose, len(self._believed.coil_angles), -math.inf, None
        for _ in range(60 * tries):
            if tries <= 0:
                break
            on = self._random.random(coils) < 0.7
            scale, most = top * 10.0 ** self._random.uniform(-1.2, 0.6), min(3.0 * top, self._most)
            currents = np.clip(self._random.standard_normal(coils) * on * scale, -most, most)
            seconds = self._random.uniform(*PULSE_TIME)
            if not currents.any() or (pulse := self._foreseen(model, currents, seconds)) is None:
                continue
            tries -= 1
            basis, by_p = np.linalg.qr(model.by_start(pulse, pose))[0], model.by_parameters(pulse, pose)
            new = by_p - basis @ (basis.T @ by_p)
            gain = float(np.linalg.slogdet(model.information + new.T @ new)[1])
            if gain > best:
                best, chosen = gain, (currents, seconds)
        if chosen is not None:
            self._pulse(*chosen)
        return chosen is not None

    def _is_gentle(self, poses: Vector) -> bool:
        """Return whether a predicted motion is slow, and stays where it can be followed."""
        middles = middle_of(poses, self._length)
        steps, away = np.hypot(*np.diff(middles, axis=0).T), np.hypot(*middles.T)
        path, turns = float(np.hypot(*(middles - middles[0]).T).max()), np.abs(np.diff(poses[:, 2]))
        leads_out = away.max() > 0.5 * self._radius and away[-1] > away[0]
        slow = steps.max() < 6e-3 * FRAME_TIME and turns.max() < 5.0 * FRAME_TIME  # m/s, rad/s; as the tracker follows
        return bool(slow and not leads_out and 2e-4 < path < 1.2e-3)  # m; it tells something, and stays near

    def _error(self, model: PulseModel, pulse: Pulse) -> tuple[float, float]:
        """Return the error of a prediction from the rest before: share of the displacement, and heading [rad]."""
        rig = model.parameters
        before = pulse.times < pulse.on + rig.delay
        rest = Pulse(np.zeros_like(pulse.currents), pulse.on, pulse.on, pulse.times[before], pulse.poses[before])
        start = model.start_of(rest, pulse.poses[0])
        predicted, measured = rig.poses(pulse, start)[-5:].mean(axis=0), pulse.poses[-5:].mean(axis=0)
        error = middle_of(predicted, self._length) - middle_of(measured, self._length)
        way = max(self._motion(pulse)[0], 3e-4)  # m; as a shorter one is measured to some micrometres
        return float(np.hypot(*error)) / way, abs(float(predicted[2] - measured[2]))

    def _intervals(self, model: PulseModel) -> tuple[float, float, float, float]:
        """Return the widest intervals of coil directions, strengths, drags and the delay; see `Commissioned`."""
        kinds, widths = ("angle", "field", "drag", "delay"), model.intervals.items()
        angle, gain, drag, delay = (max(width for name, width in widths if kind in name) for kind in kinds)
        return angle, gain, drag, DELAY_UNIT * delay

    def _changes(self, rig: RigParameters) -> list[str]:
        """Return what of the needle differs from the setup by more than a tenth."""
        believed = self._believed.needle_length
        if abs(rig.length / believed - 1.0) < 0.1:
            return []
        return [f"the needle is {1e3 * rig.length:.2f} mm long, not {1e3 * believed:.2f} mm"]

    def _failures(self, errors: Vector) -> list[str]:
        """Return why the verification failed."""
        if len(errors) < VERIFIED:
            return [f"only {len(errors)} of {VERIFIED} pulses could be verified: place the needle in the middle"]
        median, worst, heading = np.median(errors[:, 0]), errors[:, 0].max(), errors[:, 1].max()
        middling = f"the median error is {median:.1%} of the displacement ({MEDIAN_ERROR:.0%} allowed)"
        checks = (
            (median > MEDIAN_ERROR, middling),
            (worst > WORST_ERROR, f"the largest error is {worst:.1%} of the displacement ({WORST_ERROR:.0%} allowed)"),
            (heading > HEADING_ERROR, f"the heading is off by {math.degrees(heading):.1f} degrees (3 allowed)"),
        )
        return [words for failed, words in checks if failed]


def on_their_sides(
    rig: RigParameters, pulses: Sequence[Pulse], deviations: Vector, check: Callable[[], None] = lambda: None
) -> RigParameters:
    """Return a guess with each coil on the side of the dish for which a fit is better.

    A needle that lies along a field moves towards the coil, one that lies against it away, and rests there until chance
    turns it: one coil by itself has moved it in the same way from either side.

    Args:
        rig: a guess.
        pulses: of the ladder.
        deviations: of a measured pose, shape (3,) [m, m, rad].
        check: called all the time; raises what interrupts.
    """
    # One frame in three is enough to tell on which side a coil is.
    some = [replace(pulse, times=pulse.times[::3], poses=pulse.poses[::3]) for pulse in pulses]

    def error(guess: RigParameters) -> float:
        model = PulseModel(guess, deviations, check)
        with suppress(ValueError, np.linalg.LinAlgError):  # from a wrong side a fit may lead nowhere
            model.fit(some, rounds=1)
            return model.chi_square
        return math.inf

    best, least = rig, error(rig)
    while True:  # until none is better: what a coil explains may be another one's
        rig, before = best, least
        for turned in np.pi * np.eye(len(rig.angles)):
            other = replace(rig, angles=rig.angles + turned)
            if (tried := error(other)) < least:
                best, least = other, tried
        if not least < before:
            return rig


def no_answer(dead: Sequence[int], count: int) -> str:
    """Return what to say of coils that do not move the needle."""
    if len(dead) == count:
        return "no coil moves the needle: it is stuck, or the boards are not connected"
    return "; ".join(f"coil {coil} does not answer: it is not connected" for coil in dead)


def find_wiring(believed: CoilBridgeSettings, angles: Vector, signs: Vector) -> list[str]:
    """Return what explains where the coils are, by the fewest faults, and which way they and the needle are magnetised.

    Args:
        believed: the coils as the setup has them.
        angles: where they show to be, shape (m,) [rad].
        signs: of their fields for a positive current, shape (m,).
    """
    coils = believed.coils_properties()
    expected, count = np.array([coil.angle for coil in coils]), len(coils)
    swaps: list[tuple[int, ...]] = [(), *combinations(range(count), 2)]
    explained = []
    for mirrored in (False, True):
        for swap in swaps:
            order = list(range(count))
            if swap:
                order[swap[0]], order[swap[1]] = swap[1], swap[0]
            there = (-expected if mirrored else expected)[order]
            rotation = float(np.angle(np.exp(1j * (angles - there)).sum()))
            apart = np.abs([math.remainder(a - b - rotation, math.tau) for a, b in zip(angles, there, strict=True)])
            if apart.max() < 0.4:
                words = [f"cables {swap[0]} and {swap[1]} are exchanged"] if swap else []
                words += ["the camera shows a mirror image"] if mirrored else []
                explained.append((len(words), abs(rotation) > 0.35, words, rotation))
    findings = []
    if not explained:
        findings.append("the coils are not where the setup says, in any order of two")
    else:
        least = min(explained)[0]
        best = [each for each in explained if each[0] == least]
        if least:
            findings.append(", or ".join(dict.fromkeys(" and ".join(each[2]) for each in best)))
        if len(best) == 1 and abs(best[0][3]) > 0.1:
            findings.append(f"the camera is turned by {math.degrees(best[0][3]):.0f} degrees against the coils")
    known = signs * np.sign([coil.field_per_current for coil in coils])
    if 2 * np.count_nonzero(known < 0.0) > count:
        findings.append("the needle is magnetised the other way")
        known = -known
    return findings + [f"coil {k} is wound the other way" for k in np.flatnonzero(known < 0.0)]
