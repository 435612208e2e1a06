"""Runs of a thread whose parameters are known: made by the rig's rod, or by the thread model itself."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.calibration.parameters import with_stiffness_over_drag
from magnetosuture_thread.calibration.recorded_run import RecordedRun, read_run
from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.estimator.thread_session import ThreadSession
from magnetosuture_thread.evaluation.frames import Observation
from magnetosuture_thread.geometry.polyline import Points, points_at
from magnetosuture_thread.rig.dynamics import NeedleBody, NeedleJoint, RigDynamics, Surface, ThreadProperties
from magnetosuture_thread.thread.prediction import NeedlePose
from test.shared import known

SETTINGS = ThreadModelSettings(thread_length=0.019, segments=12, max_step=0.07)  # one step a pose
SILK = ThreadModelSettings(material="silk_6_0", thread_length=0.15, segments=30, max_step=0.07)
DRAG, LENGTH = 1.0, 0.019  # Pa s, m; of the rig's thread
RATE = 15.0  # poses a second
NEEDLE = NeedleBody(length=7e-3, diameter=4e-4, curvature=0.0, magnetisation=0.0, viscosity=1.0)
Array = NDArray[np.float64]


def path(time: float, scale: float = 6e-3, period: float = 8.0, phase: float = 0.0) -> tuple[Points, float]:
    """Return tail and heading of a needle that draws an eight."""
    w = 2.0 * math.pi / period
    turn = w * time + phase
    tail = scale * np.array([math.sin(turn), 0.5 * math.sin(2.0 * turn)])
    return tail, math.atan2(math.cos(2.0 * turn), math.cos(turn))


@cache
def rig_run(ratio: float, duration: float = 6.0, phase: float = 0.0, clamped: bool = False) -> tuple[Observation, ...]:
    """Return what is seen of a thread with this B = EI / zeta_perp [m^4/s], by the rig's rod, exactly."""
    thread = ThreadProperties(
        LENGTH, 40, ratio * DRAG, 5.6, DRAG, 0.5 * DRAG, NeedleJoint.CLAMPED if clamped else NeedleJoint.PINNED
    )
    tail, heading = path(0.0, phase=phase)
    behind = tail - LENGTH * np.linspace(0.0, 1.0, 3)[:, None] * [math.cos(heading), math.sin(heading)]
    rig = RigDynamics(NEEDLE, thread, Surface(), None, tail, heading, behind)
    found, last = [], heading
    for index in range(round(duration * RATE)):
        time = index / RATE
        tail, heading = path(time, phase=phase)
        heading += 2.0 * math.pi * round((last - heading) / (2.0 * math.pi))
        last = heading
        if index:
            rig.drive(tail, heading, 1.0 / RATE)
        curve = points_at(rig.thread, np.linspace(0.0, LENGTH, 64))
        way = np.array([math.cos(heading), math.sin(heading)])
        found.append(Observation(round((1.0 + time) * 1e9), tail, way, curve, curve))
    return tuple(found)


def noisy(sights: tuple[Observation, ...], noise: float) -> Iterator[Observation]:
    """Give sights as a camera with such a noise would [m]; of the heading it is a seventh of a millimetre's."""
    rng = np.random.default_rng(1)
    for sight in sights:
        tail = sight.tail + noise * rng.standard_normal(2)
        turn = noise / 7e-3 * rng.standard_normal()
        x, y = sight.heading
        heading = np.array([x * math.cos(turn) - y * math.sin(turn), x * math.sin(turn) + y * math.cos(turn)])
        seen = np.vstack([tail, sight.measured[1:] + noise * rng.standard_normal((len(sight.measured) - 1, 2))])
        yield replace(sight, tail=tail, heading=heading, measured=seen)


def model_run(
    settings: ThreadModelSettings, duration: float = 6.0, scale: float = 6e-3, period: float = 8.0
) -> tuple[Observation, ...]:
    """Return what is seen of a thread that moves exactly as the model says."""
    session = ThreadSession(replace(settings, initial_shape="straight"), None)
    found = []
    for index in range(round(duration * RATE)):
        stamp = round((1.0 + index / RATE) * 1e9)
        tail, angle = path(index / RATE, scale, period)
        heading = np.array([math.cos(angle), math.sin(angle)])
        outcome = session.on_pose(stamp, NeedlePose(stamp * 1e-9, tail, heading))
        found.append(Observation(stamp, tail, heading, known(outcome.prediction).positions))
    return tuple(found)


def rig_passage(ratio: float, noise: float = 0.0, clamped: bool = False) -> RecordedRun:
    """Return a run of the rig as a passage."""
    sights = rig_run(ratio, clamped=clamped)
    return read_run("run", noisy(sights, noise) if noise else sights, SETTINGS)


def stiff(ratio: float, settings: ThreadModelSettings = SETTINGS) -> ThreadModelSettings:
    """Return settings with this B [m^4/s]."""
    return with_stiffness_over_drag(settings, ratio)
