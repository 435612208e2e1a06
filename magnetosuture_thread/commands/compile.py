"""The command `magnetosuture compile`."""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Callable

from magnetosuture_thread.coils.coil_system import CoilSystem
from magnetosuture_thread.coils.needle_motion import NeedleKinematics
from magnetosuture_thread.commands.command import Terminal
from magnetosuture_thread.estimator.thread_session import ThreadSession
from magnetosuture_thread.forecast.forecaster import make_forecaster
from magnetosuture_thread.forecast.published import PublishedForecasts
from magnetosuture_thread.geometry.compiled import compilations
from magnetosuture_thread.planning.session import compile_planning
from magnetosuture_thread.rig.rig import Rig
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.vision.tracker import warm_up


def add(parser: argparse.ArgumentParser) -> None:
    """Add no arguments."""


def run_compile(options: argparse.Namespace, terminal: Terminal) -> None:
    """Compile the functions that every node runs, so that nodes start at once.

    Compiled functions are cached beside the installed package, or in the user's cache where that cannot be written. A
    node compiles what the cache does not have when it first starts on a machine; this does it for all nodes beforehand,
    after an installation or an update.
    """
    began = time.perf_counter()
    steps = kernel_steps()
    gc.disable()  # a tenth of the time: the compiler makes millions of objects, and few in circles
    try:
        for number, (name, load) in enumerate(steps.items(), 1):
            started, before = time.perf_counter(), compilations()
            load()
            what = "compiled" if compilations() > before else "cached"
            terminal.print(f"{number} of {len(steps)}  {name}: {what}, {time.perf_counter() - started:.0f} s")
    finally:
        gc.enable()
    terminal.print(f"all functions are compiled, {time.perf_counter() - began:.0f} s")


def kernel_steps() -> dict[str, Callable[[], object]]:
    """Return what loads the compiled functions of each part, in the order in which they build on each other."""
    setup = read_setup("petri_35mm_polyamide_post")  # has a shape, so that contact is compiled too
    return {
        "thread model": lambda: ThreadSession(setup.model, setup.scene),
        "tracker": warm_up,
        "safety filter and coil bridge": CoilSystem,
        "needle's plan": lambda: PublishedForecasts(NeedleKinematics(0.0)),
        "forecast": lambda: make_forecaster(setup.model, setup.scene).warm_up(),
        "planner": compile_planning,
        "simulated rig": lambda: Rig(setup.rig, setup.scene).warm_up(),
    }
