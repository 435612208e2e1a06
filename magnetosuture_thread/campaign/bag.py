"""The bag of a run: what nodes and rig would have published, with the ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from magnetosuture_thread import interface
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.campaign.loop import Measurement, Vector
from magnetosuture_thread.coils.bridge import BridgeOutput
from magnetosuture_thread.messages.packing import (
    Outputs,
    camera_outputs,
    estimate_outputs,
    ground_truth_outputs,
    packed_currents,
    packed_filter_state,
    packed_twist,
    pose_outputs,
    prediction_outputs,
    thread_outputs,
)
from magnetosuture_thread.messages.scene import packed_scene
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.rig.rig import RigFrame
from magnetosuture_thread.setups import Setup
from magnetosuture_thread.thread_model.session import PredictionResult

OF_CAMERA = (interface.COMPRESSED_IMAGE, interface.CAMERA_INFO)
GROUND_TRUTH = (interface.GROUND_TRUTH_NEEDLE, interface.GROUND_TRUTH_THREAD, interface.GROUND_TRUTH_PULL)
OF_TRACKER = (interface.NEEDLE_POSE, interface.THREAD_OBSERVATION, interface.MEASURED_THREAD)
OF_MODEL = (interface.PREDICTED_THREAD, interface.ESTIMATED_THREAD, interface.MARGINS)
OF_BRIDGE = (interface.NEEDLE_COMMAND, interface.CURRENTS, interface.FILTER_STATE)


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
        for channel in (interface.SCENE, *frames, *GROUND_TRUTH, *OF_TRACKER, *OF_MODEL, *OF_BRIDGE):
            self._bag.add_topic(channel.recorded, channel.type_name)
        begin = _nanoseconds(start)
        self._bag.write(interface.SCENE.recorded, begin, packed_scene(begin, setup.scene))
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
        stamp, rig = _nanoseconds(now), self._rig
        if frame.image is not None:
            jpeg, size = encode_jpeg(frame.image, rig.jpeg_quality), (rig.camera_width, rig.camera_height)
            self._write(stamp, camera_outputs(stamp, jpeg, size, self._view, rig.camera_distance))
        self._write(stamp, ground_truth_outputs(stamp, frame))

    def on_measurement(self, now: float, measured: Measurement, result: PredictionResult, commanded: Vector) -> None:
        """Write what was measured, predicted and estimated in a frame, and the command that came of it."""
        time, stamp, observation = _nanoseconds(now), result.stamp, measured.observation
        self._write(time, pose_outputs(stamp, measured.tail, measured.heading, measured.covariance))
        if observation is not None:
            self._write(time, thread_outputs(stamp, observation, observation.from_tail))
        self._write(time, prediction_outputs(result, self._material))
        self._write(time, estimate_outputs(result))
        self._bag.write(interface.NEEDLE_COMMAND.recorded, time, packed_twist(time, commanded))
        self._command = time

    def on_bridge(self, now: float, output: BridgeOutput) -> None:
        """Write currents and what became of the command, from the first command on."""
        time = _nanoseconds(now)
        if not (output.publish and self._command):
            return
        self._bag.write(interface.CURRENTS.recorded, time, packed_currents(time, self._command, output))
        self._bag.write(interface.FILTER_STATE.recorded, time, packed_filter_state(self._command, output))

    def _write(self, time: int, outputs: Outputs) -> None:
        for channel, data in outputs:
            self._bag.write(channel.recorded, time, data)


def _nanoseconds(time: float) -> int:
    return round(1e9 * time)
