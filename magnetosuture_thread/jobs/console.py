"""The job `magnetosuture console`: the operator's page, and the graph behind it. It needs ROS."""

from __future__ import annotations

import asyncio
import signal
import threading
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from magnetosuture_thread.configuration import from_mapping, to_mapping
from magnetosuture_thread.console.server import ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.jobs.console_hosts import RecordingHost, SimulatedHost
from magnetosuture_thread.jobs.replay import GraphInput, live_replay
from magnetosuture_thread.jobs.replay_inputs import DEFAULT_SETUP, Log, open_bag
from magnetosuture_thread.nodes.console.graph import ConsoleGraph
from magnetosuture_thread.nodes.console.node import joined
from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment, reserved_domain
from magnetosuture_thread.resources import share_directory
from magnetosuture_thread.setups import Setup, read_setup

POLL_PERIOD = 0.2  # s between two checks of the nodes
REPLAY_BLOCKED = "this is a replay: nothing can be jogged or armed"


def console(
    setup_name: str = "",
    *,
    running: bool = False,
    namespace: str = "",
    bag: Path | None = None,
    recordings: Path,
    address: str | None = None,
    port: int | None = None,
    token: str | None = None,
    certificate: str | None = None,
    private_key: str | None = None,
    origin: str | None = None,
    log: Log = lambda text: None,
) -> None:
    """Serve the operator's page until this process gets SIGINT, SIGTERM or SIGHUP.

    Args:
        setup_name: name or path of a setup; where it is empty, that which the bag names, or the default.
        running: whether the page is served on the graph of the ROS domain that the environment names; else around a
            simulated rig.
        namespace: of the running graph, where it is in one.
        bag: to play through the nodes in its place.
        recordings: folder that gets a bag for each recording.
        address: that the page is served on; the setup's if None.
        port: of it; the setup's if None.
        token: that commands need; the setup's if None.
        certificate: file of the certificate to serve over TLS; the setup's if None.
        private_key: file of its key; the setup's if None.
        origin: under which browsers reach the page besides; the setup's if None.
        log: called with a line for a person at each stage.

    Raises:
        BagError: the bag cannot be used.
        ConfigurationError: the setup or an option cannot be used.
        GraphError: a node ended or did not come.
    """
    options = {"address": address, "port": port, "token": token}
    options |= {"certificate": certificate, "private_key": private_key, "origin": origin}
    given = {name: value for name, value in options.items() if value is not None}

    def settings(setup: Setup) -> ConsoleSettings:
        return from_mapping(ConsoleSettings, {**to_mapping(setup.console), **given})

    name = setup_name or DEFAULT_SETUP
    host: RecordingHost
    with ExitStack() as stack:
        if running:
            setup = read_setup(name)
            graph = ConsoleGraph(stack.enter_context(joined(namespace=namespace)), settings(setup))
            host = RecordingHost(graph, setup, recordings, log)
        elif bag is not None:
            replayed = stack.enter_context(open_bag(bag, log, setup_name=setup_name))
            replayed.check_loop()
            source, served = GraphInput(replayed), settings(replayed.setup)
            if source.transport:
                served = replace(served, image_transport=source.transport)
            domain, environment, logs = _own_domain(stack)
            graph = ConsoleGraph(stack.enter_context(joined(domain=domain, simulated_clock=True)), served)
            host = ReplayHost(graph, source, domain, environment, logs, log)
            log(f"starting {', '.join(source.nodes)} (ROS domain {domain}, this machine only)")
        else:
            served = settings(read_setup(name))
            shipped = sorted(path.stem for path in (share_directory("magnetosuture_thread") / "config").glob("*.yaml"))
            domain, environment, logs = _own_domain(stack)
            graph = ConsoleGraph(stack.enter_context(joined(domain=domain)), served)
            setups = tuple(dict.fromkeys([*shipped, name]))
            host = SimulatedHost(graph, name, setups, environment, logs, recordings, log)
            log(f"starting the graph around a simulated rig (ROS domain {domain}, this machine only)")
        asyncio.run(_serve(graph, host, log))


