"""Coil currents whose motion of the needle the safety filter certifies."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from magnetosuture_thread.coils.allocation import Allocation, CertifiedAllocation
from magnetosuture_thread.coils.filter import NeedleSafetyFilter
from magnetosuture_thread.coils.inputs import Pose
from magnetosuture_thread.coils.needle_motion import NeedleTwist
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.obstacles import Polygon
from magnetosuture_thread.geometry.scene import Dish, Scene, SceneShape

SETTINGS = CoilBridgeSettings(motion_compensation=True, needle_length=0.0025, keep_out=2.5e-4)
ZERO = SETTINGS.allocation().zero()
HEADING = 0.6  # rad; off the axes of the coils, where there is a force across the needle
E = np.array([math.cos(HEADING), math.sin(HEADING)])
LEFT = np.array([-E[1], E[0]])


def blocks(*gaps: float, along: NDArray[np.float64] = E) -> Scene:
    """Return a dish with blocks beside the needle, which lies in the middle: at these distances to its left [m]."""
    shapes, left = [], np.array([-along[1], along[0]])
    for k, gap in enumerate(gaps):
        far = gap + math.copysign(2e-3, gap)
        corners = [a * along + b * left for a, b in ((-4e-3, gap), (4e-3, gap), (4e-3, far), (-4e-3, far))]
        polygon = Polygon(tuple((float(x), float(y)) for x, y in corners))
        shapes.append(SceneShape(f"block_{k}", "wall", polygon))
    return Scene(Dish(0.05), tuple(shapes))


def certified_share(safety: NeedleSafetyFilter, pose: Pose, found: Allocation, pull: NeedleTwist) -> float:
    """Return the share of the motion by currents and pull together that is safe for the hold."""
    motion = found.velocity + safety.kinematics.tip_velocity(pose.heading, pull)
    return safety.safe_share(motion, pose.tail, pose.heading, found.drift + pull.across)[0]


@pytest.mark.parametrize("pull", [0.0, 8e-4])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_needle_too_close_to_a_block_leaves_it_sideways_against_what_pulls_it(side: float, pull: float):
    scene = blocks(side * 2e-4)  # 0.05 mm closer than keep_out
    safety, coils = SETTINGS.safety_filter(scene), CertifiedAllocation(SETTINGS.allocation(), SETTINGS.max_speed)
    pose = Pose(-1.25e-3 * E, E)
    pulled = NeedleTwist(0.0, side * pull)
    twist = NeedleTwist(1e-3, safety.sidestep(pose.tail, pose.heading))
    found, _ = coils.allocate(twist, pose, safety, ZERO, math.inf, pulled)
    assert -side * (found.drift + pulled.across) > 5e-4
    assert certified_share(safety, pose, found, pulled) == 1.0


def test_command_and_compensation_give_a_needle_with_a_slack_thread_no_more_than_its_greatest_speed():
    settings = CoilBridgeSettings(motion_compensation=True, thread_drag=0.0093, max_speed=2e-3)
    safety, coils = settings.safety_filter(Scene(Dish(0.05))), CertifiedAllocation(settings.allocation(), 2e-3)
    needle = settings.needle()
    for angle in np.linspace(0.0, 2.0 * math.pi, 12):
        e = np.array([math.cos(angle), math.sin(angle)])
        pose = Pose(-0.5 * needle.chord * e, e)
        found, limit = coils.allocate(NeedleTwist(2e-3), pose, safety, ZERO, math.inf, NeedleTwist(-5e-3, 1e-3))
        force = math.hypot((found.velocity @ e) * needle.drag, found.drift * needle.drag_across)
        assert force / needle.slack_drag <= 2e-3 * (1.0 + 1e-9)
        assert limit == "speed"


@pytest.mark.parametrize("pull", [3e-3, 9e-3, 0.5])
def test_whatever_pull_is_measured_the_coils_give_the_needle_what_is_wanted_and_the_greatest_pull_at_most(pull: float):
    settings = CoilBridgeSettings(motion_compensation=True, thread_drag=0.0093, max_pull=6e-5, max_speed=0.02)
    safety, needle = settings.safety_filter(Scene(Dish(0.05))), settings.needle()
    coils = CertifiedAllocation(settings.allocation(), settings.max_speed, needle.max_pull_speed)
    for angle in np.linspace(0.0, 2.0 * math.pi, 12):
        e = np.array([math.cos(angle), math.sin(angle)])
        pose = Pose(-0.5 * needle.chord * e, e)
        found, _ = coils.allocate(NeedleTwist(2e-3), pose, safety, ZERO, math.inf, NeedleTwist(-pull, 0.3 * pull))
        force = math.hypot((found.velocity @ e) * needle.drag, found.drift * needle.drag_across)
        assert force <= (2e-3 * needle.slack_drag + settings.max_pull) * (1.0 + 1e-9)


@pytest.mark.parametrize("seed", range(20, 30))
def test_where_currents_are_not_certified_with_what_is_measured_they_are_without_it(seed: int):
    random = np.random.default_rng(seed)
    left, right = random.uniform(2.4e-4, 5e-4, 2)
    safety = SETTINGS.safety_filter(blocks(left, -right))
    coils, pose = CertifiedAllocation(SETTINGS.allocation(), SETTINGS.max_speed), Pose(-1.25e-3 * E, E)
    pull, wanted = NeedleTwist(*random.uniform(-3e-3, 3e-3, 2)), NeedleTwist(*random.uniform(-4e-3, 4e-3, 3))
    found, _ = coils.allocate(wanted, pose, safety, ZERO, math.inf, pull)
    hold, _ = coils.allocate(NeedleTwist(), pose, safety, ZERO, math.inf, pull)
    if certified_share(safety, pose, hold, pull) == 1.0:
        assert certified_share(safety, pose, found, pull) == 1.0
    else:
        added = Allocation(found.currents, found.velocity - hold.velocity, False, found.drift - hold.drift)
        assert certified_share(safety, pose, added, NeedleTwist()) > 1.0 - 1e-6


@pytest.mark.parametrize("seed", range(12))
def test_a_torque_of_the_thread_certifies_no_currents_that_would_not_be_without_it(seed: int):
    """The thread may go slack, and takes its torque with it: this counts for neither currents nor their change."""
    random = np.random.default_rng(seed)
    safety, made = (
        SETTINGS.safety_filter(blocks(*random.uniform(2.4e-4, 2.6e-4, 2) * (1.0, -1.0))),
        SETTINGS.allocation(),
    )
    coils, pose = CertifiedAllocation(made, SETTINGS.max_speed), Pose(-1.25e-3 * E, E)
    uncertified = 0
    for _ in range(40):
        pull, wanted = NeedleTwist(*random.uniform(-3e-3, 3e-3, 2)), NeedleTwist(*random.uniform(-4e-3, 4e-3, 3))
        balance = float(8e-4 * random.standard_normal())  # of the observer, root mean square
        at = pose, safety, ZERO, math.inf, pull, balance
        hold, found = coils.allocate(NeedleTwist(), *at)[0], coils.allocate(wanted, *at)[0]
        if certified_share(safety, pose, hold, pull) < 1.0 and certified_share(safety, pose, found, pull) < 1.0:
            alone = made.motion(found.currents, pose.tail, pose.heading)
            assert certified_share(safety, pose, alone, NeedleTwist()) > 1.0 - 1e-6
            uncertified += 1
    assert uncertified > 3


@pytest.mark.parametrize(("place", "gap"), [(-0.089, 3.56e-4), (-0.07, 3.91e-4)])
def test_a_velocity_along_the_wall_is_reached_where_the_coils_draw_the_needle_to_the_wall(place: float, gap: float):
    """Their drift cannot be avoided close to a coil's axis: the needle turns away from the wall by as much."""
    settings = CoilBridgeSettings()
    safety, needle = settings.safety_filter(Scene(Dish(0.035))), settings.needle()
    out, e = np.array([math.cos(place), math.sin(place)]), np.array([-math.sin(place), math.cos(place)])
    reach = math.sqrt((0.0175 - settings.keep_out - gap) ** 2 - 0.25 * needle.chord**2)
    pose = Pose(reach * out - 0.5 * needle.chord * e, e)
    wanted = safety.filter(0.005 * e + 0.003 * out, pose.tail, pose.heading).filtered
    coils = CertifiedAllocation(settings.allocation(), settings.max_speed)
    found, _ = coils.allocate(needle.kinematics.twist(e, wanted), pose, safety, ZERO, math.inf, None)
    assert np.linalg.norm(found.velocity - wanted) < 1.5e-4
    assert safety.safe_share(found.velocity, pose.tail, pose.heading)[0] > 0.999


@pytest.mark.parametrize("speed", [1e-3, -1e-3])
def test_a_needle_on_a_coil_s_axis_that_is_pulled_to_a_block_may_be_driven_along_it_but_not_turned_to_it(speed: float):
    """No currents hold it there: the pull alone takes it closer than it may be, whatever is commanded."""
    east, north, pull = np.array([1.0, 0.0]), np.array([0.0, 1.0]), NeedleTwist(0.0, 1e-3)
    safety, coils = SETTINGS.safety_filter(blocks(2.6e-4, along=east)), CertifiedAllocation(SETTINGS.allocation(), 0.02)
    pose = Pose(-1.25e-3 * east, east)

    def allocated(twist: NeedleTwist) -> NDArray[np.float64]:
        found, _ = coils.allocate(twist, pose, safety, ZERO, math.inf, pull)
        assert found.drift + pull.across > 5e-4
        return found.velocity

    assert allocated(NeedleTwist(speed)) @ east == pytest.approx(speed, rel=0.05)
    turning = NeedleTwist(0.0, 0.0, 1e-3 / (0.5 * safety.kinematics.chord))
    assert abs((allocated(turning) - allocated(NeedleTwist())) @ north) < 1e-4
