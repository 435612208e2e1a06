"""Three barriers that the package does not bring, in one prediction."""

import numpy as np
from barriers.curvature_bound import CurvatureBound
from barriers.moving_disc import MovingDisc
from barriers.tip_keep_in import TipKeepIn

from magnetosuture_thread import NeedlePose, ThreadPredictor

RADIUS, SPEED, RATE = 0.004, 0.006, 60.0  # of the needle's circle [m], m/s, Hz


def pose(step: int) -> NeedlePose:
    """Return the needle on its circle."""
    angle = SPEED / RADIUS * step / RATE
    c, s = np.cos(angle), np.sin(angle)
    return NeedlePose(step / RATE, RADIUS * np.array([s, 1.0 - c]), np.array([c, s]))


barriers = [TipKeepIn(), CurvatureBound(), MovingDisc()]
predictor = ThreadPredictor.create("polyamide_7_0", length=0.019, segments=25, barriers=barriers)
predictor.start(pose(0))
least = dict.fromkeys([barrier.name for barrier in barriers], np.inf)
for step in range(1, 151):
    prediction = predictor.step(pose(step))
    assert prediction.converged
    least = {name: min(value, prediction.margins[name].minimum_clearance) for name, value in least.items()}

for name, clearance in least.items():
    print(f"{name}: at least {1e6 * clearance:.3f} µm")
