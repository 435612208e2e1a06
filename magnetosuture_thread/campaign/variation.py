"""What differs between the runs of a campaign, and what the model is not told of."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.setups import Setup

START_OFFSET, START_TURN = 1e-3, 0.15  # m and rad
CURVATURE = 0.3  # share of the thread's start curvature
VISCOSITY, STIFFNESS, COILS = 0.3, 0.5, 0.05  # shares
MAX_FRICTION = 0.3
LOST_FRAMES = 0.05  # share
MAX_DRAWS = 100


@dataclass(frozen=True, eq=False)
class Variation:
    """The truth of one run.

    Attributes:
        seed: that it is drawn by.
        setup: with the rig's settings as they are in truth; those of the nodes are as before.
        coil_gains: by which each coil is stronger than the bridge believes, shape (m,).
        losses: share of the frames that get lost.
    """

    seed: int
    setup: Setup
    coil_gains: NDArray[np.float64]
    losses: float = LOST_FRAMES


def vary(setup: Setup, seed: int) -> Variation:
    """Return the truth of the run with a seed.

    Uniformly drawn: the start within 1 mm and 0.15 rad, the thread's start curvature by 30 %, the viscosity by 30 % (of
    needle and thread alike), the bending stiffness by 50 %, each coil by 5 %, the thread's friction from 0 to 0.3. A
    start in the wall or a shape is drawn anew.

    Raises:
        ConfigurationError: no start is free, of needle and thread.
    """
    random = np.random.default_rng([seed, 0])
    rig, scene = setup.rig, setup.scene

    def factor(share: float) -> float:
        return float(1.0 + share * random.uniform(-1.0, 1.0))

    liquid = factor(VISCOSITY)
    changed = replace(
        rig,
        seed=seed,
        viscosity=rig.viscosity * liquid,
        thread_drag_across=rig.thread_drag_across * liquid,
        thread_drag_along=rig.thread_drag_along * liquid,
        thread_bending_stiffness=rig.thread_bending_stiffness * factor(STIFFNESS),
        thread_friction=float(random.uniform(0.0, MAX_FRICTION)),
    )
    gains = 1.0 + COILS * random.uniform(-1.0, 1.0, len(rig.coil_angles))
    x, y, heading = rig.needle_start
    for _ in range(MAX_DRAWS):
        dx, dy = START_OFFSET * random.uniform(-1.0, 1.0, 2)
        start = (
            x + float(dx),
            y + float(dy),
            math.remainder(heading + START_TURN * random.uniform(-1.0, 1.0), math.tau),
        )
        curvature = rig.thread_start_curvature * factor(CURVATURE)
        drawn = replace(changed, needle_start=start, thread_start_curvature=curvature)
        try:
            drawn.check_scene(scene)
        except ConfigurationError:
            continue
        return Variation(seed, replace(setup, rig=drawn).with_scene(scene), gains)
    expected = "a start with room around it"
    try:
        rig.check_scene(scene)
    except ConfigurationError as error:  # what is in the way, with the start as it is
        expected += f": {error.expectation}"
    raise ConfigurationError("rig_simulator.needle_start", list(rig.needle_start), expected)
