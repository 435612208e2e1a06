"""The same step by two solvers: the structured one and OSQP."""

import numpy as np

from magnetosuture_thread import Disc, NeedlePose, Scene, ThreadPredictor

SOLVERS = ["banded", "osqp"]

scene = Scene.create(dish_diameter=0.05, shapes={"post": Disc((-0.006, 0.003), 0.002)})
threads = {}
for solver in SOLVERS:
    predictor = ThreadPredictor.create("silk_6_0", length=0.019, segments=25, scene=scene, solver=solver)
    predictor.start(NeedlePose(0.0, np.zeros(2), np.array([1.0, 0.0])))
    for step in range(1, 61):
        tail = 1e-4 * step * np.array([0.5, 1.0])
        prediction = predictor.step(NeedlePose(step / 30.0, tail, np.array([1.0, 0.0])))
    threads[solver] = prediction.positions
    print(f"{prediction.solver}: {prediction.status}, residual {prediction.residual:.1e}")

for solver, thread in threads.items():
    print(f"{solver} and banded differ by {1e9 * np.abs(thread - threads['banded']).max():.2f} nm")
