"""What the estimator learns on line agrees with what a calibration fits to the same run."""

from __future__ import annotations

from magnetosuture_thread.calibration.recorded_run import read_run
from magnetosuture_thread.calibration.search import calibrate
from magnetosuture_thread.estimator import EstimatorOptions, EstimatorSession, ThreadEstimator
from magnetosuture_thread.estimator.session import observation_of
from magnetosuture_thread.thread.prediction import NeedlePose
from test.calibration.runs import LENGTH, SETTINGS, noisy, rig_run, stiff

TRUE, NOISE = 1.3e-9, 2e-5  # m^4/s, m


def test_calibration_and_estimator_agree_on_the_same_run() -> None:
    told, frames = stiff(5.0 * TRUE), list(noisy(rig_run(TRUE), NOISE))
    fit, _ = calibrate([read_run("run", frames, SETTINGS)], told, ["elastic_modulus"])
    options = EstimatorOptions(slow_parameters=("stiffness_over_drag",))
    session = EstimatorSession(ThreadEstimator(told.predictor(None), options))
    for frame in frames:
        stamp = frame.stamp * 1e-9
        session.on_observation(stamp, observation_of(frame.measured, LENGTH, NOISE))
        result = session.on_pose(NeedlePose(stamp, frame.tail, frame.heading))
    assert result.estimate is not None
    (batch,), (online,) = fit.estimates, result.estimate.slow_parameters
    assert online.low <= batch.value <= online.high
    assert batch.low <= online.value <= batch.high
    assert online.low <= TRUE <= online.high
