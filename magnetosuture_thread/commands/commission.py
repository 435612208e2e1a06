"""The commands `magnetosuture commission` and `commission-thread`: a rig measures itself by its own camera."""

from __future__ import annotations

import argparse
import datetime
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.calibration import commission_files as files
from magnetosuture_thread.calibration.commission import Commissioning
from magnetosuture_thread.calibration.simulated_bench import SimulatedBench
from magnetosuture_thread.calibration.simulated_thread import SimulatedThreadBench
from magnetosuture_thread.calibration.thread_step import (
    ThreadBench,
    ThreadCommissioning,
    read_commissioned,
)
from magnetosuture_thread.commands import command
from magnetosuture_thread.evaluation.recorded import SETUP_NOTE
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.rig.truth import with_rig
from magnetosuture_thread.settings.configuration import read_yaml
from magnetosuture_thread.settings.errors import BagError

DRAWN = "poses drawn with a tracker's noise"


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    option("setup", metavar="SETUP", help="what is believed of the rig: a setup's name or YAML file")
    option("--output", type=Path, required=True, metavar="DIR", help="folder to make, or to go on in")
    bench = parser.add_mutually_exclusive_group()
    bench.add_argument("--live", action="store_true", help="the rig that runs on this ROS domain")
    command.add_rig(bench)
    option("--namespace", type=command.namespace_argument, default="", metavar="NAME", help="of a rig that runs")
    option(
        "--drawn-poses", action="store_true", help="do not render frames: poses are the truth with a tracker's noise"
    )
    option("--check", action="store_true", help="say whether the rig is still the one that was measured in DIR")
    option("--seed", type=command.whole_number, default=0, help="of the needle's start and the pulses (default: 0)")


