"""The bag of a run: what nodes and rig would have published, with the ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from magnetosuture_thread.bags.message_types import MESSAGES
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.campaign.loop import Measurement, Vector
from magnetosuture_thread.coils.bridge import BridgeOutput
from magnetosuture_thread.interface import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    CURRENTS,
    ESTIMATED_THREAD,
    FILTER_STATE,
    GROUND_TRUTH_NEEDLE,
    GROUND_TRUTH_PULL,
    GROUND_TRUTH_THREAD,
    MARGINS,
    MEASURED_THREAD,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    PREDICTED_THREAD,
    SCENE,
    THREAD_OBSERVATION,
)
from magnetosuture_thread.messages.cdr import time_of
from magnetosuture_thread.messages.packing import (
    packed_estimate,
    packed_margins,
    packed_observation,
    packed_path,
    packed_pose,
    packed_prediction,
)
from magnetosuture_thread.model.session import PredictionResult
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.rig.rig import RigFrame
from magnetosuture_thread.setups import Setup

OF_CAMERA = (COMPRESSED_IMAGE, CAMERA_INFO)
GROUND_TRUTH = (GROUND_TRUTH_NEEDLE, GROUND_TRUTH_THREAD, GROUND_TRUTH_PULL)
OF_TRACKER = (NEEDLE_POSE, THREAD_OBSERVATION, MEASURED_THREAD)
OF_MODEL = (PREDICTED_THREAD, ESTIMATED_THREAD, MARGINS)
OF_BRIDGE = (NEEDLE_COMMAND, CURRENTS, FILTER_STATE)


class RunBag:
    """Records a run, as a `LoopRecorder`. Every message is logged at the simulated time at which a node would get it.

    Args:
        folder: of the bag; made here.
        setup: what the nodes believe.
        notes: of the bag.
        start: time of its begin [s].
        camera: whether frames are rendered.

    Raises:
        BagError: the folder cannot be written.
    """

    def __init__(self, folder: Path, setup: Setup, notes: Mapping[str, str], start: float, *, camera: bool) -> None:
        self._bag, self._rig, self._material = BagWriter(folder, notes), setup.rig, setup.model.material
        frames = OF_CAMERA if camera else ()
        for channel in (SCENE, *frames, *GROUND_TRUTH, *OF_TRACKER, *OF_MODEL, *OF_BRIDGE):
            self._bag.add_topic(channel.recorded, channel.type_name)
        begin = _nanoseconds(start)
        self._bag.write_message(SCENE.recorded, begin, MESSAGES.scene_message(begin, setup.scene))
        self._view = setup.rig.view(setup.scene)
        self._command = 0  # stamp of the last [ns]

    def __enter__(self) -> RunBag:
        """Use the bag in a with statement, which closes it."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag, so that what was written can be read whatever happened."""
        self._bag.close()

    def on_frame(self, now: float, frame: RigFrame) -> None:
        """Write a frame, if it was rendered, and the ground truth."""
        stamp = _nanoseconds(now)
        if frame.image is not None:
            image = MESSAGES.compressed_image(stamp, encode_jpeg(frame.image, self._rig.jpeg_quality))
            self._bag.write_message(COMPRESSED_IMAGE.recorded, stamp, image)
            size = (self._rig.camera_width, self._rig.camera_height)
            information = MESSAGES.camera_info(stamp, size, self._view, self._rig.camera_distance)
            self._bag.write_message(CAMERA_INFO.recorded, stamp, information)
        placed = MESSAGES.placed(stamp, frame.tail, frame.heading)
        self._bag.write_message(GROUND_TRUTH_NEEDLE.recorded, stamp, placed)
        self._bag.write(GROUND_TRUTH_THREAD.recorded, stamp, packed_path(time_of(stamp), frame.thread))
        pull = MESSAGES.wrench_message(stamp, frame.pull, frame.moment)
        self._bag.write_message(GROUND_TRUTH_PULL.recorded, stamp, pull)

    def on_measurement(self, now: float, measured: Measurement, result: PredictionResult, commanded: Vector) -> None:
        """Write what was measured, predicted and estimated in a frame, and the command that came of it."""
        time, stamp = _nanoseconds(now), result.stamp
        when, observation = time_of(stamp), measured.observation
        self._bag.write(
            NEEDLE_POSE.recorded, time, packed_pose(when, measured.tail, measured.heading, measured.covariance)
        )
        if observation is not None:
            self._bag.write(THREAD_OBSERVATION.recorded, time, packed_observation(when, observation))
            if (centreline := observation.from_tail) is not None:
                self._bag.write(MEASURED_THREAD.recorded, time, packed_path(when, centreline))
        if result.prediction is not None:
            self._bag.write(PREDICTED_THREAD.recorded, time, packed_prediction(when, result.prediction, self._material))
        if result.estimate is not None:
            self._bag.write(ESTIMATED_THREAD.recorded, time, packed_estimate(when, result.estimate))
        margins, of_estimate = result.margins, result.estimate is not None
        reason = "" if margins is not None else result.reason
        packed = packed_margins(when, margins, reason, result.scene_version, of_estimate=of_estimate)
        self._bag.write(MARGINS.recorded, time, packed)
        self._bag.write_message(NEEDLE_COMMAND.recorded, time, MESSAGES.twist_message(time, commanded))
        self._command = time

    def on_bridge(self, now: float, output: BridgeOutput) -> None:
        """Write currents and what became of the command, from the first command on."""
        time = _nanoseconds(now)
        if not (output.publish and self._command):
            return
        self._bag.write_message(CURRENTS.recorded, time, MESSAGES.currents_message(time, self._command, output))
        self._bag.write_message(FILTER_STATE.recorded, time, MESSAGES.filter_message(self._command, output))


def _nanoseconds(time: float) -> int:
    return round(1e9 * time)
