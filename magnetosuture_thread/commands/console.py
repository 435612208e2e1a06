"""The command `magnetosuture console`: the operator's page, the graph behind it, and recordings. It needs ROS."""

from __future__ import annotations

import argparse
import asyncio
import itertools
import os
import signal
import threading
import time
from collections.abc import Coroutine, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AsyncExitStack, ExitStack, closing, suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from magnetosuture_thread import ConfigurationError, MagnetosutureError
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.calibration.commission_files import SUMMARY_FILE
from magnetosuture_thread.commands import command, live
from magnetosuture_thread.commands.measurement import Measurement, taught_values
from magnetosuture_thread.console.server import ConsoleServer
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.evaluation.recorded import DEFAULT_SETUP, SETUP_NOTE, open_bag
from magnetosuture_thread.evaluation.workers import Log
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import Inbox, Participant, Services, parameters_of, restart, services_to_restart
from magnetosuture_thread.nodes.console import NAME, RECORDED_TOPICS, RIG, ConsoleGraph, GraphHost
from magnetosuture_thread.nodes.processes import STOPS, NodeProcesses
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings.configuration import from_mapping, to_mapping
from magnetosuture_thread.settings.errors import GraphError
from magnetosuture_thread.settings.files import shipped_names, whole_folder
from magnetosuture_thread.settings.interface import NODES, PLANNER, PROCESSES, SCENE_SERVER

TOKEN = "MAGNETOSUTURE_TOKEN"
TRACKER = "vision_tracker"
SERVED = ("address", "port", "token", "certificate", "private_key", "origin")  # settings that no other setup changes


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    option = parser.add_argument
    option("setup", metavar="SETUP", nargs="?", default="", help="its name or YAML file (default: of a 35 mm dish)")
    graph = parser.add_mutually_exclusive_group()
    graph.add_argument("--graph", action="store_true", help="on the graph that runs on this ROS domain")
    graph.add_argument("--replay", type=Path, metavar="BAG", help="on a bag that is played through the nodes")
    option("--namespace", type=command.namespace_argument, default="", metavar="NAME", help="of the running graph")
    option("--address", help="network address to serve on (default: the setup's, 127.0.0.1)")
    option("--port", type=command.whole_number, help="of it; 0 takes a free one (default: the setup's, 8090)")
    option("--certificate", metavar="FILE", help="serve over TLS by this certificate, a PEM file")
    key = "of the certificate, where it is not in the same file"
    option("--key", dest="private_key", metavar="FILE", help=key)
    option("--origin", metavar="URL", help="under which browsers reach the page, as https://rig.example")
    option("--token", help=f"that commands need (default: {TOKEN} in the environment, or a new one)")
    recordings = "folder that gets a bag for each recording (default: output/recordings)"
    option("--record", type=Path, default=Path("output/recordings"), metavar="DIR", help=recordings)


def run_console(options: argparse.Namespace, terminal: command.Terminal) -> None:
    """Serve the operator's page.

    It shows the dish with needle and thread, the margins and the state of all nodes; the needle is jogged by arrow
    keys, gamepad or mouse; emergency stop, arm and disarm.

    Without an option the whole graph is started around a simulated rig, with the coils disarmed, and any setup
    can be chosen on the page. --graph serves the page on the graph that runs on this ROS domain, --replay on a
    bag that is played through the nodes over and over, which nobody can jog.

    The page is served on this machine alone unless --address and a token say otherwise. Without a token each
    start makes its own, which is in the address that is printed. A token in the environment, as
    MAGNETOSUTURE_TOKEN, is not shown to others on this machine, as an option is.

    Ctrl-C ends everything that this command has started; a recording that runs is kept.
    """
    if options.namespace and not options.graph:
        raise ConfigurationError("--namespace", options.namespace, "none without --graph, as no other graph is joined")
    options.token = options.token or os.environ.pop(TOKEN, None) or None  # no node gets it
    served = {name: getattr(options, name) for name in SERVED if getattr(options, name) is not None}

    def settings(setup: Setup) -> ConsoleSettings:
        return from_mapping(ConsoleSettings, {**to_mapping(setup.console), **served})

    name, log = options.setup or DEFAULT_SETUP, terminal.log
    host: RecordingHost
    with ExitStack() as stack:
        if options.graph:
            setup = read_setup(name)
            page = stack.enter_context(Participant(NAME, namespace=options.namespace))
            graph = ConsoleGraph(page.node, settings(setup))
            host = RecordingHost(graph, setup, options.record, log, measures=bool(options.setup))
        else:
            source = None
            if options.replay is not None:
                source = live.GraphInput(stack.enter_context(open_bag(options.replay, log, setup_name=options.setup)))
                source.bag.check_loop()
            shown = settings(read_setup(name) if source is None else source.bag.setup)
            shown = replace(shown, image_transport=source.transport) if source and source.transport else shown
            logs, domain = Path(stack.enter_context(TemporaryDirectory())), stack.enter_context(live.own_domain())
            page = stack.enter_context(Participant(NAME, domain=domain, simulated_clock=source is not None))
            graph = ConsoleGraph(page.node, shown)
            if source is None:
                host = SimulatedHost(graph, name, logs, options.record, log)
            else:
                host = ReplayHost(graph, source, domain, logs, log)
            what = "the graph around a simulated rig" if source is None else ", ".join(source.nodes)
            log(f"starting {what} (ROS domain {domain}, this machine only)")
        asyncio.run(_serve(graph, host, log))


