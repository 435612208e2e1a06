"""What each command does; a command's own packages are imported when it runs, so that --help is quick."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

DONE = 0


def replay(options: argparse.Namespace) -> int:
    """Play a bag through the live graph."""
    from magnetosuture_thread.jobs.replay import replay as play
    from magnetosuture_thread.study.table import summary_table

    console = Console(highlight=False)
    with _progress(console) as progress:
        task = progress.add_task("replay", total=1.0)
        summary = play(
            options.bag,
            options.output,
            setup_name=options.setup,
            rate=options.rate,
            say=lambda text: console.print(text, soft_wrap=True, markup=False),
            progress=lambda share: progress.update(task, completed=share),
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
    with _progress(console) as progress:
        task = progress.add_task("record", total=1.0)
        frames = write(
            reference,
            setup,
            options.output,
            start=options.start,
            duration=options.duration,
            rate=options.rate,
            quality=options.quality,
            seed=options.seed,
            progress=lambda share: progress.update(task, completed=share),
        )
    console.print(f"{frames} simulated frames in {options.output}", soft_wrap=True, markup=False)
    return DONE


def evaluate(options: argparse.Namespace) -> int:
    """Score the model on reference trajectories."""
    from magnetosuture_thread.study.course_picture import draw_course
    from magnetosuture_thread.study.evaluation import Course, find_references, score
    from magnetosuture_thread.study.table import evaluation_table

    console = Console(highlight=False)
    paths = find_references(options.folder)
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)

    def keep(course: Course) -> None:
        if options.pictures:
            draw_course(options.pictures / f"{course.score.name}.png", course, options.formulation)

    with _progress(console) as progress:
        task = progress.add_task("evaluate", total=1.0)
        evaluation = score(
            paths,
            formulation=options.formulation,
            solver=options.solver,
            segments=options.segments,
            progress=lambda share: progress.update(task, completed=share),
            keep=keep,
        )
    console.print(evaluation_table(evaluation))
    _write_json(options.json, json.dumps(evaluation.to_mapping(), indent=2, allow_nan=False))
    return DONE


def bench(options: argparse.Namespace) -> int:
    """Time the model."""
    from magnetosuture_thread.study.bench.run import bench as measure
    from magnetosuture_thread.study.bench.table import bench_lines, bench_table

    console = Console(highlight=False)
    with _progress(console) as progress:
        task = progress.add_task("bench", total=1.0)
        report = measure(peers=options.peers, progress=lambda share: progress.update(task, completed=share))
    console.print(bench_table(report))
    for line in bench_lines(report):
        console.print(line, soft_wrap=True, markup=False)
    _write_json(options.json, report.to_json())
    return DONE


def _write_json(path: Path | None, text: str) -> None:
    if path:
        path.write_text(text.rstrip() + "\n")


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    )
