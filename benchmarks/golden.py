"""Record what the package computes and offers, to compare two versions of it.

    python -m benchmarks golden record DIR --reference FOLDER [--seeds N] [--only PART ...]
    python -m benchmarks golden compare OLD NEW

Parts: `bags` (poses, predictions, estimates and margins of the example bags, replayed offline), `reference` (scores on
reference trajectories), `procedures` (outcomes of each procedure's first seeds, and all outputs of seed 0), `forecast`,
`pages` (the generated reference: topics, services, parameters, commands, Python names). It uses the command line and
the public Python names only, so that one version of it serves both versions of the package. Simulated.
"""

from __future__ import annotations

import argparse
import difflib
import json
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader

from magnetosuture_thread import (
    Disc,
    ForecastStart,
    NeedlePose,
    NeedleSafetyFilter,
    Scene,
    ThreadForecaster,
    ThreadPredictor,
)
from magnetosuture_thread.commands.command import Terminal

PROCEDURES = ("dead_end", "figure_eight", "hernia", "slalom", "wrap_and_tighten")
TOLERANCE = 1e-7  # m, rad or of the value itself
# Of the machine, and not compared.
TIMES = (
    *("step_time", "step_median", "step_p99", "solve_time", "wall", "speed", "seconds", "latency", "duration"),
    "tracker",
)


def _run(*arguments: object) -> None:
    """Run a command of the package."""
    subprocess.run([sys.executable, "-m", "magnetosuture_thread.cli", *map(str, arguments)], check=True)


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the plain values of a message or JSON document by path; entries of a message's list have one path."""
    if is_dataclass(value):
        for field in fields(value):
            if not (field.name.startswith("__") or any(word in field.name for word in TIMES)):
                yield from _leaves(getattr(value, field.name), f"{name}.{field.name}")
    elif isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(item, f"{name}.{key}")
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from _leaves(item, name if is_dataclass(item) else f"{name}[{index}]")
    else:
        yield name, value


def _save_bag(folder: Path, target: Path) -> None:
    """Save the numbers of a bag's messages by topic and field."""
    values = defaultdict[str, list[Any]](list)
    with AnyReader([folder]) as reader:
        for connection, stamp, data in reader.messages():
            if connection.msgtype.endswith(("Image", "CompressedImage")):
                continue
            values[f"{connection.topic} stamp"].append([stamp])
            for name, value in _leaves(reader.deserialize(data, connection.msgtype), connection.topic):
                if np.asarray(value).dtype.kind in "bifu":
                    values[name].append(np.atleast_1d(value))
    arrays: dict[str, Any] = {
        name.replace("/", "|"): np.concatenate(parts).astype(np.float64) for name, parts in values.items()
    }
    np.savez_compressed(target, **arrays)


def _record_bags(folder: Path, _: argparse.Namespace) -> None:
    bag = Path("examples/post_wrap")
    _run("replay", bag, "--offline", "--output", folder / "replay")
    _save_bag(folder / "replay/bag", folder / "replay.npz")
    _run("evaluate", bag, "--output", folder / "evaluation")
    _run("reproduce", "hernia", "examples/hernia_steering", "--output", folder / "hernia")


def _record_reference(folder: Path, options: argparse.Namespace) -> None:
    for formulation in ("rod", "paper") if options.reference else ():
        _run("evaluate", options.reference, "--formulation", formulation, "--json", folder / f"{formulation}.json")


def _record_procedures(folder: Path, options: argparse.Namespace) -> None:
    for name in PROCEDURES:
        _run("campaign", name, "--seeds", options.seeds, "--bags", 0, "--workers", 2, "--output", folder / name)
        _save_bag(folder / name / "bags/seed_0", folder / f"{name}.npz")


