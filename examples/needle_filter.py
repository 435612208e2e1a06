"""The safety filter: a needle is commanded into a post, and kept out of the lower part of the dish as well."""

import numpy as np

from magnetosuture_thread import Barrier, Disc, Gradient, NeedleSafetyFilter, Scene

PERIOD = 0.05  # s


class UpperHalf(Barrier):
    """h_i = y_i + 2 mm for every point of the needle [m]."""

    name = "upper_half"

    def value(self, positions):
        return positions[:, 1] + 0.002

    def gradient(self, positions):
        return Gradient(np.arange(len(positions))[:, None], np.tile([[[0.0, 1.0]]], (len(positions), 1, 1)))


scene = Scene.create(dish_diameter=0.035, shapes={"post": Disc((0.0, -0.0005), 0.002)})
needle = NeedleSafetyFilter(scene, barriers=[UpperHalf()], needle_length=0.0025)
tail, heading, command = np.array([-0.008, 0.0]), np.array([1.0, 0.0]), np.array([0.004, -0.0005])
active, clearance = set(), np.inf
for _ in range(120):
    result = needle.filter(command, tail, heading)
    along, across = needle.kinematics.body_velocity(heading, result.filtered)
    tail, heading = needle.kinematics.moved(tail, heading, along, across, PERIOD)
    active.update(result.active)
    clearance = min(clearance, needle.clearance(tail, heading))

print(f"active were {', '.join(sorted(active))}; in the end: {result.reason or 'moving'}")
print(f"least clearance of its axis: {1e3 * clearance:.3f} mm of {1e3 * needle.keep_out:.1f}")
