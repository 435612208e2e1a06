"""What can be written on the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from magnetosuture_thread.cli import commands
from magnetosuture_thread.cli.arguments import number, output_file, segments, whole_number
from magnetosuture_thread.cli.texts import (
    BEHAVIOUR,
    BENCH,
    CALIBRATE_CAMERA,
    CALIBRATE_COILS,
    COILS,
    DESCRIPTION,
    EVALUATE,
    EXIT_CODES,
    RECORD,
    REPLAY,
    SIMULATE,
    TRACK,
)
from magnetosuture_thread.jobs.coils import ACTIONS


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
    either = simulate.add_mutually_exclusive_group()
    either.add_argument(
        "--pace",
        type=number(0.5, 5.0),
        help="run with a simulated clock, this much faster than real time (default: in real time)",
    )
    either.add_argument(
        "--boards", action="store_true", help="drive simulated RoboClaw boards, by the driver for real ones"
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
    coils = _command(
        subparsers,
        "calibrate-coils",
        "find the coils' properties from probe measurements",
        CALIBRATE_COILS,
        commands.calibrate_coils,
    )
    coils.add_argument("measurements", type=Path, metavar="MEASUREMENTS", help="CSV file")
    coils.add_argument("--output", type=output_file, required=True, metavar="FILE", help="calibration to write (YAML)")
    coils.add_argument(
        "--model", choices=("loops", "dipoles"), default="loops", help="field of a coil (default: %(default)s)"
    )
    coils.add_argument("--name", default="", metavar="RIG", help="the rig's name (default: the file's)")
    switch = _command(subparsers, "coils", "arm, disarm, stop or reset the running coil bridge", COILS, commands.coils)
    switch.add_argument("action", choices=ACTIONS, metavar="ACTION", help=", ".join(ACTIONS))
    bench = _command(subparsers, "bench", "time the model on this machine", BENCH, commands.bench)
    bench.add_argument(
        "--peers", action="store_true", help="time other solvers and simulators too (needs the extra `peers`)"
    )
    bench.add_argument("--bridge", action="store_true", help="time the coil bridge instead, with simulated boards")
    for name, default, what in (
        ("trials", 500, "a commander that falls silent"),
        ("kills", 20, "kill -9 of each process"),
        ("hostile", 10_000, "hostile messages"),
    ):
        bench.add_argument(
            f"--{name}",
            type=whole_number,
            default=default,
            metavar="N",
            help=f"of --bridge: {what} (default: {default})",
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
