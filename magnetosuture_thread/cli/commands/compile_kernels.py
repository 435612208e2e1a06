"""The command `magnetosuture compile`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

from magnetosuture_thread.cli.arguments import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console

SETUP = "petri_35mm_polyamide_post"  # has a shape, so that contact is compiled too


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    command(subparsers, "compile", run_compile)


def run_compile(options: argparse.Namespace) -> int:
    """Compile the functions that every node runs, so that nodes start at once.

    Compiled functions are cached beside the installed package, or in the user's cache where that cannot be written. A
    node compiles what the cache does not have when it first starts on a machine; this does it for all nodes beforehand,
    after an installation or an update.
    """
    from magnetosuture_thread.compiled import compilations

    console, began = make_console(), time.perf_counter()
    steps = kernel_steps()
    for number, (name, load) in enumerate(steps.items(), 1):
        started, before = time.perf_counter(), compilations()
        load()
        what = "compiled" if compilations() > before else "cached"
        console.print(f"{number} of {len(steps)}  {name}: {what}, {time.perf_counter() - started:.0f} s")
    console.print(f"all functions are compiled, {time.perf_counter() - began:.0f} s")
    return DONE


def kernel_steps() -> dict[str, Callable[[], object]]:
    """Return what loads the compiled functions of each part, in the order in which they build on each other."""
    from magnetosuture_thread.coils.coil_system import CoilSystem
    from magnetosuture_thread.forecast import make_forecaster
    from magnetosuture_thread.planning.session import compile_planning
    from magnetosuture_thread.rig.rig import Rig
    from magnetosuture_thread.setups import read_setup
    from magnetosuture_thread.thread_model.session import ThreadSession
    from magnetosuture_thread.vision.tracker import warm_up

    setup = read_setup(SETUP)
    return {
        "thread model": lambda: ThreadSession(setup.model, setup.scene),
        "tracker": warm_up,
        "safety filter and coil bridge": CoilSystem,
        "forecast": lambda: make_forecaster(setup.model, setup.scene).warm_up(),
        "planner": compile_planning,
        "simulated rig": lambda: Rig(setup.rig, setup.scene).warm_up(),
    }
