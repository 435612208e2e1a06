"""PyElastica: a Cosserat rod in slender-body drag, stepped explicitly, its first node led.

An explicit method of a rod this thin and light would take millions of steps a second. The nodes get a mass
of 1 ms inertial time, cross-sections the inertia of a ball of half a segment, and stretch and shear are as
soft as the steps allow: 1 % of stretch at the tension of a hundred segments.
"""

from __future__ import annotations

import importlib
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.simulators import Scaled, check
from benchmarks.solver.cases import Case
from magnetosuture_thread.geometry.polyline import Points

SUBSTEPS = 80
INERTIAL_TIME = 1e-3  # s
STRETCH_STIFFNESS = 2e4  # 1/s, as the joint's
ROTATIONAL_DAMPING = 0.1  # of the drag of a segment, at the length D


class ElasticaRod:
    """A Cosserat rod of n elements.

    Args:
        case: the motion.
        substeps: of each pose sample.
    """

    name = "pyelastica"
    physics = "masses of 1 ms inertial time, soft stretch and shear"

    def __init__(self, case: Case, substeps: int = SUBSTEPS) -> None:
        check(case)
        elastica: Any = importlib.import_module("elastica")
        self._scaled, self._substeps = Scaled(case.thread), substeps
        self._interval = case.interval / substeps
        start = case.start / self._scaled.unit
        self._lead = _lead_class(elastica)
        self._rod = _rod(elastica, self._scaled, start)
        self._elastica_system = _system(elastica, self._rod, self._lead, self._interval)
        self._stepper = elastica.PositionVerlet()
        self._time = np.float64(0.0)
        self._lead.position = start[0].copy()

    def advance(self, tail: NDArray[np.float64]) -> Points:
        """Move the lead; see `Simulator`."""
        target = tail / self._scaled.unit
        begun = self._lead.position.copy()
        self._lead.velocity = (target - begun) / (self._substeps * self._interval)
        for i in range(1, self._substeps + 1):
            self._lead.position = begun + (target - begun) * (i / self._substeps)
            self._time = self._stepper.step(self._elastica_system, self._time, np.float64(self._interval))
        return np.array(self._rod.position_collection.T * self._scaled.unit)


def _rod(elastica: Any, scaled: Scaled, start: Points) -> Any:
    """Return a straight rod in D and s."""
    along = start[1] - start[0]
    normal = np.cross(along, [0.0, 0.0, 1.0])
    radius = 0.1
    rod = elastica.CosseratRod.straight_rod(
        scaled.segments,
        start[0],
        along / np.linalg.norm(along),
        normal / np.linalg.norm(normal),
        float(scaled.segments),
        radius,
        INERTIAL_TIME / (math.pi * radius**2),
        youngs_modulus=STRETCH_STIFFNESS / (math.pi * radius**2),
    )
    # What the round section would make of these is not what the thread has.
    rod.bend_matrix[...] = np.diag([scaled.joint] * 3)[:, :, None]
    rod.shear_matrix[...] = np.diag([0.1 * STRETCH_STIFFNESS] * 2 + [STRETCH_STIFFNESS])[:, :, None]
    inertia = 0.4 * INERTIAL_TIME * 0.5**2
    rod.mass_second_moment_of_inertia[...] = (inertia * np.eye(3))[:, :, None]
    rod.inv_mass_second_moment_of_inertia[...] = (np.eye(3) / inertia)[:, :, None]
    return rod


def _system(elastica: Any, rod: Any, lead: type[Any], interval: float) -> Any:
    """Return the rod in its liquid, its first node led."""
    system_class = type(
        "System",
        (elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping),
        {},
    )
    system = system_class()
    system.append(rod)
    system.constrain(rod).using(lead, constrained_position_idx=(0,))
    # Its drag on a segment at speed 1 across shall be 1: see the factor in its slender-body theory.
    length, radius = float(np.sum(rod.rest_lengths)), float(rod.radius[0])
    viscosity = math.log(length / radius) / (4.0 * math.pi)
    system.add_forcing_to(rod).using(elastica.SlenderBodyTheory, dynamic_viscosity=viscosity)
    system.dampen(rod).using(
        elastica.AnalyticalLinearDamper,
        translational_damping_constant=0.0,
        rotational_damping_constant=ROTATIONAL_DAMPING,
        time_step=interval,
    )
    system.finalize()
    return system


def _lead_class(elastica: Any) -> Any:
    """Return PyElastica's kind of condition for a node that is led; its class, as PyElastica makes the object."""

    class Lead(elastica.ConstraintBase):  # type: ignore[misc]
        position = np.zeros(3)
        velocity = np.zeros(3)

        def constrain_values(self, system: Any, time: float) -> None:
            system.position_collection[:, 0] = Lead.position

        def constrain_rates(self, system: Any, time: float) -> None:
            system.velocity_collection[:, 0] = Lead.velocity

    return Lead