async def _serve(graph: ConsoleGraph, host: RecordingHost, log: Log) -> None:
    """Serve the page until this process gets a signal to end, or the graph breaks."""
    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    async with AsyncExitStack() as stack:
        stack.push_async_callback(host.close)
        host.start()
        server = ConsoleServer(graph.settings, graph, host)
        for which in STOPS:
            if signal.getsignal(which) is not signal.SIG_IGN:
                loop.add_signal_handler(which, ended.set)
        stack.push_async_callback(server.stop)  # so the needle is stopped first
        log(f"open {await server.start()}\nCtrl-C ends everything")
        while not ended.is_set():
            await host.watch()
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(ended.wait(), 0.2)  # s between two checks of the nodes
    log("ended")


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
        self.output, self._notes = output, notes
        self._inboxes = [Inbox(graph.node, topic, 1000) for topic in recorded]
        self._begun, self._ending = Future[None](), threading.Event()
        self._writing = asyncio.create_task(asyncio.to_thread(self._write))

    @property
    def ended(self) -> bool:
        """Whether it has ended, by `end` or because the disk is full."""
        return self._writing.done()

    async def begin(self) -> None:
        """Wait until it records.

        Raises:
            BagError: the output exists or cannot be written.
        """
        begun = asyncio.wrap_future(self._begun)
        await asyncio.wait((begun, self._writing), return_when=asyncio.FIRST_COMPLETED)
        if self.ended:
            await self.end()

    async def end(self) -> None:
        """End, once all messages are written.

        Raises:
            BagError: the disk is full or fails; what was recorded before is there.
        """
        self._ending.set()
        await asyncio.wait([self._writing])  # which a cancellation of this does not end: the inboxes are in use
        for inbox in self._inboxes:
            inbox.close()
        self._inboxes = []
        self._writing.result()

    def _write(self) -> None:
        with (
            whole_folder(self.output, is_recording=True) as folder,
            BagWriter(folder, self._notes, name=self.output.name) as bag,
        ):
            for inbox in self._inboxes:
                bag.add_topic(inbox.topic.channel.recorded, inbox.topic.channel.type_name)
            self._begun.set_result(None)
            ending = False
            while not ending:
                ending = self._ending.wait(0.01)
                for inbox in self._inboxes:
                    for data, arrived in inbox.take():
                        bag.write(inbox.topic.channel.recorded, arrived, data)


def new_name(folder: Path, name: str) -> Path:
    """Return a folder that does not exist yet for a recording, named by the time and the setup."""
    stem = f"{datetime.now():%Y-%m-%d_%H-%M-%S}_{name}".rstrip("_")
    endings = itertools.chain([""], (f"_{number}" for number in itertools.count(2)))
    return next(path for ending in endings if not (path := folder / f"{stem}{ending}").exists())


