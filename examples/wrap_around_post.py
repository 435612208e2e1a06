"""A needle pulls its thread around a post: the margins of the nodes that touch it."""

import numpy as np

from magnetosuture_thread import Disc, NeedlePose, Scene, ThreadPredictor

POST, RATE = Disc((0.0, 0.0), 0.0025), 30.0  # centre and radius [m], Hz

scene = Scene.create(dish_diameter=0.035, shapes={"post": POST})
predictor = ThreadPredictor.create("polyamide_7_0", length=0.019, segments=40, scene=scene)
tail = np.array([-0.001, 0.0034])
predictor.start(NeedlePose(0.0, tail, np.array([1.0, 0.0])))
for step in range(1, 150):
    angle = 0.5 * np.pi - 0.04 * step  # clockwise around the post, at 5 mm/s
    tail = 0.0036 * np.array([np.cos(angle), np.sin(angle)])
    prediction = predictor.step(NeedlePose(step / RATE, tail, np.array([np.sin(angle), -np.cos(angle)])))

obstacle = prediction.margins["obstacle"]
nearest = obstacle.closest
print(f"{len(prediction.margins.in_contact)} nodes touch {scene.names[obstacle.obstacle[nearest]]}")
print(f"least clearance: {1e9 * obstacle.minimum:.3f} nm at node {obstacle.node[nearest]}")
print(f"valid: {prediction.converged}, residual {prediction.residual:.1e}")
