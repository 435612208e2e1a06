"""The command `magnetosuture render`: a bag of simulated camera frames, or of poses, from a reference trajectory."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np

from magnetosuture_thread import Attachment, ConfigurationError, Disc
from magnetosuture_thread.bags import packing
from magnetosuture_thread.bags.packing import packed_scene
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.commands import command
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory, read_reference
from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.polyline import Points, arc_lengths, points_at
from magnetosuture_thread.rig.camera import CameraScene, DishCamera, encode_jpeg
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import whole_folder

SIZE = (640, 480)
EPOCH = 1.0  # s; the bag's time at the trajectory's time 0, as time 0 means "not set" in ROS


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    command.runs(parser, run_render)
    option = parser.add_argument
    option("reference", type=Path, metavar="REFERENCE", help="a reference trajectory (.npz)")
    option("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    option("--setup", required=True, metavar="NAME", help="a setup's name or YAML file")
    option(
        "--start", type=command.number_argument(0.0, 1e6), default=0.0, help="time in the trajectory to begin at [s]"
    )
    option("--duration", type=command.number_argument(1e-3, 1e6), help="[s] (default: to the trajectory's end)")
    option(
        "--rate",
        type=command.number_argument(1.0, 240.0),
        default=30.0,
        help="frames, or poses, a second (default: 30)",
    )
    quality = "of the JPEG frames (default: 85)"
    option("--quality", type=int, choices=range(1, 101), default=85, metavar="1..100", help=quality)
    option("--seed", type=command.whole_number, default=0, help="of dust and noise (default: 0)")
    option("--poses", action="store_true", help="write poses and measured threads instead of frames")
    noise = "of these, standard deviation; of the heading, this over the needle's length (default: 0)"
    option("--noise", type=command.number_argument(0.0, 1e-2), default=0.0, metavar="METRES", help=noise)


def run_render(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Write a bag of simulated camera frames, or poses.

    A reference trajectory is rendered as the overhead camera would see it, and written as a bag: JPEG frames,
    camera_info, the needle velocity commands that the trajectory amounts to, and ground truth. With --poses, needle
    poses and measured threads take the place of frames. Everything in the bag is simulated; its notes say so, and
    `replay` repeats it.
    """
    if options.noise and not options.poses:
        raise ConfigurationError("--noise", options.noise, "none without --poses")
    given = command.given(options, "start", "duration", "rate", "quality", "seed")
    given["pose_noise"] = options.noise if options.poses else None
    setup, reference = read_setup(options.setup), read_reference(options.reference)
    with terminal.progress("render") as advance:
        frames = render_bag(reference, setup, options.output, progress=advance, **given)
    terminal.log(f"{frames} simulated {'poses' if options.poses else 'frames'} in {options.output}")
    return command.DONE


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
    pose_noise: float | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> int:
    """Write a trajectory as a bag; return the number of frames, or of poses.

    The bag begins with the scene. It holds JPEG frames and camera_info, or in their place needle poses and measured
    threads; besides, the needle velocity command that the trajectory amounts to, and ground truth on topics of its own.
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
        pose_noise: standard deviation of tail and measured thread, where poses and measured threads take the place of
            frames; of the heading, the same over the needle's length [m]. None for frames.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the output exists or cannot be written, or the trajectory has no such time.
        ConfigurationError: the setup is for another thread or another obstacle than the trajectory's.
    """
    first, last = float(reference.times[0]), float(reference.times[-1])
    end = last if duration is None else start + duration
    if not (first <= start < end <= last + 1e-9):
        raise BagError(reference.name, f"has the times {first:g} to {last:g} s; asked for {start:g} to {end:g} s")
    frames = round((end - start) * rate)
    if frames < 1:
        raise BagError(reference.name, f"{end - start:g} s at {rate:g} frames a second hold no frame")
    _check_setup(reference, setup)
    what = "camera frames and needle motion, rendered" if pose_noise is None else "needle poses and seen thread"
    notes = {"setup": setup.name, "simulated": f"{what} from the reference trajectory {reference.name}"}
    source: tuple[interface.Channel, ...] = (interface.NEEDLE_POSE, interface.MEASURED_THREAD)
    if pose_noise is None:
        source, messages = (interface.COMPRESSED_IMAGE, interface.CAMERA_INFO), _frames(setup, reference, quality, seed)
    else:
        messages = _poses(setup, pose_noise, seed)
    motion = (interface.NEEDLE_COMMAND, interface.GROUND_TRUTH_NEEDLE, interface.GROUND_TRUTH_THREAD)
    channels = (*source, *motion)
    with whole_folder(output) as folder, BagWriter(folder, notes, name=output.name) as bag:
        for channel in (interface.SCENE, *channels):
            bag.add_topic(channel.recorded, channel.type_name)
        begin = round((start + EPOCH) * 1e9)
        bag.write(interface.SCENE.recorded, begin, packed_scene(begin, setup.scene))
        for index in range(frames):
            time = start + index / rate
            before, after = max(first, time - 0.5 / rate), min(last, time + 0.5 / rate)
            velocity = (reference.at(after)[0] - reference.at(before)[0]) / (after - before)
            stamp, (tail, heading, thread) = round((time + EPOCH) * 1e9), reference.at(time)
            instant = (
                *messages(stamp, tail, heading, thread),
                packing.packed_twist(stamp, velocity),
                packing.packed_pose_stamped(stamp, tail, heading),
                packing.packed_path(stamp, _resampled(thread, 51)),
            )
            for channel, message in zip(channels, instant, strict=True):
                bag.write(channel.recorded, stamp, message)
            progress((index + 1) / frames)
    return frames


