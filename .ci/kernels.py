"""Compiles the kernels of rig, thread model and estimator, which each process of the tests would compile by itself."""

from __future__ import annotations

from magnetosuture_thread.model.estimator import EstimatorOptions, ThreadEstimator
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.setups import read_setup

SETUP = "petri_35mm_polyamide_post"

if __name__ == "__main__":
    setup = read_setup(SETUP)
    Rig(setup.rig, setup.scene).warm_up()
    ThreadEstimator(setup.model.predictor(setup.scene), EstimatorOptions()).warm_up()
