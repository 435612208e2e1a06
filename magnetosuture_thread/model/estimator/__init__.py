"""The thread estimated: the predictor's program, corrected by what the camera measures."""

from __future__ import annotations

from magnetosuture_thread.model.estimator.disturbance import Disturbance
from magnetosuture_thread.model.estimator.estimate import ThreadEstimate
from magnetosuture_thread.model.estimator.estimator import ThreadEstimator
from magnetosuture_thread.model.estimator.options import EstimatorOptions
from magnetosuture_thread.model.estimator.session import EstimatorSession
from magnetosuture_thread.model.estimator.slow_parameters import SlowParameter

__all__ = ["Disturbance", "EstimatorOptions", "EstimatorSession", "SlowParameter", "ThreadEstimate", "ThreadEstimator"]
