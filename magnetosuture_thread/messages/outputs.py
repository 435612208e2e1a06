"""What rig, tracker and model publish of a frame: by nodes, and into bags that are written without a graph."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    ESTIMATED_THREAD,
    GROUND_TRUTH_NEEDLE,
    GROUND_TRUTH_PULL,
    GROUND_TRUTH_THREAD,
    MARGINS,
    MEASURED_THREAD,
    NEEDLE_POSE,
    PREDICTED_THREAD,
    THREAD_OBSERVATION,
    Channel,
)
from magnetosuture_thread.messages.cdr import Stamp
from magnetosuture_thread.messages.packing import (
    packed_camera_info,
    packed_compressed_image,
    packed_estimate,
    packed_margins,
    packed_observation,
    packed_path,
    packed_pose,
    packed_pose_stamped,
    packed_prediction,
    packed_wrench,
)
from magnetosuture_thread.thread_model.session import PredictionResult
from magnetosuture_thread.thread_observation import ThreadObservation

if TYPE_CHECKING:
    from magnetosuture_thread.rig.rig import RigFrame

Outputs = Iterator[tuple[Channel, bytes]]


def camera_outputs(
    stamp: Stamp, jpeg: NDArray[np.uint8], size: tuple[int, int], view: DishView, height: float
) -> Outputs:
    """Give a frame and the intrinsics of a camera at a height above the dish [m]; size is width and height."""
    yield COMPRESSED_IMAGE, packed_compressed_image(stamp, jpeg)
    yield CAMERA_INFO, packed_camera_info(stamp, size, view, height)


def ground_truth_outputs(stamp: Stamp, frame: RigFrame) -> Outputs:
    """Give where needle and thread of a simulation are, and how the thread pulls."""
    yield GROUND_TRUTH_NEEDLE, packed_pose_stamped(stamp, frame.tail, frame.heading)
    yield GROUND_TRUTH_THREAD, packed_path(stamp, frame.thread)
    yield GROUND_TRUTH_PULL, packed_wrench(stamp, frame.pull, frame.moment)


def thread_outputs(stamp: Stamp, observation: ThreadObservation, centreline: Points | None) -> Outputs:
    """Give what a frame shows of the thread; the centreline from the tail on has the shape (m, 2) [m]."""
    yield THREAD_OBSERVATION, packed_observation(stamp, observation)
    if centreline is not None and len(centreline):
        yield MEASURED_THREAD, packed_path(stamp, centreline)


def pose_outputs(
    stamp: Stamp, tail: NDArray[np.float64], heading: NDArray[np.float64], covariance: NDArray[np.float64]
) -> Outputs:
    """Give the needle's pose; see `packed_pose`."""
    yield NEEDLE_POSE, packed_pose(stamp, tail, heading, covariance)


def prediction_outputs(result: PredictionResult, material: str, step_time: float = 0.0) -> Outputs:
    """Give the prediction of a pose, if there is one, with the time that it took [s]."""
    if result.prediction is not None:
        yield PREDICTED_THREAD, packed_prediction(result.stamp, result.prediction, material, step_time=step_time)


def estimate_outputs(result: PredictionResult) -> Outputs:
    """Give the estimate of a pose, if there is one, and the margins or why there are none."""
    if result.estimate is not None:
        yield ESTIMATED_THREAD, packed_estimate(result.stamp, result.estimate)
    if result.estimate is not None or not result.late:
        yield (
            MARGINS,
            packed_margins(
                result.stamp,
                result.margins,
                "" if result.margins else result.reason,
                result.scene_version,
                of_estimate=result.estimate is not None,
            ),
        )
