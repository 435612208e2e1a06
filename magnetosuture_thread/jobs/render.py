"""The job `magnetosuture record`: a bag of simulated camera frames, or of poses, from a reference trajectory."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.bags.message_types import MESSAGES
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError, ConfigurationError
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.geometry.polyline import Points, points_at
from magnetosuture_thread.interface import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    GROUND_TRUTH_NEEDLE,
    GROUND_TRUTH_THREAD,
    MEASURED_THREAD,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    SCENE,
    Channel,
)
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.model.thread import Attachment
from magnetosuture_thread.rig.camera.dish_camera import DishCamera, encode_jpeg
from magnetosuture_thread.rig.camera.scene import CameraScene as CameraScene
from magnetosuture_thread.setups import Setup

SIZE = (640, 480)
DISH_SHARE = 0.9115  # of the image's height
CAMERA_HEIGHT = 0.3  # m above the dish, for the intrinsics in camera_info
GROUND_TRUTH_POINTS = 51
MEASURED_POINTS = 64
EPOCH = 1.0  # s; the bag's time at the trajectory's time 0, as time 0 means "not set" in ROS


def render_bag(
    reference: ReferenceTrajectory,
    setup: Setup,
    output: Path,
    *,
    start: float = 0.0,
    duration: float | None = None,
    rate: float = 30.0,
    quality: int = 85,
    seed: int = 0,
    poses: bool = False,
    noise: float = 0.0,
    progress: Callable[[float], None] = lambda share: None,
) -> int:
    """Write a trajectory as a bag; return the number of frames, or of poses.

    The bag begins with the scene. It holds JPEG frames and camera_info, or in their place needle poses and seen
    threads; besides, the needle velocity command that the trajectory amounts to, and the truth on topics of its own.
    All of it is simulated, and the bag's notes say so.

    Args:
        reference: needle poses and thread.
        setup: dish, needle and thread as the camera sees them.
        output: the bag's folder, made here.
        start: time in the trajectory to begin at [s].
        duration: [s]; to the trajectory's end if None.
        rate: frames, or poses, a second.
        quality: of the JPEG frames, 1 to 100.
        seed: of dust and noise.
        poses: whether poses and seen threads take the place of frames.
        noise: of these, standard deviation of tail and seen thread [m]; of the heading, the same over the needle's
            length.
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
    what = "needle poses and seen thread" if poses else "camera frames and needle motion, rendered"
    notes = {"setup": setup.name, "simulated": f"{what} from the reference trajectory {reference.name}"}
    with whole_folder(output) as folder, BagWriter(folder, notes, name=output.name) as bag:
        bag.add_topic(SCENE.recorded, SCENE.type_name)
        begin = round((start + EPOCH) * 1e9)
        bag.write_message(SCENE.recorded, begin, MESSAGES.scene_message(begin, setup.scene))
        topics = _PoseTopics(bag, setup, noise, seed) if poses else _FrameTopics(bag, setup, reference, quality, seed)
        for index in range(frames):
            time = start + index / rate
            before, after = max(first, time - 0.5 / rate), min(last, time + 0.5 / rate)
            velocity = (reference.at(after)[0] - reference.at(before)[0]) / (after - before)
            topics.write(round((time + EPOCH) * 1e9), *reference.at(time), velocity)
            progress((index + 1) / frames)
    return frames


def _check_setup(reference: ReferenceTrajectory, setup: Setup) -> None:
    """Refuse a set-up that says another thread, attachment or obstacle than the trajectory has."""
    metadata = reference.metadata
    attachment = {"pinned": Attachment.PINNED, "clamped": Attachment.CLAMPED}.get(str(metadata.get("boundary")))
    length = metadata.get("material", {}).get("L_m")
    for name, given, expected in (
        ("thread_model.thread_length", setup.model.thread_length, length),
        ("thread_model.attachment", setup.model.attachment, attachment.value if attachment else None),
        ("scene", setup.scene.obstacles, reference.discs),
    ):
        if expected is not None and not _same(given, expected):
            raise ConfigurationError(name, given, f"{expected}, as in {reference.name}", str(setup.path))


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


