"""The command `magnetosuture teach`."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from magnetosuture_thread.commands import command
from magnetosuture_thread.commands.track import add_view, chosen_view, open_frames
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.files import whole_file
from magnetosuture_thread.vision.calibration import Calibration
from magnetosuture_thread.vision.overlay import draw_taught, write_png
from magnetosuture_thread.vision.teaching import teach
from magnetosuture_thread.vision.tracker import VisionTracker, warm_up


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    command.add_frames(parser)
    pixel = command.number_argument(0.0, 1e5)
    for end in ("tail", "tip"):
        where = f"the needle's {end} in the first frame, to an eighth of its length [px]"
        option(f"--{end}", type=pixel, nargs=2, required=True, metavar=("U", "V"), help=where)
    add_view(parser)
    option("--output", type=command.output_file, required=True, metavar="FILE", help="parameter file to write")
    picture = "what was learnt (default: beside the output, .png)"
    option("--picture", type=command.output_file, metavar="FILE", help=picture)


def run_teach(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Learn how the needle looks from one frame on which both of its ends are marked.

    Length, width, colours, contrast and brightness are measured between the marks in the first frame, and its view and
    dish are those that `track` finds. FILE is a ROS 2 parameter file, for `track --setup` with the same dish, for the
    node vision_tracker, or to copy into a setup. The picture shows the dish as the matched filter takes it, its answer,
    and the second best.

    All other frames are then looked at one by one, and it is said in how many the needle is found.
    """
    settings, scene = chosen_view(options)
    source = open_frames(options, terminal.log)
    frames = (frame for frame in source.frames if frame.image is not None)
    first = next(frames, None)
    if first is None:
        raise BagError(options.frames[0], "holds no frame that can be read")
    warm_up()
    image = first.undistorted()
    tracker = VisionTracker(settings, scene)
    tracker.set_lens(first.lens)
    assert first.image is not None
    seen = tracker.look(first.image)
    if seen.view is None:
        raise BagError(first.name, f"{seen.reason}; give --centre and --metres-per-pixel")
    if seen.warning:
        terminal.log(seen.warning)
    image = seen.prepared(image)
    marks = seen.view.to_pixels(np.array([seen.place_of(np.array(mark)) for mark in (options.tail, options.tip)]))
    taught = teach(image, seen.view, scene.dish.radius, marks, settings)
    told = taught.settings
    size, straight = (told.needle_length, told.needle_width), seen.straightening
    result = Calibration(seen.view, 1, 0.0, 0.0, scene.dish.diameter, straight, size, told, seen.scale_error)
    with whole_file(options.output) as partial:
        partial.write_text(result.to_yaml(), encoding="utf-8")
    picture = options.picture or options.output.with_suffix(".png")
    write_png(picture, draw_taught(image, taught))
    others = [score for _, score in taught.answers] + [0.0, 0.0]
    shape = "blunt at both ends" if told.needle_is_blunt else "with a point"
    terminal.log(f"needle of {1e3 * size[0]:.2f} x {1e3 * size[1]:.2f} mm, {shape}")
    terminal.log(
        f"{taught.contrast:.0%} darker than the floor; the filter answers {others[0]:.2f}, elsewhere {others[1]:.2f}"
    )
    view = seen.view
    told = replace(told, dish_centre_px=view.centre_px, metres_per_pixel=view.metres_per_pixel)
    told = told if straight is None else replace(told, straightening=tuple(straight.ravel().tolist()))
    tracker = VisionTracker(told, scene)
    found = count = 0
    with terminal.progress("teach") as advance:
        for frame in frames:
            assert frame.image is not None
            tracker.set_lens(frame.lens)
            count += 1
            found += len(tracker.look(frame.image).axis) > 0
            advance(count / max(source.count - 1, count))
    source.log_refused(terminal.log)
    if count:
        terminal.log(f"found in {found} of {count} other frames")
    given = Path(options.scene).name or f"--dish-diameter {scene.dish.diameter:g}"
    terminal.log(f"parameters: {options.output}, for track --setup with {given}; picture: {picture}")
    return command.DONE if found or not count else command.FAILED