def run_commission(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Let a rig measure itself: coils, needle, delay.

    A bare needle lies in the empty dish. Each coil alone moves it, from 10 mA on; then pulses that tell most; then
    twelve that are predicted and not fitted, and a slow square, by which the verdict is.

    With --live the rig is the one that runs on this ROS domain: its bridge was started with
    coil_bridge.commissioning:=true, and SETUP is what its nodes were started with. This command arms it, and checks
    with the first currents that move the needle that emergency stop, lost poses and a bridge that stands still end
    them. Keep a hand on the switch of the supply. Without it the rig is simulated, that of --rig, which SETUP knows
    nothing of, without ROS.

    DIR gets
      setup.yaml     SETUP with what was found, if the verification passed; coils.yaml, which it names
      summary.json   verdict, values with their intervals, and what is not as SETUP says
      report.pdf     the same on one page
      pulses/NNN     a bag of each pulse: currents and poses
    Ctrl-C ends a pulse with zero currents. The same command goes on where it was interrupted. With --check one pulse a
    coil is compared with what was measured in DIR; no stop is checked before, and nothing is written.
    """
    folder: Path = options.output
    if options.check:
        return _check(options, terminal)
    if (folder / files.SUMMARY_FILE).exists():
        raise BagError(folder, "holds a finished commissioning; choose another folder")
    setup = read_setup(options.setup)
    notes = {"setup": setup.name, SETUP_NOTE: setup.path.read_text(encoding="utf-8"), "seed": str(options.seed)}
    poses = DRAWN if options.drawn_poses else "poses tracked in rendered frames"
    notes["rig"] = "a rig that runs" if options.live else poses
    if not options.live:
        notes["simulated"] = f"the rig {options.rig or 'of the setup'}, {poses}"
    with _bench(setup, options) as (driven_bench, check):
        how: dict[str, Any] = {"simulated": not options.live, "poses": notes["rig"], "rig": options.rig or setup.name}
        stops = folder / files.STOPS_FILE
        bench = files.RecordedBench(driven_bench, folder / files.PULSES, notes)
        first = {"check_stops": partial(files.checked_stops, driven_bench, stops, terminal.log)} if options.live else {}
        radius = setup.scene.dish.radius
        result = Commissioning(bench, setup.coils, radius, terminal.log, options.seed, check=check, **first).run()
        result = files.verify_square(result, setup, driven_bench.follow_square)
    if bench.reused:
        terminal.log(f"{bench.reused} pulses were there from a run before")
    how["rig_time"] = sum(float(pulse.times[-1] - pulse.on) for pulse in result.pulses)
    if stops.exists():
        how["stops"] = files.read_stops(stops)
    from magnetosuture_thread.calibration.commission_report import write_results  # late, as it imports matplotlib

    summary = write_results(folder, result, setup, how, datetime.date.today().isoformat())
    if result.model is not None:
        rows = [
            (value.name, *_cells(value.value, value.interval, value.before), value.unit, value.kind)
            for value in files.values_of(result, setup.coils)
        ]
        columns = ("value", "found", "95 % ±", "setup", "unit", "known by")
        title = f"{setup.name} as measured" + (" (simulated)" if how["simulated"] else "")
        terminal.print(command.make_table(title, columns, rows))
    for finding in (*result.findings, *result.failures):
        terminal.log(finding)
    terminal.log(f"verdict: {summary['verdict']}; {folder / files.REPORT_FILE}")
    if not result.failures:
        terminal.log(f"setup: {folder / files.SETUP_FILE}")
    return command.FAILED if result.failures else command.DONE


@contextmanager
def _bench(setup: Setup, options: argparse.Namespace) -> Iterator[tuple[Any, Callable[[], None]]]:
    """Yield the bench of the options, and what raises an interruption that is kept."""
    if not options.live:
        rig = with_rig(setup, options.rig)
        yield SimulatedBench(rig, drawn=options.drawn_poses, seed=options.seed), lambda: None
        return
    from magnetosuture_thread.nodes.live_bench import LiveBench  # late, as it needs ROS
    from magnetosuture_thread.nodes.processes import Interruption

    with Interruption() as interruption, LiveBench(setup, interruption.check, options.namespace) as live:
        yield live, interruption.check


def _check(options: argparse.Namespace, terminal: command.Terminal) -> int:
    setup = read_setup(options.setup)
    rig = files.read_rig(options.output, setup.coils)
    with _bench(setup, options) as (bench, check):
        radius = setup.scene.dish.radius
        commissioning = Commissioning(bench, setup.coils, radius, terminal.log, options.seed, check=check)
        changed = commissioning.check(rig)
    for words in changed or ["the rig is still the one that was measured"]:
        terminal.log(words)
    return command.FAILED if changed else command.DONE


def add_thread(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    option("folder", type=Path, metavar="DIR", help="of a commissioning that passed, on the same rig")
    option("--live", action="store_true", help="the rig that runs on this ROS domain, with DIR/setup.yaml")
    option("--namespace", type=command.namespace_argument, default="", metavar="NAME", help="of a rig that runs")
    option("--seed", type=command.whole_number, default=0, help="of a simulated tracker's noise (default: 0)")


def run_commission_thread(options: argparse.Namespace, terminal: command.Terminal) -> int:
    """Measure the thread of a rig that was commissioned.

    The thread is tied to the needle, in the empty dish. The needle draws it through straight pulls and turns, to which
    the thread's parameters are fitted as by calibrate. The force of the coils in the pulls, less what the bare needle
    took, is the thread's drag. With what was found, the thread of other pulls is predicted, and a square followed.

    With --live the rig is the one that runs on this ROS domain with DIR/setup.yaml, in a dish without shapes. This
    command arms it; keep a hand on the switch of the supply. Without it the rig is simulated as that of DIR was.

    DIR gets
      thread.yaml    the thread's parameters, for thread_model, and
      setup.yaml     is changed by them, thread_drag, needle_drag and max_pull: both only if the verification passed
      summary.json   in it, verdict, limits and values of the thread with their intervals
      thread.pdf     the same on one page, with the error of the prediction; a run that is refused after one that
                     passed has thread_refused.pdf, and thread_refused in summary.json
      thread/NNN     a bag of each run, numbered on
    """
    folder: Path = options.folder
    setup, _ = read_commissioned(folder)
    summary = read_yaml(folder / files.SUMMARY_FILE, "summary of a commissioning")
    with _thread_bench(setup, summary, options) as bench:
        result = ThreadCommissioning(folder, bench, terminal.log).run()
    from magnetosuture_thread.calibration.thread_report import write_thread  # late, as it imports matplotlib

    part = write_thread(folder, result, setup, datetime.date.today().isoformat())
    rows = [
        (value.name, *_cells(value.value, value.interval, value.before), value.unit, value.kind)
        for value in result.values
    ]
    columns, title = ("value", "found", "95 % ±", "before", "unit", "known by"), f"thread of {summary['setup']}"
    if rows:
        terminal.print(command.make_table(title + ("" if options.live else " (simulated)"), columns, rows))
    for line in (*part.get("warnings", ()), *result.failures):
        terminal.log(line)
    if result.prediction is not None and (errors := result.prediction.after["seen"]):
        figures = f"mean {errors['mean']:.3g}, maximum {errors['maximum']:.3g} % of the length"
        terminal.log(f"prediction of the run that was not fitted: {figures}")
    terminal.log(f"verdict: {part['verdict']}; {folder / part['page']}")
    return command.FAILED if result.failures else command.DONE


@contextmanager
def _thread_bench(setup: Setup, summary: dict[str, Any], options: argparse.Namespace) -> Iterator[ThreadBench]:
    """Yield the bench of the options."""
    if not options.live:
        if not summary["simulated"]:
            raise ConfigurationError("simulated", False, "true; for a rig that runs, --live", str(options.folder))
        rig = "" if summary["rig"] == summary["setup"] else summary["rig"]
        yield SimulatedThreadBench(with_rig(setup, rig), drawn=summary["poses"] == DRAWN, seed=options.seed)
        return
    from magnetosuture_thread.nodes.live_bench import LiveThreadBench  # late, as it needs ROS
    from magnetosuture_thread.nodes.processes import Interruption

    with Interruption() as interruption, LiveThreadBench(setup, interruption.check, options.namespace) as live:
        yield live


def _cells(*numbers: float) -> list[str]:
    return ["" if math.isnan(number) else f"{np.float64(number):.4g}" for number in numbers]
