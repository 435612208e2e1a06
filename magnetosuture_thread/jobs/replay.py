"""The job `magnetosuture replay`: a recorded bag through the live graph. It needs ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import yaml

from magnetosuture_thread.bags.reader import Bag, RecordedMessage
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.evaluation.graph_outputs import CurrentSeries, GraphCollector, ReplaySummary
from magnetosuture_thread.evaluation.metrics import RunMetrics, stage_latencies
from magnetosuture_thread.interface import (
    CAMERA,
    CAMERA_INFO,
    CURRENTS,
    GROUND_TRUTH_PULL,
    GROUND_TRUTH_THREAD,
    MEASURED_THREAD,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    NODES,
    PAUSE_REPLAY,
    PROCESSES,
    SCENE,
    THREAD_OBSERVATION,
    Channel,
)
from magnetosuture_thread.jobs.graph import JOB, OwnGraph, own_graph
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.jobs.replay_inputs import (
    BagInput,
    BagSelection,
    Log,
    Progress,
    open_bag,
    replay_summary,
    write_results,
)
from magnetosuture_thread.messages.scene import packed_scene
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.player import DEPTH, LiveReplay
from magnetosuture_thread.nodes.timeline import Timeline
from magnetosuture_thread.offline.observations import CHANGING
from magnetosuture_thread.offline.predictions import read_observations
from magnetosuture_thread.scene import write_scene

if TYPE_CHECKING:
    from typing_extensions import Unpack

# A replayed bag never moves a needle, so its bridge may arm itself.
NOTHING_MOVES = ("-p", "coil_bridge:driver:=recording", "-p", "coil_bridge:autostart:=armed")


@dataclass(frozen=True)
class GraphInput:
    """Messages of a bag to play into running nodes, and how these nodes are started.

    Attributes:
        given: the bag and its setup.
    """

    given: BagInput

    @property
    def channels(self) -> list[Channel]:
        """Channels that are played."""
        recording = self.given.recording
        source = (
            (recording.camera, CAMERA_INFO) if self.transport else (NEEDLE_POSE, MEASURED_THREAD, THREAD_OBSERVATION)
        )
        changing = (channel for channel in CHANGING if channel != SCENE)
        possible = (*source, NEEDLE_COMMAND, *changing)
        return [SCENE, *(channel for channel in possible if channel and recording.counts.get(channel.recorded))]

    @property
    def nodes(self) -> tuple[str, ...]:
        """Names of the graph's nodes; poses are played without a tracker."""
        return NODES if self.transport else tuple(name for name in NODES if name != "vision_tracker")

    @property
    def processes(self) -> tuple[str, ...]:
        """Programs that these nodes run as."""
        return PROCESSES if self.transport else self.nodes

    @property
    def transport(self) -> str:
        """How the bag has its camera frames, raw or compressed; empty where poses are played."""
        camera = self.given.recording.camera if self.given.source == "camera" else None
        return next((transport for transport, channel in CAMERA.items() if channel == camera), "")

    def topics(self) -> list[topics.Topic]:
        """Return the topics that are played."""
        known = (*topics.INPUTS, *topics.SETTINGS, *topics.OUTPUTS)
        return [topic for topic in known if topic.channel in self.channels]

    def arguments(self, qos: Path) -> list[str]:
        """Return the nodes' arguments.

        Args:
            qos: a file that this writes: parameters under which no message is lost; `scene.yaml` is written beside it.
        """
        qos.write_text(yaml.safe_dump(topics.lossless(DEPTH)), encoding="utf-8")
        files = [part for path in (self.given.setup.path, qos) for part in ("--params-file", str(path.resolve()))]
        # Nodes begin in the scene that is played, also where the setup's file names one of another machine.
        scene = qos.with_name("scene.yaml")
        write_scene(self.given.setup.scene, scene)
        arguments = [*files, "-p", f"scene:={scene.resolve()}", "-p", "use_sim_time:=true", *NOTHING_MOVES, *JOB]
        if self.transport:
            arguments += ["-p", f"vision_tracker:image_transport:={self.transport}"]
        return arguments

    def records(self) -> Iterator[RecordedMessage]:
        """Give the messages to play, by time."""
        given = self.given
        # The scene comes first: the one that is in force in the bag, or else the setup's.
        data = packed_scene(given.begin, given.setup.scene)
        yield RecordedMessage(SCENE.recorded, SCENE.type_name, given.begin, data)
        if given.start > 0.0:  # what came before about the thread is in force
            earlier = [channel for channel in CHANGING if channel != SCENE]
            for record in given.recording.records(earlier, duration=given.start):
                yield replace(record, time=given.begin)
        version = given.setup.scene.version
        for record in given.recording.records(self.channels, start=given.start, duration=given.duration):
            if record.topic == SCENE.recorded:
                before, version = version, str(record.decode().version)
                if version == before:
                    continue
            yield record

    def live(
        self, domain: int, rate: float, receive: Callable[[str, int, bytes], None], check: Callable[[], None], log: Log
    ) -> LiveReplay:
        """Return the node that plays the bag; see `LiveReplay`."""
        return LiveReplay(
            domain,
            Timeline(self.given.begin, rate),
            played=self.topics(),
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
    **selection: Unpack[BagSelection],
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
    with open_bag(bag_path, log, **selection) as given:
        if loop:
            given.check_loop()
        remark, refused = _check_poses(given, log)
        if rate < 1.0:
            log("played slower than recorded: the coil bridge's watchdog, in real time, may stop between commands")
        if rate > 1.0:
            log("played faster than recorded: latencies count what waits in the queues")
        with whole_folder(output) as folder, TemporaryDirectory() as spare:
            source = GraphInput(given)
            arguments, logs = source.arguments(Path(spare) / "lossless.yaml"), folder / "logs"
            with own_graph(source.processes, arguments, logs, ", ".join(source.nodes), log) as graph:
                outputs = BagWriter(folder / "bag", given.notes)
                for topic in (topics.SCENE, *topics.OUTPUTS):
                    outputs.add_topic(topic.channel.recorded, topic.channel.type_name)
                live = source.live(graph.domain, rate, outputs.write, graph.check, log)
                try:
                    with outputs, graph.interruption:
                        live.wait_for_graph()
                        log(
                            f"playing {given.duration:.1f} s" + (f" at {rate:g} times the speed" if rate != 1.0 else "")
                        )
                        pause = f"ROS_DOMAIN_ID={graph.domain} ros2 service call /{PAUSE_REPLAY}"
                        log(f'to pause: {pause} std_srvs/srv/SetBool "{{data: true}}", to go on: false')
                        length = max(given.duration, 1e-9)
                        live.play(source.records(), lambda time: progress(min(1.0, time / length)))
                    log("evaluating the outputs")
                    summary = _summary(given, folder, live, refused=refused, remark=remark)
                    write_results(folder, given, *summary, log)
                    problem = _play_on(live, source, graph, log) if loop else ""
                finally:
                    live.close()
    if problem:
        raise GraphError(f"{problem}; the first pass is in {output}")
    return summary[1]


def _play_on(live: LiveReplay, source: GraphInput, graph: OwnGraph, log: Log) -> str:
    """Play on until Ctrl-C; return what ended it else."""
    log("the first pass is recorded and evaluated; playing on until Ctrl-C")
    try:
        with graph.interruption:
            live.play_on(source.records)
    except KeyboardInterrupt:
        log("ended")
    except GraphError as error:
        return str(error)
    return ""


def _check_poses(given: BagInput, log: Log) -> tuple[str, dict[str, int]]:
    """Check recorded poses and threads before any node starts; return a remark, and what cannot be used."""
    if given.source == "camera":
        return "", {}
    checked = read_observations(
        given.recording, given.setup, source="poses", start=given.start, duration=given.duration
    )
    for _ in checked:
        pass
    if remark := checked.thread_problem():
        log(remark)
    return remark, dict(checked.refused)


def _summary(given: BagInput, folder: Path, live: LiveReplay, **others: Any) -> tuple[RunMetrics, ReplaySummary]:
    """Compare the outputs with what the bag holds."""
    collector = GraphCollector(given.setup.model.thread_length)
    recorded, replayed = CurrentSeries(), CurrentSeries()
    truth = GROUND_TRUTH_THREAD, GROUND_TRUTH_PULL
    expected = [c for c in (*truth, CURRENTS) if given.recording.counts.get(c.recorded)]
    for record in given.recording.records(expected, start=given.start, duration=given.duration):
        if record.topic == CURRENTS.recorded:
            recorded.add(record.decode())
        else:
            collector.add(record.topic, record.decode())
    made = Bag(folder / "bag")
    for record in made.records(set(made.topics)):
        message = record.decode()
        collector.add(record.topic, message)
        if record.topic == CURRENTS.recorded:
            replayed.add(message)
    metrics, losses = collector.metrics(given.recording.start), live.losses
    frames = losses.played[NEEDLE_POSE.name] if given.source == "poses" else losses.frames_played
    if not len(metrics.series):
        health = "; ".join(f"{name}: {text}" for name, text in sorted(collector.health.items()))
        things = "poses" if given.source == "poses" else "frames"
        raise GraphError(f"none of {frames} {things} gave a prediction, {collector.poses} had a needle; {health}")
    commands = live.published.get(NEEDLE_COMMAND.name, {})
    summary = replay_summary(
        given,
        metrics,
        frames=frames,
        tracked=collector.poses,
        commands=len(commands),
        driven=len(collector.applied & set(commands)),
        latency=stage_latencies(live.published, live.arrived, collector.applied),
        currents=replayed.against(recorded),
        dropped=losses.dropped(),
        **others,
    )
    return metrics, summary
