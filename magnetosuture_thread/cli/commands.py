"""What each command does; a command's own packages are imported when it runs, so that --help is quick."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

DONE = 0


def replay(options: argparse.Namespace) -> int:
    """Play a bag through the live graph."""
    from magnetosuture_thread.jobs.replay import replay as play
    from magnetosuture_thread.study.table import summary_table

    console = Console(highlight=False)
    with _progress(console, "replay") as progress:
        summary = play(
            options.bag,
            options.output,
            setup_name=options.setup,
            rate=options.rate,
            say=_sayer(console),
            progress=progress,
        )
    console.print(summary_table(summary))
    console.print(f"results: {options.output}", soft_wrap=True, markup=False)
    return DONE


def record(options: argparse.Namespace) -> int:
    """Write a bag of simulated camera frames."""
    from magnetosuture_thread.jobs.record import record as write
    from magnetosuture_thread.setups import read_setup
    from magnetosuture_thread.study.reference import read_reference

    console = Console(highlight=False)
    setup = read_setup(options.setup)
    reference = read_reference(options.reference)
    with _progress(console, "record") as progress:
        frames = write(
            reference,
            setup,
            options.output,
            start=options.start,
            duration=options.duration,
            rate=options.rate,
            quality=options.quality,
            seed=options.seed,
            progress=progress,
        )
    console.print(f"{frames} simulated frames in {options.output}", soft_wrap=True, markup=False)
    return DONE


def simulate(options: argparse.Namespace) -> int:
    """Run the whole graph around a simulated rig."""
    from magnetosuture_thread.jobs.simulate import simulate as run
    from magnetosuture_thread.study.table import loop_table

    console = Console(highlight=False)
    say = _sayer(console)
    new = not options.output.exists()
    try:
        with _progress(console, "simulate") as progress:
            summary = run(
                options.scenario,
                options.output,
                duration=options.duration,
                pace=options.pace,
                boards=options.boards,
                say=say,
                progress=progress,
            )
    except KeyboardInterrupt:
        if new and options.output.exists():
            say(f"what was recorded is in {options.output}")
        raise
    console.print(loop_table(summary))
    say(f"bag: {options.output}")
    _write_json(options.json, json.dumps(summary.to_json(), indent=2, allow_nan=False))
    return DONE


def behaviour(options: argparse.Namespace) -> int:
    """Run the thread-behaviour tests."""
    from magnetosuture_thread.jobs.behaviour import behaviour as run
    from magnetosuture_thread.study.table import behaviour_table

    console = Console(highlight=False)
    with _progress(console, "behaviour") as progress:
        runs = run(
            options.output,
            say=_sayer(console),
            progress=progress,
        )
    console.print(behaviour_table(runs))
    console.print(f"results: {options.output}", soft_wrap=True, markup=False)
    return DONE


def evaluate(options: argparse.Namespace) -> int:
    """Score the model, or the simulated rig, on reference trajectories."""
    from magnetosuture_thread.jobs.rig import score_rig
    from magnetosuture_thread.study.course_picture import draw_course
    from magnetosuture_thread.study.evaluation import Course, find_references, score
    from magnetosuture_thread.study.table import evaluation_table

    console = Console(highlight=False)
    paths = find_references(options.folder)
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)

    name = "rig" if options.rig else options.formulation

    def keep(course: Course) -> None:
        if options.pictures:
            draw_course(options.pictures / f"{course.score.name}.png", course, name)

    with _progress(console, "evaluate") as progress:
        if options.rig:
            evaluation = score_rig(paths, options.segments, progress, keep)
        else:
            evaluation = score(
                paths,
                formulation=options.formulation,
                solver=options.solver,
                segments=options.segments,
                progress=progress,
                keep=keep,
            )
    console.print(evaluation_table(evaluation))
    _write_json(options.json, json.dumps(evaluation.to_mapping(), indent=2, allow_nan=False))
    return DONE


def track(options: argparse.Namespace) -> int:
    """Track the needle in camera frames."""
    from magnetosuture_thread.jobs.track import settings_with
    from magnetosuture_thread.jobs.track import track as follow
    from magnetosuture_thread.setups import read_setup
    from magnetosuture_thread.study.track_table import track_lines, track_table

    console = Console(highlight=False)
    settings = settings_with(read_setup(options.setup).vision, options.metres_per_pixel, options.centre)
    with _progress(console, "track") as progress:
        frames = follow(
            options.frames,
            settings,
            overlay=options.overlay,
            progress=progress,
        )
    rows = [frame.to_json() for frame in frames]
    console.print(track_table(rows))
    for line in track_lines(rows):
        console.print(line, soft_wrap=True, markup=False)
    _write_json(options.json, json.dumps(rows, indent=1, allow_nan=False))
    return DONE


def calibrate_camera(options: argparse.Namespace) -> int:
    """Find out where the dish is in the camera's image."""
    from magnetosuture_thread.jobs.calibrate_camera import calibrate_camera as calibrate

    console = Console(highlight=False)
    markers = tuple(options.markers) if options.markers else None
    found = calibrate(options.frames, options.dish_diameter, options.output, markers)
    u, v = found.view.centre_px
    scale, turned = found.view.metres_per_pixel * 1e3, found.view.rotation
    console.print(f"centre {u:.2f}, {v:.2f} px; {scale:.5f} mm a pixel; turned by {turned:.4f} rad", soft_wrap=True)
    by = f"markers, residual {found.residual_px:.2f} px" if markers else "the dish's rim"
    console.print(f"by {by}; {found.frames} frames, scatter {found.scatter_px:.2f} px", soft_wrap=True)
    console.print(f"parameters: {options.output}", soft_wrap=True, markup=False)
    return DONE


