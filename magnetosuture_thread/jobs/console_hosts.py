"""Hosts of the operator page: on a running graph, or around a simulated rig; both record bags."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from magnetosuture_thread import MagnetosutureError
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.interface import NODES, PLANNER, PROCESSES, SCENE_SERVER
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.jobs.replay_inputs import SETUP_NOTE, Log
from magnetosuture_thread.jobs.simulate import ACTIVE, FORECAST, SLOWER_BRIDGE, START_TIMEOUT, log_compiling
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.console.graph import ConsoleGraph
from magnetosuture_thread.nodes.console.inbox import RECORDED_TOPICS, ConsoleTap
from magnetosuture_thread.nodes.console.node import RIG, GraphHost
from magnetosuture_thread.nodes.processes import NodeProcesses
from magnetosuture_thread.setups import Setup, read_setup

# The coils rest while the needle's pose is late, and a late answer of the model is a late answer to a key: so they
# go before the browser and the rig, and behind the bridge.
PREFERRED, PRIORITY = "perception", 5
SIMULATED_COILS = ("-p", "coil_bridge:driver:=simulated", "-p", "coil_bridge:autostart:=active")  # a person arms it


class BagRecording:
    """Records a bag, in a thread of its own so that a slow disk delays neither jogging nor stopping.

    Args:
        output: the bag's folder; it is there, whole, once the recording has ended.
        notes: of the bag.
        graph: that is recorded.
        recorded: topics that are recorded.
    """

    def __init__(
        self, output: Path, notes: Mapping[str, str], graph: ConsoleGraph, recorded: Sequence[topics.Topic]
    ) -> None:
        self.output = output
        self._notes = notes
        self._graph = graph
        self._topics = recorded
        self._tapping: asyncio.Task[None] | None = None
        self._waiting: queue.SimpleQueue[tuple[str, int, bytes] | None] = queue.SimpleQueue()
        self._begun: Future[None] = Future()
        self._ended: Future[None] = Future()

    @property
    def running(self) -> bool:
        """Whether it has begun and has not ended."""
        return self._tapping is not None

    @property
    def ended(self) -> bool:
        """Whether it has ended, by `end` or because the disk is full."""
        return self._ended.done()

    async def begin(self) -> None:
        """Begin to record.

        Raises:
            BagError: the output exists or cannot be written.
        """
        threading.Thread(target=self._run, name="recording").start()
        await asyncio.wrap_future(self._begun)
        self._tapping = asyncio.create_task(self._tap())

    async def end(self) -> None:
        """End, once all messages are written.

        Raises:
            BagError: the disk is full or fails; what was recorded before is there.
        """
        tapping, self._tapping = self._tapping, None
        if tapping is not None:
            tapping.cancel()
            with suppress(asyncio.CancelledError):
                await tapping
        self._waiting.put(None)
        await asyncio.wrap_future(self._ended)

    async def _tap(self) -> None:
        """Queue all messages for the thread until cancelled."""
        tap = ConsoleTap(self._graph.node, self._topics, None, self._put)
        try:
            await tap.run()
        finally:
            tap.close()

    def _put(self, topic: str, arrival: int, data: bytes) -> None:
        if not self.ended:
            self._waiting.put((topic, arrival, data))

    def _run(self) -> None:
        try:
            self._write()
        except MagnetosutureError as error:
            if not self._begun.done():
                self._begun.set_exception(error)
            self._ended.set_exception(error)
        else:
            self._ended.set_result(None)

    def _write(self) -> None:
        with (
            whole_folder(self.output, is_recording=True) as folder,
            BagWriter(folder, self._notes, name=self.output.name) as bag,
        ):
            for topic in self._topics:
                bag.add_topic(topic.channel.recorded, topic.channel.type_name)
            self._begun.set_result(None)
            while (message := self._waiting.get()) is not None:
                bag.write(*message)


def new_name(folder: Path, name: str) -> Path:
    """Return a folder that does not exist yet for a recording, named by the time and the setup."""
    stem = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{name}".rstrip("_")
    output, count = folder / stem, 1
    while output.exists():
        count += 1
        output = folder / f"{stem}_{count}"
    return output


class RecordingHost(GraphHost):
    """Host of a running graph that records bags.

    Args:
        graph: to serve.
        setup: with which.
        recordings: folder that gets a bag for each recording.
        log: called with a line for a person.
    """

    def __init__(self, graph: ConsoleGraph, setup: Setup, recordings: Path, log: Log) -> None:
        super().__init__(graph)
        self.setup = setup
        self.busy = ""
        self.log = log
        self._recordings = recordings
        self._recording: BagRecording | None = None

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        recording = "" if self._recording is None else str(self._recording.output)
        return {
            **super().state(),
            "setup": self.setup.name,
            "can_record": True,
            "recording": recording,
            "busy": self.busy,
        }

    def notes(self, operator: str) -> dict[str, str]:
        """Return the notes of a recording, which the page that has control began.

        Args:
            operator: who commands that page.
        """
        text = self.setup.path.read_text(encoding="utf-8")
        notes = {"setup": self.setup.name, SETUP_NOTE: text}
        if self.graph.is_active(RIG):
            notes["simulated"] = (
                f"the whole rig, setup {self.setup.name}; control was with {operator} when the recording began"
            )
        return notes

    def start(self) -> None:
        """Start what this runs; here nothing."""

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Start or end a recording; return an empty text, or the reason of a refusal."""
        if recording == (self._recording is not None):
            return ""
        if not recording:
            return await self._end_recording()
        if self.busy:
            return self.busy
        raw = self.graph.settings.image_transport == "raw"
        recorded = [topic for topic in RECORDED_TOPICS if topic is not topics.IMAGE or raw]
        output = new_name(self._recordings, self.setup.name)
        bag = self._recording = BagRecording(output, self.notes(operator), self.graph, recorded)
        try:
            await bag.begin()
        except MagnetosutureError as error:
            self._recording = None
            return str(error)
        self.log(f"recording to {bag.output}")
        return ""

    async def watch(self) -> None:
        """Check what runs; called several times a second.

        Raises:
            GraphError: a node has ended.
        """
        if self._recording is not None and self._recording.ended:
            await self._end_recording()

    async def close(self) -> None:
        """End the recording."""
        await self._end_recording()

    async def _end_recording(self) -> str:
        """End the recording, if there is one; return the problem if it is not complete."""
        recording = self._recording
        if recording is None or not recording.running:
            return ""
        try:
            await recording.end()
        except MagnetosutureError as error:
            self.log(f"the recording has ended: {error}")
            return str(error)
        finally:
            self._recording = None
        self.log(f"recorded: {recording.output}")
        return ""