def _own_domain(stack: ExitStack) -> tuple[int, dict[str, str], Path]:
    """Return a ROS domain for this command alone, the environment for its nodes, and a folder for their logs."""
    domain = stack.enter_context(reserved_domain())
    environment = graph_environment(domain)
    stack.enter_context(environment_of(environment))
    return domain, environment, Path(stack.enter_context(TemporaryDirectory()))


async def _serve(graph: ConsoleGraph, host: RecordingHost, log: Log) -> None:
    """Serve the page until this process gets a signal to end, or the graph breaks."""
    loop, ending = asyncio.get_running_loop(), asyncio.Event()
    for which in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(which) is not signal.SIG_IGN:
            loop.add_signal_handler(which, ending.set)
    try:
        host.start()
        server = ConsoleServer(graph.settings, graph, host)
        log(f"open {await server.start()}")
        log("Ctrl-C ends everything")
        try:
            while not ending.is_set():
                await host.watch()
                try:
                    await asyncio.wait_for(ending.wait(), POLL_PERIOD)
                except asyncio.TimeoutError:
                    continue
        finally:
            await server.stop()
    finally:
        await host.close()
    log("ended")


class ReplayHost(RecordingHost):
    """Host that plays a bag through the nodes in a loop; commands are blocked.

    Args:
        graph: to serve.
        source: the bag.
        domain: the graph's ROS domain.
        environment: for the nodes.
        logs: folder for what each node prints.
        log: called with a line for a person.
    """

    mode = "replay"

    def __init__(
        self,
        graph: ConsoleGraph,
        source: GraphInput,
        domain: int,
        environment: dict[str, str],
        logs: Path,
        log: Log,
    ) -> None:
        super().__init__(graph, source.given.setup, Path(), log)
        self._source, self._domain = source, domain
        self._environment, self._logs = environment, logs
        self._nodes: NodeProcesses | None = None
        self._ending = threading.Event()
        self._problem: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="replay")
        self.busy = f"starting the nodes for {source.given.recording.path}"
        graph.blocked = REPLAY_BLOCKED

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        recording = self._source.given.recording
        simulated = bool(recording.notes.get("simulated", ""))
        return {**super().state(), "setup": str(recording.path), "can_record": False, "simulated": simulated}

    def start(self) -> None:
        """Start the nodes, and play the bag once they are there."""
        arguments = self._source.arguments(self._logs / "lossless.yaml")
        self._nodes = NodeProcesses(self._source.processes, arguments, self._environment, self._logs).__enter__()
        self._thread.start()

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Refuse: another command records a replay."""
        return "what comes of a bag is recorded by `magnetosuture replay BAG --output DIR`"

    async def watch(self) -> None:
        """Raise what ended the replay, as a node that has ended or a bag that cannot be played on."""
        if self._problem is not None:
            raise self._problem

    async def close(self) -> None:
        """End the replay and its nodes."""
        self._ending.set()
        if self._thread.is_alive():
            await asyncio.to_thread(self._thread.join)
        if self._nodes is not None:
            await asyncio.to_thread(self._nodes.end)

    def _run(self) -> None:
        """Play until `close` is called; in a thread, as a replay waits for the graph in its own way."""
        live = live_replay(self._source, self._domain, 1.0, lambda topic, time, data: None, self._check, self.log)
        try:
            live.wait_for_graph()
            self.busy = ""
            live.play_on(self._source.records)
        except _EndedError:
            pass
        except Exception as error:  # in a thread nobody else would hear of it
            self._problem = error
        finally:
            live.close()

    def _check(self) -> None:
        if self._ending.is_set():
            raise _EndedError
        if self._nodes is not None:
            self._nodes.check()


class _EndedError(Exception):
    """`ReplayHost.close` was called."""