class RecordingHost(GraphHost):
    """Host of a running graph that records bags.

    Args:
        graph: to serve.
        setup: with which.
        recordings: folder that gets a bag for each recording.
        log: called with a line for a person.
        measures: whether the setup is that of the graph, so that it can be measured.
    """

    def __init__(self, graph: ConsoleGraph, setup: Setup, recordings: Path, log: Log, *, measures: bool = True) -> None:
        super().__init__(graph)
        self._measures = measures
        self.setup, self.busy, self.log = setup, "", log
        self._recordings = recordings
        self._recording: BagRecording | None = None
        self._tracker: Services | None = None  # to change its parameters
        self._measurement: Measurement | None = None
        self._measuring: asyncio.Task[None] | None = None
        self._commissioned: Path | None = None  # folder of the last commissioning

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        recording = "" if self._recording is None else str(self._recording.output)
        state = {"setup": self.setup.name, "can_record": True, "recording": recording, "busy": self.busy}
        measurement = self._measurement and self._measurement.shown()
        return {**super().state(), **state, "can_measure": self._measures, "measurement": measurement}

    def notes(self, operator: str) -> dict[str, str]:
        """Return the notes of a recording, which the page that has control began.

        Args:
            operator: who commands that page.
        """
        notes = {"setup": self.setup.name, SETUP_NOTE: self.setup.path.read_text(encoding="utf-8")}
        what = f"the whole rig, setup {self.setup.name}; control was with {operator} when the recording began"
        return {**notes, **({"simulated": what} if self.graph.is_active(RIG) else {})}

    def start(self) -> None:
        """Start what this runs; here nothing."""

    def at_work(self) -> str:
        """Return what has to end before anything else begins; empty if nothing has to."""
        if self._measurement is not None and self._measurement.state == "running":
            return f"{self._measurement.name} is running; cancel it first"
        return self.busy

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

    async def measure(self, action: str, marks: tuple[float, ...]) -> str:
        """Teach the tracker or commission the rig; return an empty text, or the reason of a refusal."""
        if problem := self.at_work():
            return problem
        if not self._measures:
            return "nobody said which setup this graph has: `magnetosuture console SETUP --graph`"
        believed, scene = self.setup.scene.dish.diameter, self.graph.state()["scene"] or {}
        if abs(scene.get("dish_diameter", believed) - believed) > 1e-5:  # m; two dishes differ by more
            return (
                f"the graph's dish of {1e3 * scene['dish_diameter']:g} mm is not the setup's of {1e3 * believed:g} mm"
            )
        if self._is_armed():
            return "the coils are armed; disarm first"
        measurement = self._measurement = Measurement(action)
        run = self._teach(measurement, marks) if action == "teach" else self._commission(measurement)
        self._measuring = asyncio.create_task(_ended(measurement, run))
        return ""

    def cancel(self) -> None:
        """End the measurement that runs, if there is one."""
        if self._measurement is not None and self._measurement.state == "running":
            self._measurement.cancel()

    def picture(self) -> bytes:
        """Return the picture of the last measurement, a PNG file; empty if there is none."""
        return b"" if self._measurement is None else self._measurement.picture[1]

    async def watch(self) -> None:
        """Check what runs; called several times a second.

        Raises:
            GraphError: a node has ended.
        """
        self.graph.spin()
        if self._recording is not None and self._recording.ended:
            await self._end_recording()

    async def close(self) -> None:
        """End measurement and recording."""
        if self._measurement is not None and self._measuring is not None:
            if await self._measurement.close():  # it had no time to disarm
                await self.graph.execute_action("disarm")
            await self._measuring
        await self._end_recording()

    def _is_armed(self) -> bool:
        return bool((self.graph.state()["bridge"] or {}).get("armed"))

    async def _teach(self, measurement: Measurement, marks: tuple[float, ...]) -> str:
        """Let the tracker learn the needle from what the camera shows now; return what went wrong."""
        folder = new_name(self._recordings, f"{self.setup.name}_taught")
        output = folder / "tracker.yaml"
        folder.mkdir(parents=True)
        raw = self.graph.settings.image_transport == "raw"
        camera = [topics.IMAGE if raw else topics.COMPRESSED_IMAGE, topics.CAMERA_INFO]
        bag = BagRecording(folder / "frames", {"setup": self.setup.name}, self.graph, camera)
        await bag.begin()
        await asyncio.sleep(1.0)  # s of frames, in the first of which the needle is marked
        await bag.end()
        tail, tip = ([f"{value:.2f}" for value in mark] for mark in (marks[:2], marks[2:]))
        arguments = [str(bag.output), "--tail", *tail, "--tip", *tip, "--setup", str(self.setup.path)]
        is_taught = await measurement.run([*arguments, "--output", str(output)])
        if (picture := output.with_suffix(".png")).is_file():
            measurement.picture = folder.name, picture.read_bytes()
        if not is_taught or measurement.cancelled or self._is_armed():
            return "not given to the tracker: the coils are armed" if is_taught and self._is_armed() else "not taught"
        (length, values), believed = taught_values(output), self.setup.vision.needle_length
        if abs(length / believed - 1.0) > 0.02:  # as far as marks tell, and less than keep_out of every setup
            sizes = f"the needle is {1e3 * length:.2f} mm long, and {1e3 * believed:.2f} mm in the setup"
            return f"{sizes}: copy the parameters into it, and start its nodes anew"
        if problem := await self._change_tracker(values):
            return problem
        measurement.lines.append("the tracker that runs knows how the needle looks until it ends")
        return ""

    async def _change_tracker(self, values: Mapping[str, Any]) -> str:
        """Give the tracker other parameters, or leave it as it was; return what went wrong."""
        if self._tracker is None:  # not before, as security policies need not allow it
            self._tracker = Services(self.graph.node, services_to_restart(TRACKER))
        tracker, problem, is_back = self._tracker, "", False
        before = await parameters_of(tracker, TRACKER, values)
        try:
            if await restart(tracker, TRACKER, values):
                return ""
            await asyncio.sleep(0.2)  # s; for the reason, on /diagnostics
            problem = f"{TRACKER}: {self.graph.nodes().get(TRACKER, {}).get('message', 'not active')}"
        except GraphError as error:
            problem = str(error)
        with suppress(GraphError):
            is_back = await restart(tracker, TRACKER, before)
        return problem if is_back else f"{problem}; {TRACKER} is off: activate it, or start it anew"

    async def _commission(self, measurement: Measurement) -> str:
        """Let the rig measure itself, from where it has come to if it is not finished; return what went wrong."""
        folder = self._commissioned
        if folder is None or not folder.exists() or (folder / SUMMARY_FILE).exists():
            folder = self._commissioned = new_name(self._recordings, f"{self.setup.name}_commissioned")
        else:
            measurement.lines.append(f"goes on in {folder}; a console that is started anew begins anew")
        space = self.graph.node.get_namespace().strip("/")
        arguments = [str(self.setup.path), "--live", "--output", str(folder), "--namespace", space]
        return "" if await measurement.run(arguments) else "not commissioned"

    async def _end_recording(self) -> str:
        """End the recording, if there is one; return the problem if it is not complete."""
        recording, problem = self._recording, ""
        if recording is None:
            return ""
        try:
            await recording.end()
        except MagnetosutureError as error:
            problem = str(error)
        if self._recording is recording:  # not before: whoever is cancelled meanwhile leaves it to `close`
            self._recording = None
            self.log(f"the recording has ended: {problem}" if problem else f"recorded: {recording.output}")
        return problem


