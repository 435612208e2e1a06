"""MuJoCo: a chain of capsules with ball joints, its first end tied to a mocap body that is the lead.

MuJoCo knows no thread without inertia. The bodies get a mass that makes their inertial time 8 ms, far above
the true microseconds, and the drag of its viscous medium. Its springs and drag are explicit: with a lighter
or thinner body, or fewer sub-steps, the chain explodes, as its twist is then too quick. An implicit drag
(`implicitfast`) allows 2 ms and takes ten times as long.
"""

from __future__ import annotations

import importlib
import math

import numpy as np
from numpy.typing import NDArray

from benchmarks.baselines.simulators import Scaled, check
from benchmarks.solver.cases import Case
from magnetosuture_thread.geometry.polyline import Points

SUBSTEPS = 8
INERTIAL_TIME = 8e-3  # s
THICKNESS = 0.3  # D; of the boxes that its drag and inertia see


class MujocoChain:
    """A chain of n bodies.

    Args:
        case: the motion.
        substeps: of each pose sample.
    """

    name = "mujoco"
    physics = "isotropic drag, masses of 8 ms inertial time, joints that also resist twist"

    def __init__(self, case: Case, substeps: int = SUBSTEPS) -> None:
        check(case)
        self._mujoco = importlib.import_module("mujoco")
        self._scaled, self._substeps = Scaled(case.thread), substeps
        start = case.start / self._scaled.unit
        self._model = self._mujoco.MjModel.from_xml_string(_chain(self._scaled, start, case.interval / substeps))
        self._data = self._mujoco.MjData(self._model)
        self._mujoco.mj_forward(self._model, self._data)
        self._lead = start[0].copy()

    def advance(self, tail: NDArray[np.float64]) -> Points:
        """Move the lead; see `Simulator`."""
        target = tail / self._scaled.unit
        for i in range(1, self._substeps + 1):
            self._data.mocap_pos[0] = self._lead + (target - self._lead) * (i / self._substeps)
            self._mujoco.mj_step(self._model, self._data)
        self._lead = target
        return np.vstack([self._data.xpos[2:], self._data.site_xpos[:1]]) * self._scaled.unit


def _chain(scaled: Scaled, start: Points, interval: float) -> str:
    """Return MuJoCo's description of the straight chain, in D and s."""
    along = start[1] - start[0]
    # A body's frame has its x along the thread: the turn from x to there, about their common normal.
    half = np.array([1.0 + along[0], 0.0, -along[2], along[1]])
    half /= np.linalg.norm(half)
    mass, small = INERTIAL_TIME, THICKNESS
    inertia = mass / 12.0 * np.array([2.0 * small**2, 1.0 + small**2, 1.0 + small**2])
    # Force on a box: 3 pi viscosity times its mean side times its speed; it shall be 1 at 1.
    viscosity = 1.0 / (3.0 * math.pi * (1.0 + 2.0 * small) / 3.0)
    body = (
        f'<inertial pos="0.5 0 0" mass="{mass:.9g}" diaginertia="{_text(inertia)}"/>'
        f'<geom type="capsule" fromto="0 0 0 1 0 0" size="{small / 2:.9g}"/>'
    )
    joint = f'<joint type="ball" stiffness="{scaled.joint:.9g}" armature="{1e-2 * mass:.9g}"/>'
    links = (scaled.segments - 1) * f'<body pos="1 0 0">{joint}{body}'
    return f"""<mujoco>
      <option timestep="{interval:.9g}" viscosity="{viscosity:.9g}" integrator="Euler" solver="PGS">
        <flag gravity="disable" contact="disable"/>
      </option>
      <size memory="64M"/>
      <worldbody>
        <body name="lead" mocap="true" pos="{_text(start[0])}"/>
        <body name="first" pos="{_text(start[0])}" quat="{_text(half)}">
          <freejoint/>{body}{links}<site pos="1 0 0"/>{"</body>" * scaled.segments}
      </worldbody>
      <equality>
        <connect body1="lead" body2="first" anchor="0 0 0" solref="{2.0 * interval:.9g} 1"/>
      </equality>
    </mujoco>"""


def _text(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.12g}" for value in values)
