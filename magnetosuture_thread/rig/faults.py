"""Faults of the simulated rig, on request: when each is in force, and what it does to a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.rig.camera import Cover
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError

GLARE, HAND, TOOL = "glare", "hand", "tool"
DIM, OVEREXPOSED = "dim", "overexposed"
DROPPED, LATE, CAMERA_STOPPED = "dropped_frames", "late_frames", "camera_stopped"
NEEDLE_OUT, COIL_STUCK = "needle_out", "coil_stuck"
KINDS = (GLARE, HAND, TOOL, DIM, OVEREXPOSED, DROPPED, LATE, CAMERA_STOPPED, NEEDLE_OUT, COIL_STUCK)

LIFT_TIME = 0.6  # s in which the needle is carried over the rim
STEEL_BGR = (115.0, 112.0, 108.0)


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes:
        kind: one of `KINDS`.
        start: when it begins [s].
        duration: how long it lasts [s].
    """

    kind: str
    start: float
    duration: float

    @classmethod
    def parse(cls, text: str) -> Fault:
        """Read `KIND START DURATION`, in seconds.

        >>> Fault.parse("glare 2 0.5")
        Fault(kind='glare', start=2.0, duration=0.5)

        Raises:
            ConfigurationError: it is nothing of the kind.
        """
        words = text.split()
        try:
            start, duration = (float(word) for word in words[1:])
        except ValueError:
            start = duration = float("nan")
        if not words or words[0] not in KINDS or not (0.0 <= start < 1e6 and 0.0 < duration < 1e6):
            expectation = f"KIND START DURATION in seconds, with a kind of {', '.join(KINDS)}"
            raise ConfigurationError("rig_simulator.faults", repr(text), expectation)
        return cls(words[0], start, duration)

    @classmethod
    def requested(cls, text: str, time: float) -> Fault:
        """Read `KIND DURATION` as a fault that begins at a time [s].

        >>> Fault.requested("glare 0.5", 7.0)
        Fault(kind='glare', start=7.0, duration=0.5)

        Raises:
            InvalidInputError: it is nothing of the kind.
        """
        kind, _, duration = text.partition(" ")
        try:
            return cls.parse(f"{kind} {time!r} {duration}")
        except ConfigurationError:
            expectation = f"KIND DURATION, with a kind of {', '.join(KINDS)}"
            raise InvalidInputError("rig/fault", repr(text), expectation) from None

    def holds(self, time: float) -> bool:
        """Return whether the fault is in force at a time [s]."""
        return self.start <= time < self.start + self.duration


class FaultSchedule:
    """All faults of a run.

    Args:
        faults: in any order; they may overlap.
        dish_diameter: [m]
        needle_length: [m]
        seed: of where glare, hand and tool lie.
    """

    def __init__(self, faults: Sequence[Fault], dish_diameter: float, needle_length: float, seed: int) -> None:
        self.faults = tuple(faults)
        self._dish = dish_diameter
        self._needle = needle_length
        self._seed = seed

    def set_dish(self, diameter: float) -> None:
        """Take another dish, of this inner diameter [m]."""
        self._dish = diameter

    def add(self, fault: Fault) -> None:
        """Take one more fault, and forget those that are over."""
        self.faults = (*(f for f in self.faults if f.start + f.duration > fault.start), fault)[-100:]

    def kinds(self, time: float) -> frozenset[str]:
        """Return the kinds in force at a time [s]."""
        return frozenset(fault.kind for fault in self.faults if fault.holds(time))

    def gain(self, time: float) -> float:
        """Return the exposure's gain."""
        kinds = self.kinds(time)
        return (0.3 if DIM in kinds else 1.0) * (1.9 if OVEREXPOSED in kinds else 1.0)

    def drops(self, time: float, chance: float) -> bool:
        """Return whether a frame gets lost; `chance` is drawn from 0 to 1."""
        kinds = self.kinds(time)
        # Half of the frames get lost.
        return CAMERA_STOPPED in kinds or (DROPPED in kinds and chance < 0.5)

    def lateness(self, time: float) -> float:
        """Return how long a frame is held back [s]."""
        # A late frame comes 0.12 s later.
        return 0.12 if LATE in self.kinds(time) else 0.0

    def lifted(self, time: float) -> NDArray[np.float64]:
        """Return by how much the needle has been carried out of the dish, shape (2,) [m]."""
        for fault in self.faults:
            if fault.kind == NEEDLE_OUT and fault.holds(time):
                up = min(1.0, (time - fault.start) / LIFT_TIME)
                down = min(1.0, (fault.start + fault.duration - time) / LIFT_TIME)
                angle = self._random(fault).uniform(0.0, 2.0 * np.pi)
                return np.asarray(min(up, down) * 1.2 * self._dish * np.array([np.cos(angle), np.sin(angle)]))
        return np.zeros(2)

    def covers(self, time: float, tail: Points, tip: Points) -> tuple[Cover, ...]:
        """Return what lies between the dish and the camera.

        Glare, hand and tool lie on some place of the needle and move a little with every frame.

        Args:
            time: [s].
            tail: of the needle, shape (2,) [m].
            tip: shape (2,) [m].
        """
        result = []
        for fault in self.faults:
            if not fault.holds(time) or fault.kind not in (GLARE, HAND, TOOL):
                continue
            random = self._random(fault)
            place = tail + random.uniform(0.0, 1.0) * (tip - tail)
            angle = random.uniform(0.0, 2.0 * np.pi)
            sway = 0.03 * self._dish * np.sin(5.0 * (time - fault.start) + angle)
            if fault.kind == GLARE:
                # The radius is 0.3 to 0.55 of the needle's length.
                radius = self._needle * random.uniform(0.3, 0.55)
                outline = _ellipse(place, radius, random.uniform(0.5, 1.0) * radius, angle)
                result.append(Cover(outline, (265.0, 265.0, 265.0), blur_px=4.0))
            else:
                width = (0.28 if fault.kind == HAND else 0.07) * self._dish
                bgr = (120.0, 145.0, 195.0) if fault.kind == HAND else STEEL_BGR
                outline = _finger(place, angle, width, sway, 3.0 * self._dish)
                result.append(Cover(outline, bgr, blur_px=3.0 if fault.kind == HAND else 1.5))
        return tuple(result)

    def _random(self, fault: Fault) -> np.random.Generator:
        """Return chances that are a fault's own, whatever others there are."""
        return np.random.default_rng((self._seed, KINDS.index(fault.kind), round(1e6 * fault.start)))


def _ellipse(centre: Points, a: float, b: float, angle: float) -> Points:
    turn = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    return np.asarray(centre + a * np.cos(turn)[:, None] * along + b * np.sin(turn)[:, None] * across)


def _finger(end: Points, angle: float, width: float, sway: float, length: float) -> Points:
    """Return a strip that comes in from far away at an angle and ends, rounded, beyond a place."""
    inwards = -np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-inwards[1], inwards[0]])
    turn = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 24)
    end = end + 0.3 * width * inwards + sway * across
    cap = end + 0.5 * width * (np.cos(turn)[:, None] * inwards + np.sin(turn)[:, None] * across)
    back = end - length * inwards
    return np.vstack([back - 0.5 * width * across, cap, back + 0.5 * width * across])
