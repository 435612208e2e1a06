"""The command `magnetosuture render`: a bag of simulated camera frames, or of poses, from a reference trajectory."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np

from magnetosuture_thread import ConfigurationError, Disc
from magnetosuture_thread.bags import packing
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


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    option("reference", type=Path, metavar="REFERENCE", help="a reference trajectory (.npz)")
    option("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    option("--setup", required=True, metavar="NAME", help="a setup's name or YAML file")
    start = "time in the trajectory to begin at [s]"
    option("--start", type=command.number_argument(0.0, 1e6), default=0.0, help=start)
    option("--duration", type=command.number_argument(1e-3, 1e6), help="[s] (default: to the trajectory's end)")
    rate = "frames, or poses, a second (default: 30)"
    option("--rate", type=command.number_argument(1.0, 240.0), default=30.0, help=rate)
    quality = "of the JPEG frames (default: 85)"
    option("--quality", type=int, choices=range(1, 101), default=85, metavar="1..100", help=quality)
    option("--seed", type=command.whole_number, default=0, help="of dust and noise (default: 0)")
    option("--poses", action="store_true", help="write poses and measured threads instead of frames")
    noise = "of these, standard deviation; of the heading, this over the needle's length (default: 0)"
    option("--noise", type=command.number_argument(0.0, 1e-2), default=0.0, metavar="METRES", help=noise)


def run_render(options: argparse.Namespace, terminal: command.Terminal) -> None:
    """Write a bag of simulated camera frames, or poses.

    A reference trajectory is rendered as the overhead camera would see it, and written as a bag: JPEG frames,
    camera_info, the needle velocity commands that the trajectory amounts to, and ground truth. With --poses, needle
    poses and measured threads take the place of frames. Everything in the bag is simulated; its notes say so, and
    `replay` repeats it.
    """
    if options.noise and not options.poses:
        raise ConfigurationError("--noise", options.noise, "none without --poses")
    chosen = command.given(options, "start", "duration", "rate", "quality", "seed")
    chosen["pose_noise"] = options.noise if options.poses else None
    setup, reference = read_setup(options.setup), read_reference(options.reference)
    with terminal.progress("render") as advance:
        frames = render_bag(reference, setup, options.output, progress=advance, **chosen)
    terminal.log(f"{frames} simulated {'poses' if options.poses else 'frames'} in {options.output}")


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
    measure = _frames(setup, reference, quality, seed) if pose_noise is None else _poses(setup, pose_noise, seed)
    with whole_folder(output) as folder, BagWriter(folder, notes, name=output.name) as bag:
        bag.add_topic(interface.SCENE.recorded, interface.SCENE.type_name)
        epoch = 1.0  # s; the bag's time at the trajectory's time 0, as time 0 means "not set" in ROS
        begin = round((start + epoch) * 1e9)
        bag.write(interface.SCENE.recorded, begin, packing.packed_scene(begin, setup.scene))
        for index in range(frames):
            time = start + index / rate
            before, after = max(first, time - 0.5 / rate), min(last, time + 0.5 / rate)
            velocity = (reference.at(after)[0] - reference.at(before)[0]) / (after - before)
            stamp, (tail, heading, thread) = round((time + epoch) * 1e9), reference.at(time)
            outputs = (
                *measure(stamp, tail, heading, thread),
                (interface.NEEDLE_COMMAND, packing.packed_twist(stamp, velocity)),
                (interface.GROUND_TRUTH_NEEDLE, packing.packed_pose_stamped(stamp, tail, heading)),
                (interface.GROUND_TRUTH_THREAD, packing.packed_path(stamp, _resampled(thread, 51))),
            )
            for channel, message in outputs:
                if index == 0:
                    bag.add_topic(channel.recorded, channel.type_name)
                bag.write(channel.recorded, stamp, message)
            progress((index + 1) / frames)
    return frames


def _check_setup(reference: ReferenceTrajectory, setup: Setup) -> None:
    """Refuse a setup with another thread, attachment or obstacle than the trajectory's.

    Lengths that differ by less than a nanometre are the same. No trajectory has polygons, and the simulated camera does
    not draw them.
    """
    metadata, model, obstacles = reference.metadata, setup.model, setup.scene.obstacles
    length, attachment = metadata.get("material", {}).get("L_m"), str(metadata.get("boundary"))
    discs, expected = (
        np.array([(*d.centre, d.radius) for d in shapes if isinstance(d, Disc)])
        for shapes in (obstacles, reference.discs)
    )
    same = len(discs) == len(obstacles) == len(expected) and np.allclose(discs, expected, rtol=0.0, atol=1e-9)
    is_long = length is not None and not math.isclose(model.thread_length, length, rel_tol=0.0, abs_tol=1e-9)
    is_fixed = attachment in ("pinned", "clamped") and model.attachment != attachment
    for is_wrong, name, value, wanted in (
        (is_long, "thread_model.thread_length", model.thread_length, length),
        (is_fixed, "thread_model.attachment", model.attachment, attachment),
        (not same, "scene", obstacles, reference.discs),
    ):
        if is_wrong:
            raise ConfigurationError(name, value, f"{wanted}, as in {reference.name}", str(setup.path))


Measure: TypeAlias = "Callable[[int, Points, float, Points], packing.Outputs]"  # of stamp, tail, heading, thread


def _frames(setup: Setup, reference: ReferenceTrajectory, quality: int, seed: int) -> Measure:
    """Return what makes a camera frame and its camera_info."""
    size = (640, 480)
    view = DishView((322.0, 238.0), setup.scene.dish.diameter / (0.9115 * size[1]))
    scene = CameraScene(
        dish_diameter=setup.scene.dish.diameter,
        needle_length=setup.vision.needle_length,
        needle_width=setup.vision.needle_width,
        thread_diameter=setup.model.thread().diameter,
        obstacles=reference.discs,
    )
    camera = DishCamera(scene, view, size, seed)

    def measure(stamp: int, tail: Points, heading: float, thread: Points) -> packing.Outputs:
        jpeg = encode_jpeg(camera.render(tail, heading, thread), quality)
        return packing.camera_outputs(stamp, jpeg, camera.size, camera.view, 0.3)  # m above the dish

    return measure


def _poses(setup: Setup, noise: float, seed: int) -> Measure:
    """Return what makes a pose and a measured thread, as a tracker would measure them in the frames."""
    deviations, random = np.array([noise, noise, noise / setup.vision.needle_length]), np.random.default_rng(seed)

    def measure(stamp: int, tail: Points, heading: float, thread: Points) -> packing.Outputs:
        offset = deviations * random.standard_normal(3)
        angle, tail = heading + offset[2], tail + offset[:2]
        direction = np.array([np.cos(angle), np.sin(angle)])
        yield from packing.pose_outputs(stamp, tail, direction, np.diag(deviations**2))
        measured = _resampled(thread, 64)
        measured[1:] += noise * random.standard_normal(measured[1:].shape)
        measured[0] = tail  # a measured thread begins at the measured tail
        yield interface.MEASURED_THREAD, packing.packed_path(stamp, measured)

    return measure


def _resampled(thread: Points, count: int) -> Points:
    """Return equally spaced points of a thread."""
    return points_at(thread, np.linspace(0.0, arc_lengths(thread)[-1], count))
