"""The commands that compare or show what is predicted and measured: evaluate, track."""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.cli.arguments import (
    DONE,
    FAILED,
    Subparsers,
    add_frames,
    add_scheduler,
    add_source,
    bag_location,
    bag_selection,
    command,
    count_argument,
    number_argument,
    output_file,
)
from magnetosuture_thread.cli.terminal import make_console, make_log, progress, write_json

MAX_ROWS = 20  # of frames; beyond, only the summary is shown
BAG_OPTIONS = ("output", "setup", "against", "source", "remap", "frame", "start", "duration", "workers", "scheduler")
REFERENCE_OPTIONS = ("solver", "segments", "rig", "json", "pictures")


def add(subparsers: Subparsers) -> None:
    """Add the commands."""
    parser = command(subparsers, "evaluate", run_evaluate)
    parser.set_defaults(default_of=parser.get_default)
    parser.add_argument("paths", type=bag_location, nargs="+", metavar="PATH", help="bags, or trajectories; see above")
    # The model's own names, written out: importing the model for them would be slow.
    formulation = "how a step is written (default: a bag's setup's; rod)"
    parser.add_argument("--formulation", choices=("rod", "paper"), help=formulation)
    bags = parser.add_argument_group("bags")
    option = bags.add_argument
    option("--output", type=Path, metavar="DIR", help="folder to make; required")
    against = "measured thread (seen) or ground truth (default: both where present, the worst frames by ground truth)"
    option("--against", choices=("auto", "truth", "seen"), default="auto", help=against)
    add_source(bags, "each bag")
    start = "seconds into each bag to begin at"
    option("--start", type=number_argument(0.0, 1e9), default=0.0, metavar="S", help=start)
    option("--duration", type=number_argument(0.0, 1e9), metavar="S", help="seconds (default: to each bag's end)")
    workers = count_argument("processes", 1, 256)
    option("--workers", type=workers, default=1, metavar="N", help="processes (default: 1)")
    add_scheduler(bags)
    option = parser.add_argument_group("reference trajectories").add_argument
    option("--solver", choices=("banded", "osqp"), help="what solves a step (default: banded)")
    segments = "number of segments (default: the paper's, as each file says)"
    option("--segments", type=count_argument("segments", 3, 2000), metavar="N", help=segments)
    rig = "score the simulated rig's thread instead of the model (default: N = 100)"
    option("--rig", action="store_true", help=rig)
    option("--json", type=output_file, metavar="FILE", help="write the figures to a file")
    option("--pictures", type=Path, metavar="FOLDER", help="draw each case into a folder")

    parser = command(subparsers, "track", run_track)
    option = parser.add_argument
    add_frames(parser)
    setup = "a setup's name or YAML file (default: %(default)s)"
    option("--setup", default="petri_35mm_polyamide", metavar="NAME", help=setup)
    option("--scene", default="", metavar="NAME", help="a scene's name or file (default: the setup's)")
    scale = "the scale (default: the setup's, or from the dish's diameter)"
    option("--metres-per-pixel", type=number_argument(1e-7, 1e-2), metavar="S", help=scale)
    centre = "the dish's centre [px] (default: the setup's, or found)"
    option("--centre", type=number_argument(0.0, 1e5), nargs=2, metavar=("U", "V"), help=centre)
    lens = "the lens, as ROS's camera_calibration_parsers writes it (YAML; default: a bag's camera_info)"
    option("--camera-info", type=Path, metavar="FILE", help=lens)
    option("--json", type=output_file, metavar="FILE", help="write what was found to a file")
    overlay = "draw it over the frames: a video (.mp4, .avi), or a folder of PNG"
    option("--overlay", type=Path, metavar="PATH", help=overlay)


def run_evaluate(options: argparse.Namespace) -> int:
    """Score the thread model on bags, or on reference trajectories.

    Bags: the thread of each is predicted and estimated without a graph, as fast as the machine can, and compared with
    the measured centreline and, where the bag holds it, ground truth. PATH is an mcap or db3 file, the folder of a
    bag, or a folder of bags, which may be up to two folders below; or the URL of one, such as s3://BUCKET/RUNS. DIR,
    which must not exist, gets
      NAME.html    a page for each bag, which needs no network: plots to zoom, the worst frames
      table.csv    a row for each bag, SI units and %
      table.json   the same, with mean and worst, and prediction and estimate side by side
      table.parquet  table.csv for DuckDB or pandas, where pyarrow is installed (extra `cluster`)
    A bag that cannot be evaluated has its row too, with the problem in it; the exit code is 1 then.

    Reference trajectories: files DIR/*.npz with the needle's poses and the thread that followed (arrays t, pose, X and
    meta, as for `render`). The model starts from the first thread, is driven by the poses and nothing else, with each
    file's own thread and parameters, and is compared at every sample. Bags and trajectories need a call each.

    Errors are mean distances of the nodes in % of the thread's length.
    """
    from magnetosuture_thread.jobs.evaluate import kind_of

    if kind_of(options.paths) == "bags":
        _refuse(options, REFERENCE_OPTIONS, "only for reference trajectories; PATH is none")
        return _evaluate_bags(options)
    _refuse(options, BAG_OPTIONS, "only for bags; PATH is a reference trajectory")
    return _score_references(options)


def _refuse(options: argparse.Namespace, names: Sequence[str], why: str) -> None:
    for name in names:
        given = getattr(options, name)
        if given != options.default_of(name):
            raise ConfigurationError(f"--{name}", str(given), f"nothing: it is {why}")


