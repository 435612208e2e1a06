"""Coulomb friction of the thread at contacts: closed forms, stick and slip."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest

from benchmarks.friction import DIAMETER, EAST, POST, RATE, SPEED, capstan, capstan_error, stiff_capstan
from magnetosuture_thread import Disc, NeedlePose, ThreadPredictor, Workspace
from magnetosuture_thread.thread.formulations import make_formulation
from magnetosuture_thread.thread.margins import FrictionState
from magnetosuture_thread.thread.material import Attachment, Medium, Thread
from magnetosuture_thread.thread.program import ChainProgram, Solution, Vector
from magnetosuture_thread.thread.rod import FRICTION_TOLERANCE, MAX_FRICTION_SOLVES
from magnetosuture_thread.thread.solvers import BandedSolver, OsqpSolver


def thread_of(length: float, segments: int, medium: Medium, bending_stiffness: float = 0.0) -> Thread:
    return Thread("thread", length, segments, DIAMETER, bending_stiffness, medium, Attachment.PINNED)


@pytest.mark.parametrize("angle", [0.5 * math.pi, 2.0 * math.pi])
@pytest.mark.parametrize("friction", [0.1, 0.3, 0.5])
def test_a_flexible_thread_around_a_post_has_the_tensions_of_a_capstan(friction: float, angle: float):
    """T_2 = T_1 exp(mu theta) + f r (exp(mu theta) - 1) / mu, with the drag f per length of the part on the post."""
    assert abs(capstan_error(friction, angle, 120)) < 2.0


class RecordingSolver:
    """The structured solver, whose last program and solution are kept."""

    name = "recording"

    def __init__(self) -> None:
        self._solver = BandedSolver()
        self.solved: list[tuple[ChainProgram, Solution]] = []

    def solve(self, program: ChainProgram, velocities: np.ndarray, multipliers: Vector) -> Solution:
        solution = self._solver.solve(program, velocities, multipliers)
        self.solved.append((copy.deepcopy(program), solution))
        return solution


@pytest.mark.parametrize("friction", [0.2, 0.5])
def test_friction_is_within_its_cone_and_opposes_the_slip_as_a_general_solver_has_it(friction: float):
    """Coulomb's conditions by the program's rows alone: |F| <= mu N, F = mu N against the slip, no slip below."""
    predictor, nodes = capstan(friction, math.pi, 40, 1e-12)
    solver = RecordingSolver()
    workspace = Workspace((Disc((0.0, 0.0), POST),), 2e-3, friction=(friction,))
    formulation = make_formulation("rod", predictor.thread, workspace, solver, 1e-6)
    predictor = ThreadPredictor(predictor.thread, formulation=formulation)
    predictor.start_at(NeedlePose(0.0, nodes[0], EAST), nodes)
    sliding = settled = 0
    for k in range(1, 21):
        before = len(solver.solved)
        prediction = predictor.step(NeedlePose(k / RATE, nodes[0] + SPEED * k / RATE * EAST, EAST))
        assert prediction.converged
        settles = len(solver.solved) - before < MAX_FRICTION_SOLVES
        settled += settles
        program, solution = solver.solved[-1]
        pushes, rubs = np.isinf(program.upper) & np.isfinite(program.lower), np.isfinite(program.limit)
        shares = np.linalg.norm(program.gradient, axis=2)
        pull = program.gradient * solution.multipliers[:, None, None]
        slip = np.einsum("rkd,rkd->r", program.gradient, solution.velocities[program.first[:, None] + np.arange(3)])
        for row in np.flatnonzero(rubs):
            same = pushes & (program.first == program.first[row]) & np.isclose(shares, shares[row]).all(axis=1)
            node = int(shares[row].argmax())
            normal = float(np.linalg.norm(pull[same, node].sum(axis=0))) / shares[row, node]
            force, missed = solution.multipliers[row], slip[row] - program.lower[row]
            assert abs(force) <= program.limit[row]
            if settles:  # a limit is of the normal force of the solve before, until that changes by no more than this
                change = 1.05 * FRICTION_TOLERANCE * program.limit[rubs].max()
                assert abs(force) <= friction * normal + change
            if abs(force) < program.limit[row] * (1.0 - 1e-9):
                assert missed + program.compliance[row] * force == pytest.approx(0.0, abs=1e-7)
            else:
                assert missed * force <= 1e-9
                sliding += 1
        found = OsqpSolver(1e-10).solve(program, solution.velocities, solution.multipliers)
        assert found.residuals.largest < 1e-5
        np.testing.assert_allclose(found.velocities, solution.velocities, atol=1e-5)
    forces = prediction.forces
    assert forces is not None
    assert FrictionState.SLIDING in forces.friction_states
    assert sliding > 100
    assert settled > 10


@pytest.mark.parametrize(("friction", "stiffness"), [(0.3, 0.2), (0.5, 0.3)])
def test_a_stiff_thread_around_a_post_has_the_tensions_of_elastica_theory(friction: float, stiffness: float):
    """The theory is 5 to 12 % below that of a flexible thread; drag on the bent ends is not in it."""
    found = stiff_capstan(friction, stiffness, 200)
    assert found.elastica < 0.95 * found.flexible
    assert found.measured == pytest.approx(found.elastica, rel=0.02)


@pytest.mark.parametrize(("friction", "held"), [(0.0, False), (0.5, True)])
def test_a_thread_held_by_friction_does_not_creep(friction: float, held: bool):
    """A flow draws at both ends of a thread around a post, harder at the longer one."""
    medium = Medium(1.0, 0.5, flow=(1e-3, 0.0))
    predictor = ThreadPredictor(
        thread_of(0.0195, 90, medium, 1e-13), Workspace((Disc((0.0, 0.0), 1e-3),), 2e-3, friction=(friction,))
    )
    turned, radius = np.linspace(math.pi / 2, 1.5 * math.pi, 40), 1e-3 + 0.5 * DIAMETER
    around = radius * np.column_stack([np.cos(turned), np.sin(turned)])
    path = np.vstack([[(4e-3, 3e-3), (5e-3, 2.5e-3), (5e-3, 1.6e-3)], around, [(0.03, -radius)]])
    rest = NeedlePose(0.0, path[0], np.array([-1.0, 0.0]))
    predictor.start(rest, path, strict=False)
    along = [predictor.step(NeedlePose(0.1 * k, rest.tail, rest.heading)).positions[-1, 0] for k in range(1, 151)]
    assert (abs(along[-1] - along[75]) < 1e-7) == held
