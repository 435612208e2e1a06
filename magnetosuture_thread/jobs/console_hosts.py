"""Who serves the operator's page: on a graph that runs, or around a simulated rig."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import GraphError, MagnetosutureError
from magnetosuture_thread.interface import NODES, PROCESSES, SCENE_SERVER
from magnetosuture_thread.jobs.console_recording import BagRecording, new_name
from magnetosuture_thread.jobs.simulate import SCENARIO_NOTE, SLOWER_BRIDGE, START_TIMEOUT, Say
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.console_graph import ConsoleGraph
from magnetosuture_thread.nodes.console_host import RIG, GraphHost
from magnetosuture_thread.nodes.console_tap import SAID, ConsoleTap
from magnetosuture_thread.nodes.processes import NodeProcesses
from magnetosuture_thread.setups import Setup, read_setup

# The coils rest while the needle's pose is late, and a late answer of the model is a late answer to a key: so they
# go before the browser and the rig, and behind the bridge.
PREFERRED, PRIORITY = "perception", 5
SIMULATED_COILS = ("-p", "coil_bridge:driver:=simulated", "-p", "coil_bridge:autostart:=active")  # a person arms it


class RecordingHost(GraphHost):
    """A graph that others run, of which bags are recorded.

    Args:
        graph: that is looked at.
        setup: with which.
        recordings: folder that gets a bag for each recording.
        say: called with a line for a person.
    """

    def __init__(self, graph: ConsoleGraph, setup: Setup, recordings: Path, say: Say) -> None:
        super().__init__(graph)
        self.setup = setup
        self.busy = ""
        self.say = say
        self._recordings = recordings
        self._recording: BagRecording | None = None
        self._tap: ConsoleTap | None = None
        self._tapping: asyncio.Task[None] | None = None

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        recording = "" if self._recording is None else str(self._recording.output)
        return {
            **super().state(),
            "scenario": self.setup.name,
            "can_record": True,
            "recording": recording,
            "busy": self.busy,
        }

    @property
    def notes(self) -> dict[str, str]:
        """Return the notes of a recording."""
        text = self.setup.path.read_text(encoding="utf-8")
        notes = {"setup": self.setup.name, SCENARIO_NOTE: text}
        if self.graph.says(RIG):
            notes["simulated"] = f"the whole rig, steered by a person, scenario {self.setup.name}"
        return notes

    def start(self) -> None:
        """Start what this runs; here nothing."""

    async def record(self, on: bool) -> str:
        """Begin or end a recording; return an empty text, or why it cannot be."""
        if on == (self._recording is not None):
            return ""
        if not on:
            return await self._end_recording()
        if self.busy:
            return self.busy
        raw = self.graph.settings.image_transport == "raw"
        taken = [topic for topic in SAID if topic is not topics.IMAGE or raw]
        channels = [topic.channel for topic in taken]
        recording = BagRecording(new_name(self._recordings, self.setup.name), self.notes, channels)
        self._recording = recording
        try:
            await recording.begin()
        except MagnetosutureError as error:
            self._recording = None
            return str(error)
        self._tap = ConsoleTap(self.graph.node, taken, None, recording.take)
        self._tapping = asyncio.create_task(self._tap.run())
        self.say(f"recording to {recording.output}")
        return ""

    async def watch(self) -> None:
        """Look after what runs; called several times a second.

        Raises:
            GraphError: a node has ended.
        """
        if self._recording is not None and self._recording.ended:
            await self._end_recording()

    async def close(self) -> None:
        """End what was begun."""
        await self._end_recording()

    async def _end_recording(self) -> str:
        """End the recording, if there is one; return what became of it if it is not as it should be."""
        recording, tap, tapping = self._recording, self._tap, self._tapping
        if recording is None or tap is None or tapping is None:
            return ""
        self._tap = self._tapping = None
        tapping.cancel()
        with suppress(asyncio.CancelledError):
            await tapping
        tap.close()
        try:
            await recording.end()
        except MagnetosutureError as error:
            self.say(f"the recording has ended: {error}")
            return str(error)
        finally:
            self._recording = None
        self.say(f"recorded: {recording.output}")
        return ""


class SimulatedHost(RecordingHost):
    """The whole graph around a simulated rig, as processes of this one; any set-up can be chosen.

    Args:
        graph: that is looked at.
        scenario: name or path of the set-up to begin with.
        scenarios: the set-ups that can be chosen.
        environment: for the nodes.
        logs: folder for what each node prints.
        recordings: folder that gets a bag for each recording.
        say: called with a line for a person.
    """

    mode = "simulated"

    def __init__(
        self,
        graph: ConsoleGraph,
        scenario: str,
        scenarios: Sequence[str],
        environment: Mapping[str, str],
        logs: Path,
        recordings: Path,
        say: Say,
    ) -> None:
        super().__init__(graph, read_setup(scenario), recordings, say)
        self._scenario, self._scenarios = scenario, tuple(scenarios)
        self._environment, self._logs = dict(environment), logs
        self._nodes: NodeProcesses | None = None
        self._since = 0.0
        self._changing = False
        self._hold(f"starting {self.setup.name}")

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        return {**super().state(), "scenario": self._scenario, "scenarios": list(self._scenarios), "simulated": True}

    def start(self) -> None:
        """Start the nodes; they are busy until each of them has said something of itself."""
        arguments = ["--params-file", str(self.setup.path.resolve()), *SLOWER_BRIDGE, *SIMULATED_COILS]
        # Here and not in another thread: the nodes end with the thread that has started them.
        processes = (SCENE_SERVER, RIG, *PROCESSES)
        self._nodes = NodeProcesses(processes, arguments, self._environment, self._logs).__enter__()
        self._since = time.monotonic()

    async def choose(self, scenario: str) -> str:
        """End the nodes and start those of another scenario, or of the same; return a refusal."""
        if self.busy:
            return self.busy
        if scenario not in self._scenarios:
            return f"scenario: got {scenario!r}, expected one of {', '.join(self._scenarios)}"
        try:
            setup = read_setup(scenario)
            version = setup.scene.version  # read while the old nodes still run: they stay if it cannot be
        except MagnetosutureError as error:
            return str(error)
        self._hold(f"starting {setup.name}")
        self._changing = True  # the nodes that are still there are not those to wait for
        try:
            await self._end_recording()
            await self._end_nodes()
        finally:
            self._changing = False
        self.setup, self._scenario, self.paused = setup, scenario, False
        self.graph.begin(served_as(setup.console, self.graph.settings))
        self.start()
        self.say(f"starting {setup.name}, scene {version}")
        return ""

    async def watch(self) -> None:
        """Let the operator in once all nodes are there; raise `GraphError` if one has ended."""
        await super().watch()
        if self._changing or self._nodes is None:
            return
        self._nodes.check()
        if not self.busy:
            return
        missing = [name for name in (SCENE_SERVER, RIG, *NODES) if not self.graph.says(name)]
        bridge = self.graph.state()["bridge"] or {}
        if not missing and bridge.get("driver_ready"):  # the bridge may find the rig seconds after we have
            # Only now: while it compiles for the first time, others shall not wait for it.
            self.say(f"{PREFERRED}: {self._nodes.prefer(PREFERRED, PRIORITY)}")
            self._hold("")
            self.say(f"{self.setup.name} runs; the coils are not armed")
        elif time.monotonic() - self._since > START_TIMEOUT:
            unheard = ", ".join(missing) or "a bridge that is ready"
            raise GraphError(f"after {START_TIMEOUT:g} s nothing is heard of {unheard}")

    async def close(self) -> None:
        """End recording and nodes."""
        await super().close()
        await self._end_nodes()

    def _hold(self, why: str) -> None:
        """Let nothing be steered, and the needle rest, for a reason; or let the operator in again."""
        self.graph.steer((0.0, 0.0))
        self.busy = self.graph.held = why

    async def _end_nodes(self) -> None:
        nodes, self._nodes = self._nodes, None
        if nodes is not None:
            await asyncio.to_thread(nodes.end)


def served_as(settings: ConsoleSettings, other: ConsoleSettings) -> ConsoleSettings:
    """Return a set-up's settings with address, port and token as they are served."""
    return replace(settings, address=other.address, port=other.port, token=other.token)
