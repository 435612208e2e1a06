"""Host of the operator page on a replayed bag."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magnetosuture_thread.jobs.console_hosts import RecordingHost
from magnetosuture_thread.jobs.playing import Playing
from magnetosuture_thread.jobs.simulate import Log
from magnetosuture_thread.nodes.console_graph import ConsoleGraph
from magnetosuture_thread.nodes.processes import NodeProcesses
from magnetosuture_thread.nodes.replay import LiveReplay
from magnetosuture_thread.nodes.replay_time import Timeline

REPLAY_BLOCKED = "this is a replay: nothing can be jogged or armed"


class ReplayHost(RecordingHost):
    """Host that plays a bag through the nodes in a loop; commands are blocked.

    Args:
        graph: to serve.
        playing: the bag.
        domain: the graph's ROS domain.
        environment: for the nodes.
        logs: folder for what each node prints.
        log: called with a line for a person.
    """

    mode = "replay"

    def __init__(
        self, graph: ConsoleGraph, playing: Playing, domain: int, environment: Mapping[str, str], logs: Path, log: Log
    ) -> None:
        super().__init__(graph, playing.given.setup, Path(), log)
        self._playing, self._domain = playing, domain
        self._environment, self._logs = dict(environment), logs
        self._nodes: NodeProcesses | None = None
        self._asked = threading.Event()
        self._problem: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="replay")
        self.busy = f"starting the nodes for {playing.given.recording.path}"
        graph.blocked = REPLAY_BLOCKED

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        recording = self._playing.given.recording
        simulated = bool(recording.notes.get("simulated", ""))
        return {**super().state(), "setup": str(recording.path), "can_record": False, "simulated": simulated}

    def start(self) -> None:
        """Start the nodes, and play the bag once they are there."""
        arguments = self._playing.arguments(self._logs / "lossless.yaml")
        self._nodes = NodeProcesses(self._playing.processes, arguments, self._environment, self._logs).__enter__()
        self._thread.start()

    async def set_recording(self, recording: bool) -> str:
        """Refuse: another command records a replay."""
        return "what comes of a bag is recorded by `magnetosuture replay BAG --output DIR`"

    async def watch(self) -> None:
        """Raise what ended the replay, as a node that has ended or a bag that cannot be played on."""
        if self._problem is not None:
            raise self._problem

    async def close(self) -> None:
        """End the replay and its nodes."""
        self._asked.set()
        if self._thread.is_alive():
            await asyncio.to_thread(self._thread.join)
        if self._nodes is not None:
            await asyncio.to_thread(self._nodes.end)

    def _run(self) -> None:
        """Play until somebody asks this to end; in a thread, as a replay waits for the graph in its own way."""
        playing = self._playing
        live = LiveReplay(
            self._domain,
            Timeline(playing.given.begin, 1.0),
            played=playing.topics(),
            nodes=len(playing.nodes),
            receive=lambda topic, time, data: None,
            watch=self._check,
            log=self.log,
        )
        try:
            live.wait_for_graph()
            self.busy = ""
            live.play_on(playing.records)
        except _AskedToEndError:
            pass
        except Exception as error:  # in a thread nobody else would hear of it
            self._problem = error
        finally:
            live.close()

    def _check(self) -> None:
        if self._asked.is_set():
            raise _AskedToEndError
        if self._nodes is not None:
            self._nodes.check()


class _AskedToEndError(Exception):
    """The replay is to end."""
