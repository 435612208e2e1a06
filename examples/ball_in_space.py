"""A thread in three dimensions that sinks in air onto a ball."""

import numpy as np

from magnetosuture_thread import Attachment, Disc, Medium, NeedlePose, Thread, ThreadPredictor, Workspace

ball = Disc((0.0, 0.0, -0.02), 0.01)  # [m]
thread = Thread(
    material="cord",
    length=0.03,
    segments=30,
    diameter=5e-4,
    bending_stiffness=1e-10,
    medium=Medium.air(mass_per_length=2e-4, gravity=(0.0, 0.0, -9.81), drag=2e-3),
    attachment=Attachment.PINNED,
)
predictor = ThreadPredictor(thread, Workspace([ball], reach=0.01, dimension=3), max_step=2e-3)
east, tail = np.array([1.0, 0.0, 0.0]), np.array([0.015, 0.0, 0.0])
predictor.start(NeedlePose(0.0, tail, east))
for step in range(1, 151):
    prediction = predictor.step(NeedlePose(step / 100.0, tail, east))

print(f"{len(prediction.margins.in_contact)} nodes lie on the ball")
print(f"least clearance: {1e6 * prediction.margins['obstacle'].minimum:.4f} µm")
print(f"lowest node: {1e3 * prediction.positions[:, 2].min():.2f} mm")