class _Topics(ABC):
    """Writes what every bag holds of one instant: the command and the truth.

    Args:
        bag: to write to.
        channels: besides those.
    """

    def __init__(self, bag: BagWriter, channels: Sequence[Channel]) -> None:
        self._bag = bag
        for channel in (*channels, NEEDLE_COMMAND, GROUND_TRUTH_NEEDLE, GROUND_TRUTH_THREAD):
            bag.add_topic(channel.recorded, channel.type_name)

    def write(self, stamp: int, tail: Points, heading: float, thread: Points, velocity: Points) -> None:
        """Write an instant."""
        self._write_seen(stamp, tail, heading, thread)
        self._put(NEEDLE_COMMAND, stamp, MESSAGES.twist_message(stamp, velocity))
        self._put(GROUND_TRUTH_NEEDLE, stamp, MESSAGES.placed(stamp, tail, heading))
        self._put(GROUND_TRUTH_THREAD, stamp, MESSAGES.path_message(stamp, _along(thread, GROUND_TRUTH_POINTS)))

    @abstractmethod
    def _write_seen(self, stamp: int, tail: Points, heading: float, thread: Points) -> None:
        """Write how the needle and the thread are seen."""

    def _put(self, channel: Channel, stamp: int, message: Any) -> None:
        self._bag.write_message(channel.recorded, stamp, message)


class _FrameTopics(_Topics):
    """Writes camera frames."""

    def __init__(self, bag: BagWriter, setup: Setup, reference: ReferenceTrajectory, quality: int, seed: int) -> None:
        super().__init__(bag, (COMPRESSED_IMAGE, CAMERA_INFO))
        view = DishView((322.0, 238.0), setup.scene.dish.diameter / (DISH_SHARE * SIZE[1]))
        scene = CameraScene(
            dish_diameter=setup.scene.dish.diameter,
            needle_length=setup.vision.needle_length,
            needle_width=setup.vision.needle_width,
            thread_diameter=setup.model.thread().diameter,
            obstacles=reference.discs,
        )
        self._camera = DishCamera(scene, view, SIZE, seed)
        self._quality = quality

    def _write_seen(self, stamp: int, tail: Points, heading: float, thread: Points) -> None:
        data = encode_jpeg(self._camera.render(tail, heading, thread), self._quality)
        self._put(COMPRESSED_IMAGE, stamp, MESSAGES.compressed_image(stamp, data))
        camera = self._camera
        information = MESSAGES.camera_info(stamp, camera.size, camera.view, CAMERA_HEIGHT)
        self._put(CAMERA_INFO, stamp, information)


class _PoseTopics(_Topics):
    """Writes what a tracker would say of the frames."""

    def __init__(self, bag: BagWriter, setup: Setup, noise: float, seed: int) -> None:
        super().__init__(bag, (NEEDLE_POSE, MEASURED_THREAD))
        self._noise = np.array([noise, noise, noise / setup.vision.needle_length])
        self._random = np.random.default_rng(seed)

    def _write_seen(self, stamp: int, tail: Points, heading: float, thread: Points) -> None:
        off = self._noise * self._random.standard_normal(3)
        angle = heading + off[2]
        pose = MESSAGES.pose_message(
            stamp, tail + off[:2], np.array([np.cos(angle), np.sin(angle)]), np.diag(self._noise**2)
        )
        self._put(NEEDLE_POSE, stamp, pose)
        seen = _along(thread, MEASURED_POINTS)
        seen[1:] += self._noise[:2] * self._random.standard_normal(seen[1:].shape)
        seen[0] = tail + off[:2]  # a seen thread begins at the seen tail
        self._put(MEASURED_THREAD, stamp, MESSAGES.path_message(stamp, seen))


def _along(thread: Points, count: int) -> Points:
    """Return equally spaced points of a thread."""
    return points_at(thread, np.linspace(0.0, np.linalg.norm(np.diff(thread, axis=0), axis=1).sum(), count))
