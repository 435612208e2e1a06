"""A needle whose bridge ends while it is turned, on the simulated rig: the held field holds its direction too."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.coils.needle_motion import NeedleTwist
from magnetosuture_thread.geometry.scene import Dish, Scene
from magnetosuture_thread.rig.setups import read_setup


@pytest.mark.parametrize("name", ["hernia_ring", "petri_35mm_polyamide", "petri_150mm_silk"])
@pytest.mark.parametrize("heading", [0.3, 1.2, 2.5])
@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_needle_that_is_turned_stops_turning_within_the_turn_time_though_the_currents_last(
    name: str, heading: float, sense: float
):
    setup = read_setup(name)
    coils, (x, y, angle) = setup.coils, setup.rig.needle_start
    start = cmath.rect(1.0, heading - angle) * complex(x, y)  # the setup's own start, turned about the dish's centre
    rig = replace(setup.rig, needle_start=(start.real, start.imag, heading))
    dynamics = rig.dynamics(Scene(Dish(setup.scene.dish.diameter), ()))
    assert dynamics.heading == pytest.approx(heading)
    allocation, needle = coils.allocation(), coils.needle()
    rate, period = sense * coils.max_speed / (0.5 * needle.chord), 1.0 / coils.rate
    angle, previous = dynamics.heading, allocation.zero().currents
    for _ in range(round(0.06 / period)):
        direction = np.array([math.cos(angle), math.sin(angle)])
        change = coils.max_current_slew * period
        found = allocation.allocate(NeedleTwist(turn_rate=rate), dynamics.tail, direction, previous, change)
        previous = found.currents
        dynamics.step(previous, period)
        angle += rate * period  # as the bridge believes
    before = dynamics.heading
    dynamics.step(previous, coils.driver_timeout)
    turned = sense * math.remainder(dynamics.heading - before, 2.0 * math.pi)
    assert abs(math.remainder(before - angle, 2.0 * math.pi)) < 0.3, "it follows"
    assert turned < abs(rate) * coils.turn_time
