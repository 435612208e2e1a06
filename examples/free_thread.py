"""A needle drives a quarter of a circle in an open dish; the thread follows it."""

import numpy as np

from magnetosuture_thread import NeedlePose, Scene, ThreadPredictor

RADIUS, SPEED, RATE = 0.008, 0.005, 30.0  # m, m/s, Hz

predictor = ThreadPredictor.create("polyamide_7_0", length=0.012, segments=25, scene=Scene.create(dish_diameter=0.026))
predictor.start(NeedlePose(0.0, np.array([0.0, -RADIUS]), np.array([1.0, 0.0])))  # straight behind the needle
angle, step = 0.0, 0
while angle < 0.5 * np.pi:
    step += 1
    angle = SPEED / RADIUS * step / RATE
    heading = np.array([np.cos(angle), np.sin(angle)])
    prediction = predictor.step(NeedlePose(step / RATE, RADIUS * np.array([heading[1], -heading[0]]), heading))

print(f"after {step / RATE:.2f} s the loose end is at {1e3 * prediction.positions[-1].round(5)} mm")
print(f"maximum strain of a segment: {np.abs(prediction.strain).max():.1e}")
print(f"nearest node to the wall: {1e3 * prediction.margins['wall'].minimum:.2f} mm")
