"""Every procedure that ships fits its setup and scene; a needle that moves as the filter lets it gets to its end."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.coils.needle_motion import NeedleTwist
from magnetosuture_thread.planning.executor import ProcedureExecutor, ProcedureState, ThreadCondition
from magnetosuture_thread.planning.procedure import Tighten, parse_procedure, read_procedure
from magnetosuture_thread.rig.closed_loop import LATENCY
from magnetosuture_thread.rig.setups import read_procedure_setup
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.files import share_directory
from magnetosuture_thread.thread.prediction import NeedlePose

pytestmark = pytest.mark.slow

FOLDER = share_directory("magnetosuture_thread") / "config" / "procedures"
SHIPPED = sorted(path.stem for path in FOLDER.glob("*.yaml"))
PERIOD = 0.05


@pytest.mark.parametrize("name", SHIPPED)
def test_an_ideal_needle_gets_to_the_end_by_certified_motions(name: str):
    procedure = read_procedure(name)
    setup = read_procedure_setup(procedure)
    setup.rig.check_scene(setup.scene)
    predictor = setup.model.predictor(setup.scene)  # refuses a shape that the thread would pass through
    planner, keep_out = setup.planner.planner(setup.scene), setup.coils.keep_out
    executor = ProcedureExecutor(procedure, planner)
    safety = setup.coils.safety_filter(setup.scene)
    x, y, angle = setup.rig.needle_start
    tail, heading, time = np.array([x, y]), np.array([math.cos(angle), math.sin(angle)]), 0.0
    executor.start()
    clearance, tight_at = math.inf, math.inf
    predictor.start(NeedlePose(0.0, tail, heading), setup.rig.thread_at_start(np.linspace(0.0, 1.0, 100)))
    while executor.state is ProcedureState.RUNNING and time < 300.0:
        # The thread is tight half a second after it is pulled, by its tension or close to the shape.
        thread = predictor.step(NeedlePose(time + PERIOD, tail, heading)).positions
        goal, condition = procedure.goals[executor.goal], ThreadCondition(thread)
        if isinstance(goal, Tighten):
            tight_at = min(tight_at, time + 0.5)
            if time >= tight_at:
                at = [shape.solid.centroid.coords[0] for shape in setup.scene.shapes if shape.name == goal.around]
                centre = np.array(at[0]) if at else np.zeros(2)
                drawn = centre + 0.1 * (thread - centre)  # which winds as before
                condition = replace(condition, tension=goal.tension, vertices=drawn)
        twist = NeedleTwist(*executor.update(time, tail, heading, condition))
        tip = safety.kinematics.tip_velocity(heading, twist)
        share, _ = safety.safe_share(tip, tail, heading, twist.across)
        moved = safety.kinematics.body_velocity(heading, share * tip)
        tail, heading = safety.kinematics.moved(tail, heading, *moved, PERIOD, share * twist.across)
        clearance, time = min(clearance, safety.clearance(tail, heading)), time + PERIOD
    assert (executor.state, executor.reason) == (ProcedureState.DONE, "")
    assert clearance >= keep_out - 1e-9


@pytest.mark.parametrize("name", SHIPPED)
def test_a_lost_frame_does_not_stop_its_needle_and_friction_does_not_slow_it(name: str):
    setup = read_procedure_setup(read_procedure(name))
    assert setup.coils.command_timeout > 2.0 / setup.rig.frame_rate + LATENCY
    feedback = {setup.coils.friction_feedback, setup.planner.friction_feedback, setup.model.friction_feedback}
    assert feedback == {"operator"}, "bridge, planner and forecast agree"


def test_a_procedure_brings_its_own_scene_to_any_setup():
    procedure = read_procedure("slalom")
    assert read_procedure_setup(procedure, "hernia_ring").scene.names == tuple(f"post_{k}" for k in range(1, 6))
    plain = parse_procedure({"goals": [{"withdraw": {}}]}, "plain")
    assert "ring" in read_procedure_setup(plain, "hernia_ring").scene.names


def test_a_procedure_without_a_setup_or_with_a_scene_that_is_none_is_refused(tmp_path: Path):
    with pytest.raises(ConfigurationError, match="as the procedure plain names none"):
        read_procedure_setup(parse_procedure({"goals": [{"withdraw": {}}]}, "plain"))
    missing = parse_procedure({"scene": str(tmp_path / "none.yaml"), "goals": [{"withdraw": {}}]}, "plain")
    with pytest.raises(ConfigurationError, match=r"none\.yaml"):
        read_procedure_setup(missing, "hernia_ring")
    with pytest.raises(ConfigurationError, match="the name of a scene"):
        parse_procedure({"scene": 3, "goals": [{"withdraw": {}}]}, "plain")


def test_a_procedure_that_its_setup_cannot_carry_out_is_refused(tmp_path: Path):
    fast = {"goals": [{"withdraw": {}}, {"withdraw": {}, "limits": {"speed": 0.05}}], "setup": "dish_50mm"}
    with pytest.raises(
        ConfigurationError, match=r"goals\[1\]\.limits\.speed.*coil_bridge\.max_speed of dish_50mm, 0\.025"
    ):
        read_procedure_setup(parse_procedure(fast, "fast"))
    wide = {"goals": [{"withdraw": {}}], "setup": "dish_50mm", "scene": "dish_150mm"}
    with pytest.raises(ConfigurationError, match="at most 108 mm, which the coils of dish_50mm leave"):
        read_procedure_setup(parse_procedure(wide, "wide"))
