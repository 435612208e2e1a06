"""The job `magnetosuture record`: a bag of simulated camera frames from a reference trajectory."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.types import typestore
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError, ConfigurationError
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import points_at
from magnetosuture_thread.interface import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    DISH_FRAME,
    NEEDLE_COMMAND,
    TRUE_NEEDLE,
    TRUE_THREAD,
)
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.model.thread import Attachment
from magnetosuture_thread.rig.camera.dish_camera import DishCamera, encode_jpeg
from magnetosuture_thread.rig.camera.scene import Scene
from magnetosuture_thread.setups import Setup
from magnetosuture_thread.study.reference import ReferenceTrajectory

SIZE = (640, 480)
DISH_SHARE = 0.9115  # of the image's height
CAMERA_HEIGHT = 0.3  # m above the dish, for the intrinsics in camera_info
TRUTH_POINTS = 51
EPOCH = 1.0  # s; the bag's time at the trajectory's time 0, as time 0 means "not set" in ROS


def record(
    reference: ReferenceTrajectory,
    setup: Setup,
    output: Path,
    *,
    start: float = 0.0,
    duration: float | None = None,
    rate: float = 30.0,
    quality: int = 85,
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> int:
    """Render a trajectory and write it as a bag; return the number of frames.

    The bag holds JPEG frames and camera_info, the needle velocity command that the trajectory amounts
    to, and the truth on topics of its own. All of it is simulated, and the bag's notes say so.

    Args:
        reference: needle poses and thread.
        setup: dish, needle and thread as the camera sees them.
        output: the bag's folder, made here.
        start: time in the trajectory to begin at [s].
        duration: [s]; to the trajectory's end if None.
        rate: frames a second.
        quality: of the JPEG frames, 1 to 100.
        seed: of dust and noise.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the output exists or cannot be written, or the trajectory has no such time.
        ConfigurationError: the set-up is for another thread or another obstacle than the trajectory's.
    """
    first, last = float(reference.times[0]), float(reference.times[-1])
    end = last if duration is None else start + duration
    if not (first <= start < end <= last + 1e-9):
        raise BagError(reference.name, f"has the times {first:g} to {last:g} s; asked for {start:g} to {end:g} s")
    frames = round((end - start) * rate)
    if frames < 1:
        raise BagError(reference.name, f"{end - start:g} s at {rate:g} frames a second hold no frame")
    _check_setup(reference, setup)
    view = DishView((322.0, 238.0), setup.vision.dish_diameter / (DISH_SHARE * SIZE[1]))
    scene = Scene(
        dish_diameter=setup.vision.dish_diameter,
        needle_length=setup.vision.needle_length,
        needle_width=setup.vision.needle_width,
        thread_diameter=setup.model.thread().diameter,
        obstacles=reference.discs,
    )
    camera = DishCamera(scene, view, SIZE, seed)
    notes = {
        "setup": setup.name,
        "simulated": f"camera frames and needle motion, rendered from the reference trajectory {reference.name}",
    }
    with whole_folder(output) as folder, BagWriter(folder, notes, name=output.name) as bag:
        topics = _Topics(bag)
        for index in range(frames):
            time = start + index / rate
            before, after = max(first, time - 0.5 / rate), min(last, time + 0.5 / rate)
            velocity = (reference.at(after)[0] - reference.at(before)[0]) / (after - before)
            tail, heading, thread = reference.at(time)
            topics.write(time, camera, tail, heading, thread, velocity, quality)
            progress((index + 1) / frames)
    return frames


def _check_setup(reference: ReferenceTrajectory, setup: Setup) -> None:
    """Refuse a set-up that says another thread, attachment or obstacle than the trajectory has."""
    metadata = reference.metadata
    attachment = {"pinned": Attachment.PINNED, "clamped": Attachment.GLUED}.get(str(metadata.get("boundary")))
    length = metadata.get("material", {}).get("L_m")
    for name, given, expected in (
        ("length", setup.model.length, length),
        ("attachment", setup.model.attachment, attachment.value if attachment else None),
        ("disc_obstacles", setup.model.obstacles(), reference.discs),
    ):
        if expected is not None and not _same(given, expected):
            raise ConfigurationError(
                f"thread_model.{name}", given, f"{expected}, as in {reference.name}", str(setup.path)
            )


def _same(given: object, expected: object) -> bool:
    """Return whether two settings are the same; lengths that differ by less than a nanometre are."""
    if isinstance(given, str) or isinstance(expected, str):
        return given == expected
    if isinstance(given, tuple) and not all(isinstance(obstacle, Disc) for obstacle in given):
        return False  # no trajectory has polygons, and the simulated camera does not draw them
    return _numbers(given).shape == _numbers(expected).shape and np.allclose(
        _numbers(given), _numbers(expected), rtol=0.0, atol=1e-9
    )


def _numbers(value: Any) -> NDArray[np.float64]:
    if isinstance(value, tuple):
        return np.array([(*disc.centre, disc.radius) for disc in value], dtype=np.float64)
    return np.asarray(value, dtype=np.float64)


class _Topics:
    """Writes one frame's messages."""

    def __init__(self, bag: BagWriter) -> None:
        self._bag = bag
        self._types = typestore().types
        for channel in (COMPRESSED_IMAGE, CAMERA_INFO, NEEDLE_COMMAND, TRUE_NEEDLE, TRUE_THREAD):
            bag.add_topic(channel.recorded, channel.type_name)

    def write(
        self, time: float, camera: DishCamera, tail: Any, heading: float, thread: Any, velocity: Any, quality: int
    ) -> None:
        nanoseconds = round((time + EPOCH) * 1e9)
        header = self._header(nanoseconds, DISH_FRAME)
        optical = self._header(nanoseconds, "camera")
        data = encode_jpeg(camera.render(tail, heading, thread), quality)
        write = self._bag.write_message
        image = self._make(
            "sensor_msgs/msg/CompressedImage", header=optical, format="bgr8; jpeg compressed bgr8", data=data
        )
        write(COMPRESSED_IMAGE.recorded, nanoseconds, image)
        write(CAMERA_INFO.recorded, nanoseconds, self._camera_info(optical, camera))
        write(NEEDLE_COMMAND.recorded, nanoseconds, self._twist(header, velocity))
        write(TRUE_NEEDLE.recorded, nanoseconds, self._pose(header, tail, heading))
        at = np.linspace(0.0, np.linalg.norm(np.diff(thread, axis=0), axis=1).sum(), TRUTH_POINTS)
        poses = [self._pose(header, point, 0.0) for point in points_at(thread, at)]
        write(TRUE_THREAD.recorded, nanoseconds, self._make("nav_msgs/msg/Path", header=header, poses=poses))

    def _make(self, type_name: str, **fields: Any) -> Any:
        return self._types[type_name](**fields)

    def _header(self, nanoseconds: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _pose(self, header: Any, point: Any, angle: float) -> Any:
        position = self._make("geometry_msgs/msg/Point", x=float(point[0]), y=float(point[1]), z=0.0)
        turned = self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=np.sin(0.5 * angle), w=np.cos(0.5 * angle))
        pose = self._make("geometry_msgs/msg/Pose", position=position, orientation=turned)
        return self._make("geometry_msgs/msg/PoseStamped", header=header, pose=pose)

    def _twist(self, header: Any, velocity: Any) -> Any:
        linear = self._make("geometry_msgs/msg/Vector3", x=float(velocity[0]), y=float(velocity[1]), z=0.0)
        none = self._make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self._make("geometry_msgs/msg/Twist", linear=linear, angular=none)
        return self._make("geometry_msgs/msg/TwistStamped", header=header, twist=twist)

    def _camera_info(self, header: Any, camera: DishCamera) -> Any:
        matrix = camera.view.intrinsics(CAMERA_HEIGHT)
        whole = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            height=camera.size[1],
            width=camera.size[0],
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack([matrix, np.zeros(3)]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=whole,
        )