def _check_setup(reference: ReferenceTrajectory, setup: Setup) -> None:
    """Refuse a setup with another thread, attachment or obstacle than the trajectory's.

    Lengths that differ by less than a nanometre are the same. No trajectory has polygons, and the simulated camera does
    not draw them.
    """
    metadata, model, obstacles = reference.metadata, setup.model, setup.scene.obstacles
    attachment = {"pinned": Attachment.PINNED, "clamped": Attachment.CLAMPED}.get(str(metadata.get("boundary")))
    length = metadata.get("material", {}).get("L_m")
    given, expected = (
        np.array([(*d.centre, d.radius) for d in discs if isinstance(d, Disc)])
        for discs in (obstacles, reference.discs)
    )
    same = len(given) == len(obstacles) == len(expected) and np.allclose(given, expected, rtol=0.0, atol=1e-9)
    problems: dict[str, tuple[object, object]] = {}
    if length is not None and not math.isclose(model.thread_length, length, rel_tol=0.0, abs_tol=1e-9):
        problems["thread_model.thread_length"] = model.thread_length, length
    if attachment is not None and model.attachment != attachment.value:
        problems["thread_model.attachment"] = model.attachment, attachment.value
    if not same:
        problems["scene"] = obstacles, reference.discs
    for name, (found, wanted) in problems.items():
        raise ConfigurationError(name, found, f"{wanted}, as in {reference.name}", str(setup.path))


Messages: TypeAlias = "Callable[[int, Points, float, Points], tuple[bytes, bytes]]"  # of stamp, tail, heading, thread


def _frames(setup: Setup, reference: ReferenceTrajectory, quality: int, seed: int) -> Messages:
    """Return what makes a camera frame and its camera_info."""
    view = DishView((322.0, 238.0), setup.scene.dish.diameter / (0.9115 * SIZE[1]))
    scene = CameraScene(
        dish_diameter=setup.scene.dish.diameter,
        needle_length=setup.vision.needle_length,
        needle_width=setup.vision.needle_width,
        thread_diameter=setup.model.thread().diameter,
        obstacles=reference.discs,
    )
    camera = DishCamera(scene, view, SIZE, seed)

    def messages(stamp: int, tail: Points, heading: float, thread: Points) -> tuple[bytes, bytes]:
        data = encode_jpeg(camera.render(tail, heading, thread), quality)
        information = packing.packed_camera_info(stamp, camera.size, camera.view, 0.3)  # m above the dish
        return packing.packed_compressed_image(stamp, data), information

    return messages


def _poses(setup: Setup, noise: float, seed: int) -> Messages:
    """Return what makes a pose and a measured thread, as a tracker would measure them in the frames."""
    deviations, random = np.array([noise, noise, noise / setup.vision.needle_length]), np.random.default_rng(seed)

    def messages(stamp: int, tail: Points, heading: float, thread: Points) -> tuple[bytes, bytes]:
        offset = deviations * random.standard_normal(3)
        angle = heading + offset[2]
        direction = np.array([np.cos(angle), np.sin(angle)])
        pose = packing.packed_pose(stamp, tail + offset[:2], direction, np.diag(deviations**2))
        measured = _resampled(thread, 64)
        measured[1:] += noise * random.standard_normal(measured[1:].shape)
        measured[0] = tail + offset[:2]  # a measured thread begins at the measured tail
        return pose, packing.packed_path(stamp, measured)

    return messages


def _resampled(thread: Points, count: int) -> Points:
    """Return equally spaced points of a thread."""
    return points_at(thread, np.linspace(0.0, arc_lengths(thread)[-1], count))
