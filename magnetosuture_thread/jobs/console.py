"""The job `magnetosuture console`: the operator's page, and the graph behind it."""

from __future__ import annotations

import asyncio
import signal
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from magnetosuture_thread.configuration import from_mapping, to_mapping
from magnetosuture_thread.console.server import ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.jobs.playing import MIN_LOOP_DURATION, Playing
from magnetosuture_thread.jobs.replay_inputs import DEFAULT_SETUP, opened
from magnetosuture_thread.jobs.simulate import Log
from magnetosuture_thread.resources import share_directory
from magnetosuture_thread.setups import read_setup

if TYPE_CHECKING:
    from magnetosuture_thread.jobs.console_hosts import RecordingHost
    from magnetosuture_thread.nodes.console_graph import ConsoleGraph

LOOK = 0.2  # s between two looks at the nodes


def console(
    scenario: str = "",
    *,
    running: bool = False,
    bag: Path | None = None,
    recordings: Path,
    address: str | None = None,
    port: int | None = None,
    token: str | None = None,
    log: Log = lambda text: None,
) -> None:
    """Serve the operator's page until this process is asked to end, by SIGINT, SIGTERM or SIGHUP.

    Args:
        scenario: name or path of a set-up; where it is empty, that which the bag names, or the default.
        running: whether the page is served on the graph of the ROS domain that the environment names; else around a
            simulated rig.
        bag: to play through the nodes in its place.
        recordings: folder that gets a bag for each recording.
        address: that the page is served on; the set-up's if None.
        port: of it; the set-up's if None.
        token: that commands need; the set-up's if None.
        log: called with a line for a person at each stage.

    Raises:
        BagError: the bag cannot be used.
        ConfigurationError: the set-up or an option cannot be used.
        GraphError: a node ended or did not come.
    """
    asked = {"address": address, "port": port, "token": token}
    given = {name: value for name, value in asked.items() if value is not None}
    with ExitStack() as stack:
        if running:
            graph, host = _running(stack, scenario, given, recordings, log)
        elif bag is not None:
            graph, host = _replayed(stack, scenario, given, bag, log)
        else:
            graph, host = _simulated(stack, scenario, given, recordings, log)
        asyncio.run(_serve(graph, host, log))


def _running(
    stack: ExitStack, scenario: str, given: dict[str, str | int], recordings: Path, log: Log
) -> tuple[ConsoleGraph, RecordingHost]:
    """Join the graph that runs."""
    # Only here, where it is needed: without ROS the other commands still work.
    from magnetosuture_thread.jobs.console_hosts import RecordingHost
    from magnetosuture_thread.nodes.console_graph import ConsoleGraph
    from magnetosuture_thread.nodes.console_host import joined

    setup = read_setup(scenario or DEFAULT_SETUP)
    graph = ConsoleGraph(stack.enter_context(joined()), _settings(setup.console, given))
    return graph, RecordingHost(graph, setup, recordings, log)


def _simulated(
    stack: ExitStack, scenario: str, given: dict[str, str | int], recordings: Path, log: Log
) -> tuple[ConsoleGraph, RecordingHost]:
    """Start the whole graph around a simulated rig."""
    from magnetosuture_thread.jobs.console_hosts import SimulatedHost
    from magnetosuture_thread.nodes.console_graph import ConsoleGraph
    from magnetosuture_thread.nodes.console_host import joined

    name = scenario or DEFAULT_SETUP
    settings = _settings(read_setup(name).console, given)
    shipped = sorted(path.stem for path in (share_directory("magnetosuture_thread") / "config").glob("*.yaml"))
    domain, environment, logs = _alone(stack)
    graph = ConsoleGraph(stack.enter_context(joined(domain=domain)), settings)
    scenarios = dict.fromkeys([*shipped, name])
    host = SimulatedHost(graph, name, tuple(scenarios), environment, logs, recordings, log)
    log(f"starting the graph around a simulated rig (ROS domain {domain}, this machine only)")
    return graph, host


def _replayed(
    stack: ExitStack, scenario: str, given: dict[str, str | int], bag: Path, log: Log
) -> tuple[ConsoleGraph, RecordingHost]:
    """Play a bag through the nodes."""
    from magnetosuture_thread.jobs.console_replay import ReplayHost
    from magnetosuture_thread.nodes.console_graph import ConsoleGraph
    from magnetosuture_thread.nodes.console_host import joined

    played = stack.enter_context(
        opened(bag, setup_name=scenario, source="auto", start=0.0, duration=None, remap={}, frame="dish", log=log)
    )
    if played.duration < MIN_LOOP_DURATION:
        words = f"gives {played.duration:.2f} s to play over and over; expected {MIN_LOOP_DURATION:g} s or more"
        raise BagError(bag, words)
    playing = Playing(played)
    settings = _settings(played.setup.console, given)
    if playing.transport:
        settings = replace(settings, image_transport=playing.transport)
    domain, environment, logs = _alone(stack)
    node = stack.enter_context(joined(domain=domain, simulated_clock=True))
    graph = ConsoleGraph(node, settings)
    host = ReplayHost(graph, playing, domain, environment, logs, log)
    log(f"starting {', '.join(playing.nodes)} (ROS domain {domain}, this machine only)")
    return graph, host


def _alone(stack: ExitStack) -> tuple[int, dict[str, str], Path]:
    """Return a ROS domain for this command alone, the environment for its nodes, and a folder for their logs."""
    from magnetosuture_thread.nodes.processes import environment_of, graph_environment, reserved_domain

    domain = stack.enter_context(reserved_domain())
    environment = graph_environment(domain)
    stack.enter_context(environment_of(environment))
    return domain, environment, Path(stack.enter_context(TemporaryDirectory()))


def _settings(settings: ConsoleSettings, given: dict[str, str | int]) -> ConsoleSettings:
    return from_mapping(ConsoleSettings, {**to_mapping(settings), **given})


async def _serve(graph: ConsoleGraph, host: RecordingHost, log: Log) -> None:
    """Serve the page until somebody asks this process to end, or the graph breaks."""
    loop, asked = asyncio.get_running_loop(), asyncio.Event()
    for which in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(which) is not signal.SIG_IGN:
            loop.add_signal_handler(which, asked.set)
    try:
        host.start()
        server = ConsoleServer(graph.settings, graph, host)
        log(f"open {await server.start()}")
        log("Ctrl-C ends everything")
        try:
            while not asked.is_set():
                await host.watch()
                try:
                    await asyncio.wait_for(asked.wait(), LOOK)
                except asyncio.TimeoutError:
                    continue
        finally:
            await server.stop()
    finally:
        await host.close()
    log("ended")
