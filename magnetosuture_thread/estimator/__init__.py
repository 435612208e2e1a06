"""The thread estimated: the predictor's program, corrected by what the camera measures."""

from __future__ import annotations

from magnetosuture_thread.estimator.disturbance import Disturbance
from magnetosuture_thread.estimator.estimator import EstimatorOptions, EstimatorSession, ThreadEstimate, ThreadEstimator

__all__ = ["Disturbance", "EstimatorOptions", "EstimatorSession", "ThreadEstimate", "ThreadEstimator"]