async def _ended(measurement: Measurement, run: Coroutine[Any, Any, str]) -> None:
    """Run a measurement to its end, and let its last line be what went wrong."""
    try:
        problem = await run
    except Exception as error:  # whatever it is, the page goes on
        problem = str(error) if isinstance(error, (MagnetosutureError, OSError)) else f"internal error: {error!r}"
    measurement.lines += [problem] if problem else []
    measurement.state = "failed" if problem else "done"


class SimulatedHost(RecordingHost):
    """Host that starts the whole graph around a simulated rig; any setup that ships can be selected.

    Args:
        graph: to serve.
        setup: name or path of the initial setup.
        logs: folder for what each node prints.
        recordings: folder that gets a bag for each recording.
        log: called with a line for a person.
    """

    mode = "simulated"

    def __init__(self, graph: ConsoleGraph, setup: str, logs: Path, recordings: Path, log: Log) -> None:
        super().__init__(graph, read_setup(setup), recordings, log)
        self._setups = list(dict.fromkeys([*shipped_names("setup"), setup]))
        self._setup_name, self._logs = setup, logs
        self._nodes: NodeProcesses | None = None
        self._since, self._logged = 0.0, set[str]()
        self._block(f"starting {self.setup.name}")

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        return {**super().state(), "setup": self._setup_name, "setups": self._setups, "simulated": True}

    def start(self) -> None:
        """Start the nodes; they are busy until each of them has reported its state."""
        bridge = live.arguments_of({"coil_bridge:driver": "simulated", "coil_bridge:autostart": "active"})
        arguments = ["--params-file", str(self.setup.path.resolve()), *live.OWN, *live.FORECAST, *bridge]  # to be armed
        # Here and not in another thread: the nodes end with the thread that has started them.
        processes = (SCENE_SERVER, RIG, *PROCESSES, PLANNER)
        self._nodes = NodeProcesses(processes, arguments, dict(os.environ), self._logs).__enter__()
        self._since = time.monotonic()

    async def select_setup(self, setup: str) -> str:
        """Stop the nodes and start those of a setup; return the reason of a refusal."""
        if problem := self.at_work():
            return problem
        if setup not in self._setups:
            return f"setup: got {setup!r}, expected one of {', '.join(self._setups)}"
        try:
            selected = read_setup(setup)
            version = selected.scene.version  # read while the old nodes still run: they stay if it cannot be
        except MagnetosutureError as error:
            return str(error)
        self._block(f"starting {selected.name}")
        before, self._nodes = self._nodes, None  # `watch` does not wait for the nodes that are still there
        await self._end_recording()
        if before is not None:
            await asyncio.to_thread(before.end)
        self.setup, self._setup_name, self.paused = selected, setup, False
        served = {name: getattr(self.graph.settings, name) for name in SERVED}
        self.graph.begin(replace(selected.console, **served))
        self.start()
        self.log(f"starting {selected.name}, scene {version}")
        return ""

    async def watch(self) -> None:
        """Permit commands once all nodes are ready; raise `GraphError` if one has ended."""
        await super().watch()
        if self._nodes is None:
            return
        self._nodes.check()
        if not self.busy:
            return
        nodes = self.graph.nodes().items()
        live.log_compiling({name: report["message"] for name, report in nodes}, self._logged, self.log)
        missing = [name for name in (SCENE_SERVER, RIG, *NODES, PLANNER) if not self.graph.is_active(name)]
        bridge = self.graph.state()["bridge"] or {}
        if not missing and bridge.get("driver_ready"):  # the bridge may find the rig seconds after we have
            self._block("")
            self.log(f"{self.setup.name} runs; the coils are not armed")
        elif time.monotonic() - self._since > live.START_TIMEOUT:
            unheard = ", ".join(missing) or "a bridge that is ready"
            raise GraphError(f"after {live.START_TIMEOUT:g} s nothing is heard of {unheard}")

    async def close(self) -> None:
        """End recording and nodes."""
        await super().close()
        if self._nodes is not None:
            await asyncio.to_thread(self._nodes.end)

    def _block(self, reason: str) -> None:
        """Stop the needle and block commands for a reason; an empty one permits them again."""
        self.graph.publish_velocity((0.0, 0.0))
        self.busy = self.graph.blocked = reason


