"""A graph of a command's own, on a ROS domain that nobody else uses, and a bag played into it. It needs ROS."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import yaml

from magnetosuture_thread.bags.packing import packed_scene
from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.evaluation import recorded, replay
from magnetosuture_thread.evaluation.frames import CurrentSeries, GraphCollector
from magnetosuture_thread.evaluation.metrics import RunMetrics, SensorSilence, stage_latencies
from magnetosuture_thread.evaluation.tables import ReplaySummary
from magnetosuture_thread.evaluation.workers import Log, Progress
from magnetosuture_thread.geometry.scene_files import write_scene
from magnetosuture_thread.nodes import processes, topics
from magnetosuture_thread.nodes.clients import Receive
from magnetosuture_thread.nodes.executor import Timeline
from magnetosuture_thread.nodes.node import COMPILING
from magnetosuture_thread.nodes.player import DEPTH, LiveReplay
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import GraphError
from magnetosuture_thread.settings.files import whole_folder

if TYPE_CHECKING:
    from typing_extensions import Unpack

START_TIMEOUT = 240.0  # s for all nodes to be there; the first start on a machine compiles
POLL_PERIOD = 0.02  # s between two looks at the nodes
TOO_SLOW = "machine too slow"


def arguments_of(parameters: Mapping[str, object]) -> list[str]:
    """Return arguments for nodes, after `--ros-args`, from parameters by name, as `coil_bridge:driver`."""
    return [part for name, value in parameters.items() for part in ("-p", f"{name}:={value}")]


# Whatever a setup says for a launch, nobody would activate the nodes of a command.
OWN = arguments_of({f"{name}:autostart": "active" for name in interface.STANDBY_NODES})
# Ahead in s, and between two forecasts: what page and recording show, without poses that come late for it.
FORECAST = arguments_of({"thread_model:forecast_horizon": 3.0, "thread_model:forecast_period": 0.2})


@contextmanager
def own_domain() -> Iterator[int]:
    """Yield a ROS domain that nobody else uses; this process has the environment for it meanwhile.

    Raises:
        GraphError: all domains are in use.
    """
    with processes.reserved_domain() as domain, processes.environment_of(processes.graph_environment(domain)):
        yield domain


class OwnGraph(NamedTuple):
    """Nodes that run in a ROS domain of their own.

    Attributes:
        domain: the ROS domain.
        nodes: the processes.
        interruption: keeps Ctrl-C until `check` is called, while entered.
    """

    domain: int
    nodes: processes.NodeProcesses
    interruption: processes.Interruption

    def check(self) -> None:
        """Raise `KeyboardInterrupt` if a person has interrupted, and `GraphError` if a node has ended."""
        self.interruption.check()
        self.nodes.check()


@contextmanager
def own_graph(programs: Sequence[str], arguments: Sequence[str], logs: Path, what: str, log: Log) -> Iterator[OwnGraph]:
    """Start nodes in a ROS domain of their own; they are ended with the context.

    Args:
        programs: that the nodes run as.
        arguments: for each, after `--ros-args`.
        logs: folder that gets a log file of each.
        what: starts, as it is logged.
        log: called with a line for a person.

    Raises:
        GraphError: all domains are in use.
    """
    with own_domain() as domain:
        log(f"starting {what} (ROS domain {domain}, this machine only)")
        with processes.NodeProcesses(programs, arguments, dict(os.environ), logs) as nodes:
            yield OwnGraph(domain, nodes, processes.Interruption())


def log_compiling(texts: Mapping[str, str], logged: set[str], log: Log) -> None:
    """Log, once of each node, that it compiles.

    Args:
        texts: state of each node.
        logged: nodes of which it was logged; grows.
        log: called with a line for a person.
    """
    for name, text in texts.items():
        if text.startswith(COMPILING) and name not in logged:
            logged.add(name)
            log(f"{name}: {text}")


class GraphInput:
    """Messages of a bag to play into running nodes, and how these nodes are started.

    Args:
        bag: and its setup.

    Attributes:
        bag: and its setup.
        transport: how the bag has its camera frames, raw or compressed; empty where poses are played.
        nodes: names of the graph's nodes; poses are played without a tracker.
        processes: programs that these nodes run as.
        channels: that are played.
    """

    def __init__(self, bag: recorded.BagInput) -> None:
        self.bag = bag
        camera = bag.recording.camera if bag.source == "camera" else None
        self.transport = next((transport for transport, channel in interface.CAMERA.items() if channel == camera), "")
        self.nodes = tuple(name for name in interface.NODES if self.transport or name != "vision_tracker")
        self.processes = interface.PROCESSES if self.transport else self.nodes
        poses = (interface.NEEDLE_POSE, interface.MEASURED_THREAD, interface.THREAD_OBSERVATION)
        source = (camera, interface.CAMERA_INFO, interface.NEEDLE_TIP) if camera is not None else poses
        possible = (*source, interface.NEEDLE_COMMAND, interface.MATERIAL)
        counts = bag.recording.counts
        self.channels = [interface.SCENE, *(channel for channel in possible if counts.get(channel.recorded))]

    def arguments(self, qos: Path) -> list[str]:
        """Return the nodes' arguments.

        Args:
            qos: a file that this writes: parameters under which no message is lost; `scene.yaml` is written beside it.
        """
        qos.write_text(yaml.safe_dump(topics.lossless(DEPTH)), encoding="utf-8")
        files = [part for path in (self.bag.setup.path, qos) for part in ("--params-file", str(path.resolve()))]
        # Nodes begin in the scene that is played, also where the setup's file names one of another machine.
        scene = qos.with_name("scene.yaml")
        write_scene(self.bag.setup.scene, scene)
        parameters: dict[str, object] = {"scene": scene.resolve(), "use_sim_time": "true"}
        # A replayed bag never moves a needle, so its bridge may arm itself.
        parameters |= {"coil_bridge:driver": "recording", "coil_bridge:autostart": "armed"}
        if self.transport:
            parameters["vision_tracker:image_transport"] = self.transport
        return [*files, *OWN, *arguments_of(parameters)]

    def records(self) -> Iterator[RecordedMessage]:
        """Yield the messages to play, by time."""
        bag = self.bag
        # The scene comes first: the one that is in force in the bag, or else the setup's.
        version, data = bag.setup.scene.version, packed_scene(bag.begin, bag.setup.scene)
        yield RecordedMessage(interface.SCENE.recorded, interface.SCENE.type_name, bag.begin, data)
        if bag.start > 0.0:  # what came before about the thread is in force
            earlier = [channel for channel in recorded.CHANGING if channel != interface.SCENE]
            for record in bag.recording.records(earlier, duration=bag.start):
                yield replace(record, time=bag.begin)
        for record in bag.recording.records(self.channels, start=bag.start, duration=bag.duration):
            if record.topic == interface.SCENE.recorded:
                before, version = version, str(record.decode().version)
                if version == before:
                    continue
            yield record

    def live(self, domain: int, rate: float, receive: Receive, check: Callable[[], None], log: Log) -> LiveReplay:
        """Return the node that plays the bag; see `LiveReplay`."""
        known = (*topics.INPUTS, *topics.SETTINGS, *topics.OUTPUTS)
        return LiveReplay(
            domain,
            Timeline(self.bag.begin, rate),
            bag_start=self.bag.recording.start,
            played=[topic for topic in known if topic.channel in self.channels],
            nodes=len(self.nodes),
            receive=receive,
            watch=check,
            log=log,
        )


def replay_live(
    bag_path: Path,
    output: Path,
    *,
    rate: float = 1.0,
    loop: bool = False,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[recorded.BagSelection],
) -> ReplaySummary:
    """Play a bag through the nodes as processes of their own, and evaluate their outputs.

    `output` is made at the end, whole or not at all: `bag/` with all outputs, `summary.json`,
    `summary.png` and the nodes' `logs/`. The coil bridge gets the recording driver, whatever the setup
    says: a replayed bag never moves a needle. By its poses a bag is played without a tracker.

    Args:
        bag_path: a bag.
        output: folder to make.
        rate: how much faster than recorded.
        loop: whether it is played over and over until it is interrupted; the first pass is recorded and evaluated.
        log: called with a line for a person at each stage.
        progress: called with the share played, 0 to 1.
        selection: what of the bag is played; the thread starts as it is first measured from then on.

    Raises:
        BagError: the bag cannot be used, or the output exists or cannot be written.
        ConfigurationError: the setup cannot be used.
        GraphError: a node ended or did not come, or nothing was predicted.
        KeyboardInterrupt: interrupted before the first pass was done.
    """
    with recorded.open_bag(bag_path, log, **selection) as bag:
        if loop:
            bag.check_loop()
        checked = _check_poses(bag, log)
        if rate < 1.0:
            log("played slower than recorded: the coil bridge's watchdog, in real time, may stop between commands")
        if rate > 1.0:
            log("played faster than recorded: latencies count what waits in the queues")
        problem = ""
        with whole_folder(output) as folder, TemporaryDirectory() as spare:
            source = GraphInput(bag)
            arguments, logs = source.arguments(Path(spare) / "lossless.yaml"), folder / "logs"
            with own_graph(source.processes, arguments, logs, ", ".join(source.nodes), log) as graph:
                outputs = BagWriter(folder / "bag", bag.notes)
                for topic in (topics.SCENE, *topics.OUTPUTS):
                    outputs.add_topic(topic.channel.recorded, topic.channel.type_name)
                with closing(source.live(graph.domain, rate, outputs.write, graph.check, log)) as live:
                    with outputs, graph.interruption:
                        live.wait_for_graph()
                        speed = f" at {rate:g} times the speed" if rate != 1.0 else ""
                        log(f"playing {bag.duration:.1f} s{speed}")
                        pause = f"ROS_DOMAIN_ID={graph.domain} ros2 service call /{interface.Service.PAUSE_REPLAY}"
                        log(f'to pause: {pause} std_srvs/srv/SetBool "{{data: true}}", to go on: false')
                        live.play(source.records(), lambda time: progress(min(1.0, time / max(bag.duration, 1e-9))))
                    log("evaluating the outputs")
                    metrics, summary = _summary(bag, folder, live, **checked)
                    replay.write_results(folder, bag, metrics, summary, log)
                    if late := lateness(summary, bag.setup.coils.pose_timeout, rate):
                        log(f"{TOO_SLOW}: {late}")
                    if loop:
                        log("the first pass is recorded and evaluated; playing on until Ctrl-C")
                        try:
                            with suppress(KeyboardInterrupt), graph.interruption:
                                live.play_on(source.records)
                        except GraphError as error:
                            problem = f"{error}; the first pass is in {output}"
    if problem:
        raise GraphError(problem)
    return summary


def lateness(summary: ReplaySummary, pose_timeout: float, rate: float) -> str:
    """Return that predictions came later than coils wait for a pose, and what to do; empty if they did not.

    Args:
        summary: of a replay.
        pose_timeout: age of a pose from which on coils rest [s].
        rate: how much faster than recorded it was played.
    """
    latency = summary.latency["frame to prediction" if summary.source == "camera" else "pose to prediction"]
    if latency is None or rate * latency.p99 <= pose_timeout:
        return ""
    limit = f"with poses older than {pose_timeout:g} s coils rest"
    return f"predictions came {latency.p99:.2g} s late (99th percentile); {limit}; try --rate {0.5 * rate:g}"


def _check_poses(bag: recorded.BagInput, log: Log) -> dict[str, Any]:
    """Check recorded poses and threads before any node starts; return `remark`, and what is `refused`."""
    if bag.source == "camera":
        return {}
    observations = recorded.ObservationReader(bag)
    for _ in observations:
        pass
    if remark := observations.thread_problem():
        log(remark)
    return {"remark": remark, "refused": dict(observations.refused)}


def _summary(bag: recorded.BagInput, folder: Path, live: LiveReplay, **others: Any) -> tuple[RunMetrics, ReplaySummary]:
    """Compare the outputs with what the bag holds."""
    collector, before, replayed = GraphCollector(), CurrentSeries(), CurrentSeries()
    truth = interface.GROUND_TRUTH_THREAD, interface.GROUND_TRUTH_PULL
    expected = [c for c in (*truth, interface.CURRENTS) if bag.recording.counts.get(c.recorded)]
    for record in bag.recording.records(expected, start=bag.start, duration=bag.duration):
        if record.topic == interface.CURRENTS.recorded:
            before.add(record.decode())
        else:
            collector.add(record.topic, record.decode())
    outputs = Bag(folder / "bag")
    for record in outputs.records(set(outputs.topics)):
        message = record.decode()
        collector.add(record.topic, message)
        if record.topic == interface.CURRENTS.recorded:
            replayed.add(message)
    length, losses = bag.setup.model.thread_length, live.losses
    metrics = RunMetrics.of(length, collector.frames(), bag.recording.start)
    frames, things, channel = losses.frames_played, "frames", bag.recording.camera
    if bag.source == "poses":
        frames, things, channel = losses.played[interface.NEEDLE_POSE.name], "poses", interface.NEEDLE_POSE
    if not len(metrics.series):
        health = "; ".join(f"{name}: {text}" for name, text in sorted(collector.health.items()))
        raise GraphError(f"none of {frames} {things} gave a prediction, {collector.poses} had a needle; {health}")
    commands = live.published.get(interface.NEEDLE_COMMAND.name, {})
    counts: dict[str, Any] = {"frames": frames, "tracked": collector.poses, "commands": len(commands)}
    counts |= {"driven": len(collector.applied & set(commands)), "dropped": losses.dropped()}
    others["latency"] = stage_latencies(live.published, live.arrived, collector.applied)
    others["currents"] = replayed.against(before)
    stamps = np.array([*(live.published[channel.name] if channel is not None else ())], dtype=np.int64)
    times = 1e-9 * (stamps - bag.recording.start).astype(np.float64)
    others["silence"] = SensorSilence.of(times, bag.start, bag.start + bag.duration)
    return metrics, replay.replay_summary(bag, metrics, **counts, **others)