def _evaluate_bags(options: argparse.Namespace) -> int:
    from magnetosuture_thread.evaluation.tables import bags_table
    from magnetosuture_thread.jobs.evaluate import evaluate_bags

    if options.output is None:
        raise ConfigurationError("--output", None, "a folder to make, as PATH is a bag")
    console = make_console()
    log = make_log(console)
    with progress(console, "evaluate") as advance:
        rows = evaluate_bags(
            options.paths,
            options.output,
            against=options.against,
            formulation=options.formulation or "",
            workers=options.workers,
            scheduler=options.scheduler,
            log=log,
            progress=advance,
            **bag_selection(options),
        )
    console.print(bags_table(rows))
    log(f"results: {options.output}")
    return FAILED if any(row["problem"] for row in rows) else DONE


def _score_references(options: argparse.Namespace) -> int:
    from magnetosuture_thread.evaluation.plots import draw_case
    from magnetosuture_thread.evaluation.reference import CaseResult, find_references, score
    from magnetosuture_thread.evaluation.tables import evaluation_table
    from magnetosuture_thread.jobs.rig import score_rig

    console = make_console()
    paths = [path for folder in options.paths for path in find_references(folder)]
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    formulation = options.formulation or "rod"

    def keep(case: CaseResult) -> None:
        if options.pictures:
            name = "rig" if options.rig else formulation
            draw_case(options.pictures / f"{case.score.name}.png", case, name)

    with progress(console, "evaluate") as advance:
        given: dict[str, Any] = {"segments": options.segments, "progress": advance, "keep": keep}
        if options.rig:
            evaluation = score_rig(paths, **given)
        else:
            evaluation = score(paths, formulation=formulation, solver=options.solver or "banded", **given)
    console.print(evaluation_table(evaluation))
    write_json(options.json, evaluation.to_mapping())
    return DONE


def run_track(options: argparse.Namespace) -> int:
    """Find needle and thread in camera frames, without a graph.

    FRAMES are pictures, a folder of them, or a bag. Pictures are searched one by one; a bag's frames are followed
    over time, as the node vision_tracker does.

    --json writes a list with an entry for each frame: file (for a bag, topic and stamp), status (tracked, lost
    or searching) and its reason, tail_m, tip_m and heading_rad (the tangent at the tail), curvature_per_m
    (positive to the left), thread_m from the tail on, all in the dish frame, needle_length_m as measured over
    the first frames of a bag, pieces of the thread (points_m, deviation_m across, why their ends are ends,
    arc_length_m of the first point at least and at most) and whether they are complete, confidence from 0 to 1,
    stamp_s, and time_s, the processor time to search the frame, on one core, without reading and decoding it;
    all is compiled before. What has no value is null.
    """
    from magnetosuture_thread import read_scene
    from magnetosuture_thread.jobs.track import settings_with, track
    from magnetosuture_thread.setups import read_setup
    from magnetosuture_thread.vision.lens import read_lens

    console = make_console()
    log = make_log(console)
    setup = read_setup(options.setup, read_scene(options.scene) if options.scene else None)
    settings = settings_with(setup.vision, options.metres_per_pixel, options.centre)
    lens = read_lens(options.camera_info) if options.camera_info is not None else None
    given = {"overlay": options.overlay, "remap": dict(options.remap), "lens": lens, "log": log}
    with progress(console, "track") as advance:
        frames = track(options.frames, settings, setup.scene, progress=advance, **given)
    rows = [frame.to_json() for frame in frames]
    console.print(track_table(rows))
    for line in track_lines(rows):
        log(line)
    write_json(options.json, rows)
    return DONE


def track_table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return a row for each of the first frames, as `TrackedFrame.to_json` gives them."""
    import numpy as np

    table = Table(title=f"{len(rows)} frames")
    table.caption = "tail and thread's length in mm, heading in degrees, confidence, processor time"
    table.add_column("frame", overflow="fold", min_width=12)
    table.add_column("status")
    for name in ("tail", "heading", "thread", "sure", "ms"):
        table.add_column(name, justify="right", no_wrap=True)
    began = rows[0]["stamp_s"] if rows else None
    for row in rows[:MAX_ROWS]:
        name = row["file"] if began is None else f"at {row['stamp_s'] - began:.3f} s"
        time = f"{row['time_s'] * 1e3:.1f}"
        if row["reason"]:
            table.add_row(name, f"{row['status']}: {row['reason']}", "", "", "", "", time)
            continue
        steps = np.diff(np.array(row["thread_m"] or []).reshape(-1, 2), axis=0)
        length = 1e3 * float(np.hypot(steps[:, 0], steps[:, 1]).sum())
        heading, confidence = row["heading_rad"], row["confidence"]
        table.add_row(
            name,
            row["status"],
            ", ".join(f"{1e3 * value:.2f}" for value in row["tail_m"] or []),
            "" if heading is None else f"{math.degrees(heading):.1f}",
            "" if row["thread_m"] is None else f"{length:.1f}",
            "" if confidence is None else f"{confidence:.2f}",
            time,
        )
    if len(rows) > MAX_ROWS:
        table.add_row(f"and {len(rows) - MAX_ROWS} more", "", "", "", "", "", "")
    return table


def track_lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return a summary as text."""
    import numpy as np

    if not rows:
        return ["no frames"]
    counts = Counter(row["status"] for row in rows)
    times = np.array([row["time_s"] for row in rows]) * 1e3
    found = ", ".join(f"{count} {status}" for status, count in counts.most_common())
    return [f"{found}; {np.median(times):.1f} ms a frame in the median, {np.percentile(times, 95):.1f} ms in the 95th"]