class SimulatedHost(RecordingHost):
    """Host that starts the whole graph around a simulated rig; any setup can be selected.

    Args:
        graph: to serve.
        setup: name or path of the initial setup.
        setups: that can be selected.
        environment: for the nodes.
        logs: folder for what each node prints.
        recordings: folder that gets a bag for each recording.
        log: called with a line for a person.
    """

    mode = "simulated"

    def __init__(
        self,
        graph: ConsoleGraph,
        setup: str,
        setups: Sequence[str],
        environment: Mapping[str, str],
        logs: Path,
        recordings: Path,
        log: Log,
    ) -> None:
        super().__init__(graph, read_setup(setup), recordings, log)
        self._setup_name, self._setups = setup, tuple(setups)
        self._environment, self._logs = dict(environment), logs
        self._nodes: NodeProcesses | None = None
        self._since, self._logged = 0.0, set[str]()
        self._changing = False
        self._block(f"starting {self.setup.name}")

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        return {**super().state(), "setup": self._setup_name, "setups": list(self._setups), "simulated": True}

    def start(self) -> None:
        """Start the nodes; they are busy until each of them has reported its state."""
        given = (*SLOWER_BRIDGE, *ACTIVE, *SIMULATED_COILS, *FORECAST)
        arguments = ["--params-file", str(self.setup.path.resolve()), *given]
        # Here and not in another thread: the nodes end with the thread that has started them.
        processes = (SCENE_SERVER, RIG, *PROCESSES, PLANNER)
        self._nodes = NodeProcesses(processes, arguments, self._environment, self._logs).__enter__()
        self._since = time.monotonic()

    async def select_setup(self, setup: str) -> str:
        """Stop the nodes and start those of a setup; return the reason of a refusal."""
        if self.busy:
            return self.busy
        if setup not in self._setups:
            return f"setup: got {setup!r}, expected one of {', '.join(self._setups)}"
        try:
            selected = read_setup(setup)
            version = selected.scene.version  # read while the old nodes still run: they stay if it cannot be
        except MagnetosutureError as error:
            return str(error)
        self._block(f"starting {selected.name}")
        self._changing = True  # the nodes that are still there are not those to wait for
        try:
            await self._end_recording()
            await self._end_nodes()
        finally:
            self._changing = False
        self.setup, self._setup_name, self.paused = selected, setup, False
        self.graph.begin(served_as(selected.console, self.graph.settings))
        self.start()
        self.log(f"starting {selected.name}, scene {version}")
        return ""

    async def watch(self) -> None:
        """Permit commands once all nodes are ready; raise `GraphError` if one has ended."""
        await super().watch()
        if self._changing or self._nodes is None:
            return
        self._nodes.check()
        if not self.busy:
            return
        nodes = self.graph.nodes().items()
        log_compiling({name: about["message"] for name, about in nodes}, self._logged, self.log)
        missing = [name for name in (SCENE_SERVER, RIG, *NODES, PLANNER) if not self.graph.is_active(name)]
        bridge = self.graph.state()["bridge"] or {}
        if not missing and bridge.get("driver_ready"):  # the bridge may find the rig seconds after we have
            # Only now: while it compiles for the first time, others shall not wait for it.
            self.log(f"{PREFERRED}: {self._nodes.prefer(PREFERRED, PRIORITY)}")
            self._block("")
            self.log(f"{self.setup.name} runs; the coils are not armed")
        elif time.monotonic() - self._since > START_TIMEOUT:
            unheard = ", ".join(missing) or "a bridge that is ready"
            raise GraphError(f"after {START_TIMEOUT:g} s nothing is heard of {unheard}")

    async def close(self) -> None:
        """End recording and nodes."""
        await super().close()
        await self._end_nodes()

    def _block(self, reason: str) -> None:
        """Stop the needle and block commands for a reason; an empty one permits them again."""
        self.graph.publish_velocity((0.0, 0.0))
        self.busy = self.graph.blocked = reason

    async def _end_nodes(self) -> None:
        nodes, self._nodes = self._nodes, None
        if nodes is not None:
            await asyncio.to_thread(nodes.end)


def served_as(settings: ConsoleSettings, other: ConsoleSettings) -> ConsoleSettings:
    """Return a setup's settings with address, port, token, certificate and origin as they are served."""
    served = ("address", "port", "token", "certificate", "private_key", "origin")
    return replace(settings, **{name: getattr(other, name) for name in served})