def _record_forecast(folder: Path, _: argparse.Namespace) -> None:
    """Save a thread that is drawn around a post, its margins, and forecasts under a command that is held."""
    scene = Scene.create(dish_diameter=0.035, shapes={"post": Disc((0.0, 0.0), 0.0025)})
    predictor = ThreadPredictor.create("polyamide_7_0", length=0.019, segments=40, scene=scene)
    safety = NeedleSafetyFilter(scene, needle_length=0.004, needle_curvature=60.0, max_speed=0.008, hold_time=0.15)
    forecaster = ThreadForecaster(predictor.thread, scene, safety)
    predictor.start(NeedlePose(0.0, np.array([-0.001, 0.0054]), np.array([1.0, 0.0])))
    vertices, margins, forecasts = [], [], []
    for step in range(1, 150):
        angle = 0.5 * np.pi - 0.03 * step
        tail, heading = 0.0056 * np.array([np.cos(angle), np.sin(angle)]), np.array([np.sin(angle), -np.cos(angle)])
        pose = NeedlePose(step / 30.0, tail, heading)
        prediction = predictor.step(pose)
        vertices.append(prediction.positions)
        margins.append(prediction.margins["obstacle"].minimum)
        for command in ((0.005, 0.0), (0.0, -0.006)) if step % 30 == 0 else ():
            start = ForecastStart(pose, prediction.positions)
            forecasts.append(forecaster.forecast(start, np.array(command), 2.0).vertices)
    np.savez_compressed(folder / "post.npz", vertices=vertices, margins=margins, forecasts=np.array(forecasts))


def _record_pages(folder: Path, _: argparse.Namespace) -> None:
    subprocess.run([sys.executable, "-m", "sphinx", "-q", "-b", "text", "docs", str(folder)], check=True)


PARTS = {
    "bags": _record_bags,
    "reference": _record_reference,
    "procedures": _record_procedures,
    "forecast": _record_forecast,
    "pages": _record_pages,
}


def _values(path: Path) -> dict[str, Any]:
    """Return the arrays of an .npz file, or the plain values of a JSON document, by name."""
    if path.suffix == ".json":
        leaves = _leaves(json.loads(path.read_text()))
        return {name: value for name, value in leaves if not any(word in name for word in TIMES)}
    with np.load(path) as saved:
        return dict(saved)


def _differences(old: Path, new: Path) -> Iterator[str]:
    """Yield how two files differ."""
    if not new.exists():
        yield "gone"
    elif old.suffix == ".txt":
        a, b = (path.read_text().splitlines() for path in (old, new))
        yield from list(difflib.unified_diff(a, b, lineterm="", n=0))[2:]
    else:
        before, after = _values(old), _values(new)
        for name in sorted(before.keys() | after.keys()):
            if name not in before or name not in after:
                yield f"{name}: {'gone' if name in before else 'new'}"
                continue
            a, b = before[name], after[name]
            is_number = all(np.asarray(value).dtype.kind in "bif" for value in (a, b))
            if np.shape(a) != np.shape(b):
                yield f"{name}: {len(a)} values, {len(b)} now"
            elif is_number and not np.allclose(a, b, rtol=TOLERANCE, atol=TOLERANCE, equal_nan=True):
                yield f"{name}: differs by {np.nanmax(np.abs(np.subtract(a, b, dtype=float))):.3g}"
            elif not is_number and a != b:
                yield f"{name}: {a!r}, {b!r} now"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the benchmark's options."""
    actions = parser.add_subparsers(dest="action", required=True)
    record, compare = actions.add_parser("record"), actions.add_parser("compare")
    record.add_argument("folder", type=Path)
    record.add_argument("--reference", type=Path, help="a folder of reference trajectories")
    record.add_argument("--seeds", type=int, default=5)
    record.add_argument("--only", nargs="+", choices=sorted(PARTS), default=sorted(PARTS))
    for name in ("old", "new"):
        compare.add_argument(name, type=Path)


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Record or compare."""
    if options.action == "record":
        for part in options.only:
            (options.folder / part).mkdir(parents=True)
            PARTS[part](options.folder / part, options)
        return {}, True
    count = 0
    for path in sorted(p for p in options.old.rglob("*") if p.suffix in (".npz", ".json", ".txt")):
        name = path.relative_to(options.old)
        for line in _differences(path, options.new / name):
            terminal.print(f"{name}: {line}", soft_wrap=True, markup=False)
            count += 1
    terminal.print(f"{count} differences")
    return {"differences": count}, count == 0
