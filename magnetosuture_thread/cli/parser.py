"""What can be written on the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from magnetosuture_thread.cli import commands

DESCRIPTION = """\
Predicts where a suture thread goes behind a magnetically steered needle.

Research software, no medical device. Lengths are in metres and times in seconds throughout.
"""

RECORD = """\
Render a reference trajectory as the overhead camera would see it, and write a bag: JPEG frames,
camera_info, the needle velocity commands that the trajectory amounts to, and the truth. Everything in
the bag is simulated; its notes say so, and `replay` repeats it.
"""

REPLAY = """\
Play an mcap bag through the live graph: vision_tracker, thread_model and coil_bridge run as processes
of their own, on a ROS domain that nobody else uses, with simulated time on /clock and no hardware.

DIR, which must not exist, gets
  bag/           all outputs of the graph, an mcap bag
  summary.json   the figures of the table
  summary.png    a frame with the predicted thread over the seen one; error and margins over time
  logs/          what each node printed
"""

EVALUATE = """\
Score the thread model on reference trajectories: files DIR/*.npz with the needle's poses and the thread
that followed (arrays t, pose, X and meta, as for `record`). The model starts from the first thread, is
driven by the poses and nothing else, with each file's own thread and parameters, and is compared at every
sample. Errors are mean distances of the nodes in % of the thread's length.
"""

BENCH = """\
Time the thread model on this machine: one whole step (barriers, obstacles and solves) and the solve
alone, by number of segments, dimension, obstacles and solver, with the largest residual beside every
time. Single thread, wall clock; the machine's other work shows in the 99th percentile.
"""

SIMULATE = """\
Run the whole graph without a robot: rig_simulator stands in for coils, dish, needle, thread and camera;
vision_tracker, thread_model and coil_bridge are the ones that run on a robot; path_follower asks for
needle velocities along the scenario's path. All are processes of their own, on a ROS domain that nobody
else uses. Everything is simulated, and the bag says so.

SCENARIO is a set-up with waypoints in its section path_follower. BAG, which must not exist, gets all that
was said, the truth included, and the nodes' logs; `replay` takes it. Ctrl-C ends the run, and what was
recorded stays. The first run on a machine compiles for a minute before it begins.
"""

TRACK = """\
Find needle and thread in camera frames, without a graph. FRAMES are pictures, a folder of them, or a bag.
Pictures are looked at one by one; a bag's frames are followed over time, as the node vision_tracker does.

--json writes a list with an entry for each frame: file (for a bag, topic and stamp), status (tracked, lost
or searching) and its reason, tail_m, tip_m and heading_rad (the tangent at the tail), curvature_per_m
(positive to the left), thread_m from the tail on, all in the dish frame, confidence from 0 to 1, stamp_s,
and time_s, the processor time to look at the frame, on one core, without reading and decoding it; all is
compiled before. What has no value is null.
"""

CALIBRATE_CAMERA = """\
Find where the dish is in the camera's image: its centre, the scale and, by markers, the rotation. FILE
gets a section vision_tracker of a ROS 2 parameter file.

Without --markers the dish's rim is used: a mean over all frames. With --markers, ArUco markers 4x4_50 lie
around the dish, their centres SPACING apart on a square around its centre: 0 at the top left, then
clockwise, all upright.
"""

BEHAVIOUR = """\
Run the paper's two thread-behaviour tests in a closed loop around the simulated rig, a polyamide thread
of 19 mm and a silk thread of 150 mm in a larger dish, and compare the predicted thread with the truth
and with what the camera sees. DIR, which must not exist, gets a bag of each, behaviour.json and
behaviour.png. Everything is simulated. Takes two minutes.
"""

EXIT_CODES = "exit codes: 0 done, 1 the job failed, 2 wrong use"


def make_parser() -> argparse.ArgumentParser:
    """Return the parser; each command sets `run` to what it does."""
    parser = argparse.ArgumentParser(
        prog="magnetosuture",
        description=DESCRIPTION,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    replay = _command(subparsers, "replay", "play a recorded bag through the live graph", REPLAY, commands.replay)
    replay.add_argument("bag", type=Path, metavar="BAG", help="an mcap file, or the folder of a bag")
    replay.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    replay.add_argument(
        "--setup", default="", metavar="NAME", help="a set-up's name or YAML file (default: the one the bag names)"
    )
    replay.add_argument(
        "--rate", type=number(0.05, 20.0), default=1.0, help="how much faster than recorded (default: 1)"
    )
    record = _command(subparsers, "record", "write a bag of simulated camera frames", RECORD, commands.record)
    record.add_argument("reference", type=Path, metavar="REFERENCE", help="a reference trajectory (.npz)")
    record.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    record.add_argument("--setup", required=True, metavar="NAME", help="a set-up's name or YAML file")
    record.add_argument("--start", type=number(0.0, 1e6), default=0.0, help="time in the trajectory to begin at [s]")
    record.add_argument("--duration", type=number(1e-3, 1e6), help="[s] (default: to the trajectory's end)")
    record.add_argument("--rate", type=number(1.0, 240.0), default=30.0, help="frames a second (default: 30)")
    record.add_argument(
        "--quality",
        type=int,
        choices=range(1, 101),
        default=85,
        metavar="1..100",
        help="of the JPEG frames (default: 85)",
    )
    record.add_argument("--seed", type=whole_number, default=0, help="of dust and sensor noise (default: 0)")
    simulate = _command(
        subparsers, "simulate", "run the whole graph around a simulated rig", SIMULATE, commands.simulate
    )
    simulate.add_argument("scenario", metavar="SCENARIO", help="a set-up's name or YAML file")
    simulate.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    simulate.add_argument(
        "--duration", type=number(0.1, 1e5), help="end after this many seconds (default: at the end of the path)"
    )
    simulate.add_argument(
        "--pace",
        type=number(0.5, 5.0),
        help="run with a simulated clock, this much faster than real time (default: in real time)",
    )
    simulate.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to a file")
    behaviour = _command(
        subparsers,
        "behaviour",
        "compare prediction and truth in closed loop, by material",
        BEHAVIOUR,
        commands.behaviour,
    )
    behaviour.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    evaluate = _command(
        subparsers, "evaluate", "score the model on reference trajectories", EVALUATE, commands.evaluate
    )
    evaluate.add_argument("folder", type=Path, metavar="DIR", help="folder of trajectories, or one .npz file")
    evaluate.add_argument(
        "--formulation", choices=("rod", "paper"), default="rod", help="how a step is written (default: rod)"
    )
    evaluate.add_argument(
        "--solver", choices=("banded", "osqp"), default="banded", help="what solves a step (default: banded)"
    )
    evaluate.add_argument(
        "--segments", type=segments, metavar="N", help="number of segments (default: the paper's, as each file says)"
    )
    evaluate.add_argument(
        "--rig", action="store_true", help="score the simulated rig's thread instead of the model (default: N = 100)"
    )
    evaluate.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to a file")
    evaluate.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each case into a folder")
    track = _command(subparsers, "track", "find needle and thread in camera frames", TRACK, commands.track)
    track.add_argument("frames", type=Path, nargs="+", metavar="FRAMES", help="pictures, a folder of them, or a bag")
    track.add_argument(
        "--setup",
        default="petri_35mm_polyamide",
        metavar="NAME",
        help="a set-up's name or YAML file (default: %(default)s)",
    )
    track.add_argument(
        "--metres-per-pixel",
        type=number(1e-7, 1e-2),
        metavar="S",
        help="the scale (default: the set-up's, or from the dish's diameter)",
    )
    track.add_argument(
        "--centre",
        type=number(0.0, 1e5),
        nargs=2,
        metavar=("U", "V"),
        help="the dish's centre [px] (default: the set-up's, or found)",
    )
    track.add_argument("--json", type=output_file, metavar="FILE", help="write what was found to a file")
    track.add_argument(
        "--overlay", type=Path, metavar="PATH", help="draw it over the frames: a video (.mp4, .avi), or a folder of PNG"
    )
    calibrate = _command(
        subparsers,
        "calibrate-camera",
        "find where the dish is in the camera's image",
        CALIBRATE_CAMERA,
        commands.calibrate_camera,
    )
    calibrate.add_argument(
        "frames", type=Path, nargs="+", metavar="FRAMES", help="pictures, a folder of them, or a bag"
    )
    calibrate.add_argument(
        "--dish-diameter", type=number(0.005, 0.5), required=True, metavar="D", help="inner diameter of the dish [m]"
    )
    calibrate.add_argument(
        "--markers",
        type=number(1e-3, 2.0),
        nargs=2,
        metavar=("SPACING", "SIDE"),
        help="of the ArUco markers around the dish [m] (default: by the dish's rim)",
    )
    calibrate.add_argument("--output", type=output_file, required=True, metavar="FILE", help="parameter file to write")
    bench = _command(subparsers, "bench", "time the model on this machine", BENCH, commands.bench)
    bench.add_argument(
        "--peers", action="store_true", help="time other solvers and simulators too (needs the extra `peers`)"
    )
    bench.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to a file")
    return parser


def _command(
    subparsers: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    summary: str,
    description: str,
    run: Callable[[argparse.Namespace], int],
) -> argparse.ArgumentParser:
    parser = subparsers.add_parser(
        name,
        help=summary,
        description=description,
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def number(low: float, high: float) -> Callable[[str], float]:
    """Return an argument type: a number within bounds."""

    def within(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is no number from {low:g} to {high:g}")
        return value

    return within


def whole_number(text: str) -> int:
    """Return a whole number of at least 0: an argument type."""
    if not (text.isascii() and text.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number of at least 0")
    return int(text)


def segments(text: str) -> int:
    """Return a number of segments: an argument type."""
    count = whole_number(text)
    if not 3 <= count <= 2000:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of segments from 3 to 2000")
    return count


def output_file(text: str) -> Path:
    """Return a file to write, in a folder that exists: an argument type."""
    path = Path(text)
    if not path.parent.is_dir() or path.is_dir():
        raise argparse.ArgumentTypeError(f"{text!r} is no file in a folder that exists")
    return path
