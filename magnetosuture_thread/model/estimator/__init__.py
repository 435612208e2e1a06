"""The thread estimated: the predictor's program, corrected by what the camera measures."""

from __future__ import annotations

from magnetosuture_thread.model.estimator.disturbance import Disturbance
from magnetosuture_thread.model.estimator.estimate import ThreadEstimate
from magnetosuture_thread.model.estimator.estimator import EstimatorOptions, ThreadEstimator
from magnetosuture_thread.model.estimator.session import EstimatorSession
from magnetosuture_thread.model.estimator.stiffness import SlowParameter

__all__ = ["Disturbance", "EstimatorOptions", "EstimatorSession", "SlowParameter", "ThreadEstimate", "ThreadEstimator"]