def calibrate_coils(options: argparse.Namespace) -> int:
    """Find the coils' properties from probe measurements."""
    from magnetosuture_thread.jobs.calibrate_coils import calibrate_coils as calibrate
    from magnetosuture_thread.study.coil_table import coil_lines, coil_table

    console = Console(highlight=False)
    found = calibrate(options.measurements, options.output, options.model, options.name).to_json()
    console.print(coil_table(found))
    for line in coil_lines(found):
        console.print(line, soft_wrap=True, markup=False)
    console.print(f"calibration: {options.output}", soft_wrap=True, markup=False)
    return DONE


def coils(options: argparse.Namespace) -> int:
    """Press a switch of the running coil bridge."""
    from magnetosuture_thread.jobs.coils import coils as press

    console = Console(highlight=False)
    state = press(options.action)
    width = max(len(name) for name in state)
    for name, value in state.items():
        console.print(f"{name:{width}}  {value}", soft_wrap=True, markup=False)
    return DONE


def bench(options: argparse.Namespace) -> int:
    """Time the model, or the coil bridge."""
    if options.bridge:
        return _bench_bridge(options)
    from magnetosuture_thread.study.bench.run import bench as measure
    from magnetosuture_thread.study.bench.table import bench_lines, bench_table

    console = Console(highlight=False)
    with _progress(console, "bench") as progress:
        report = measure(peers=options.peers, progress=progress)
    console.print(bench_table(report))
    for line in bench_lines(report):
        console.print(line, soft_wrap=True, markup=False)
    _write_json(options.json, report.to_json())
    return DONE


def _bench_bridge(options: argparse.Namespace) -> int:
    from magnetosuture_thread.jobs.bench_bridge import bench_bridge
    from magnetosuture_thread.study.bridge_report import bridge_table

    console = Console(highlight=False)
    with _progress(console, "bench") as progress:
        report = bench_bridge(options.trials, options.kills, options.hostile, say=_sayer(console), progress=progress)
    console.print(bridge_table(report))
    _write_json(options.json, json.dumps(report.to_json(), indent=2, allow_nan=False))
    return DONE


def _write_json(path: Path | None, text: str) -> None:
    if path:
        path.write_text(text.rstrip() + "\n")


def _sayer(console: Console) -> Callable[[str], None]:
    """Return what prints a line as it is, however long."""
    return lambda text: console.print(text, soft_wrap=True, markup=False)


@contextmanager
def _progress(console: Console, name: str) -> Iterator[Callable[[float], None]]:
    """Show a bar, and give what sets the share done, 0 to 1."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(name, total=1.0)
        yield lambda share: bar.update(task, completed=share)
