"""Model: predicts the thread behind the needle."""

from magnetosuture_thread.geometry.obstacles import Disc, Mesh, Polygon, Workspace
from magnetosuture_thread.model.formulations import make_formulation
from magnetosuture_thread.model.prediction import NeedlePose, Prediction
from magnetosuture_thread.model.predictor import ThreadPredictor
from magnetosuture_thread.model.solvers import make_solver
from magnetosuture_thread.model.thread import MATERIALS, Attachment, Material, Medium, Thread

__all__ = [
    "MATERIALS",
    "Attachment",
    "Disc",
    "Material",
    "Medium",
    "Mesh",
    "NeedlePose",
    "Polygon",
    "Prediction",
    "Thread",
    "ThreadPredictor",
    "Workspace",
    "make_formulation",
    "make_solver",
]
