"""The thread estimated: the predictor's program, corrected by what the camera measures."""

from __future__ import annotations

from magnetosuture_thread.estimator.disturbance import Disturbance
from magnetosuture_thread.estimator.estimator import EstimatorOptions, ThreadEstimate, ThreadEstimator
from magnetosuture_thread.estimator.session import EstimatorSession

__all__ = ["Disturbance", "EstimatorOptions", "EstimatorSession", "ThreadEstimate", "ThreadEstimator"]