class ReplayHost(RecordingHost):
    """Host that plays a bag through the nodes in a loop; commands are blocked.

    Args:
        graph: to serve.
        source: the bag.
        domain: ROS domain of the nodes.
        logs: folder for what each node prints.
        log: called with a line for a person.
    """

    mode = "replay"

    def __init__(self, graph: ConsoleGraph, source: live.GraphInput, domain: int, logs: Path, log: Log) -> None:
        super().__init__(graph, source.bag.setup, Path(), log)
        self._source, self._domain = source, domain
        arguments = source.arguments(logs / "lossless.yaml")
        self._nodes = NodeProcesses(source.processes, arguments, dict(os.environ), logs)
        self._ending = threading.Event()
        self._playing: asyncio.Task[None] | None = None
        self.busy = f"starting the nodes for {source.bag.recording.path}"
        graph.blocked = "this is a replay: nothing can be jogged or armed"

    def state(self) -> dict[str, Any]:
        """Return what runs and what is possible now."""
        recording = self._source.bag.recording
        simulated = bool(recording.notes.get("simulated", ""))
        cannot = {"can_record": False, "can_measure": False}
        return {**super().state(), "setup": str(recording.path), **cannot, "simulated": simulated}

    def start(self) -> None:
        """Start the nodes, and play the bag once they are there."""
        self._nodes.__enter__()
        self._playing = asyncio.create_task(asyncio.to_thread(self._play))

    async def set_recording(self, recording: bool, operator: str) -> str:
        """Refuse: another command records a replay."""
        return "what comes of a bag is recorded by `magnetosuture replay BAG --output DIR`"

    async def measure(self, action: str, marks: tuple[float, ...]) -> str:
        """Refuse: a rig that was recorded does nothing more."""
        return "a bag is measured by `magnetosuture teach BAG` and `magnetosuture calibrate BAG`"

    async def watch(self) -> None:
        """Raise what ended the replay, as a node that has ended or a bag that cannot be played on."""
        if self._playing is not None and self._playing.done():
            self._playing.result()

    async def close(self) -> None:
        """End the replay and its nodes."""
        self._ending.set()
        if self._playing is not None:
            await asyncio.wait([self._playing])
        await asyncio.to_thread(self._nodes.end)

    def _play(self) -> None:
        """Play until `close` is called; in a thread, as a replay waits for the graph itself."""
        replay = self._source.live(self._domain, 1.0, lambda topic, time, data: None, self._check, self.log)
        with closing(replay), suppress(_EndedError):
            replay.wait_for_graph()
            self.busy = ""
            replay.play_on(self._source.records)

    def _check(self) -> None:
        if self._ending.is_set():
            raise _EndedError
        self._nodes.check()


class _EndedError(Exception):
    """`ReplayHost.close` was called."""
