"""A barrier that moves, in bridge and thread model: at the same place in both, whatever the clock says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magnetosuture_thread.coils.bridge import NEEDLE, CoilBridge
from magnetosuture_thread.coils.drivers import DriverState
from magnetosuture_thread.coils.latch import ArmingLatch
from magnetosuture_thread.estimator.thread_session import ThreadSession
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.thread.prediction import NeedlePose
from test.examples import FOLDER, load_example
from test.shared import known

MovingDisc = load_example("barriers/moving_disc").MovingDisc
NAMES = ("moving_disc:MovingDisc",)
SCENE = Scene.create(dish_diameter=0.035)
DURATION = 2.0  # s


@pytest.mark.parametrize("in_frame_of_needle", [False, True])
@pytest.mark.parametrize("start", [1.0, 1.7e9])  # s; a simulated clock, and that on the wall
def test_the_example_holds_in_a_closed_loop_at_any_time_of_the_day(
    start: float, in_frame_of_needle: bool, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.syspath_prepend(str(FOLDER / "barriers"))
    setup, driver, latch, disc = read_setup("petri_35mm_polyamide_post"), DriverState(True), ArmingLatch(), MovingDisc()
    settings = replace(setup.coils, barriers=NAMES, motion_compensation=False)
    bridge = CoilBridge(settings, latch, SCENE)
    session = ThreadSession(replace(setup.model, barriers=NAMES, initial_shape="straight"), SCENE)
    latch.activate()
    bridge.arm(driver)
    needle = settings.needle().kinematics
    tail, heading = np.array([-0.009, 0.0015 - needle.chord]), np.array([0.0, 1.0])
    fleeing, least = False, np.inf
    for step in range(round(DURATION * settings.rate)):
        now = start + step / settings.rate
        disc.set_time(now - start)
        least = min(least, float(disc.value(np.array([tail, needle.tip(tail, heading)])).min()))
        bridge.on_pose(tail, heading, now, step + 1, now, now)
        if step % 3 == 0:
            result = session.on_pose(round(1e9 * now), NeedlePose(now, tail, heading))
            prediction = known(result.prediction)
            expected = disc.value(prediction.positions)
            np.testing.assert_allclose(prediction.margins["moving_disc"].value, expected, atol=2e-9)
        command = np.array([0.0, -0.003 if fleeing else 0.001])  # towards the disc until that counts, then off
        command = np.array(needle.twist(heading, command)) if in_frame_of_needle else command
        bridge.command(NEEDLE, command, now, step + 1, now, now)
        bridge.on_margins(now, True, 1.0, SCENE.version, now)
        output = bridge.step(now, now, driver)
        fleeing = fleeing or "moving_disc" in output.active
        along, across = needle.body_velocity(heading, output.applied)
        tail, heading = needle.moved(tail, heading, along, across, 1.0 / settings.rate)
    assert fleeing
    assert 0.0 < least < 0.0008
    assert tail[1] < -0.001 - needle.chord  # and it got away
