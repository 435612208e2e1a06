"""The job `magnetosuture replay`: a recorded bag through the live graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import BagError, GraphError
from magnetosuture_thread.evaluation.graph_outputs import (
    CurrentSeries,
    GraphCollector,
    ReplaySummary,
)
from magnetosuture_thread.evaluation.metrics import stage_latencies
from magnetosuture_thread.interface import (
    CURRENTS,
    GROUND_TRUTH_THREAD,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    PAUSE_REPLAY,
)
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.jobs.playing import MIN_LOOP_DURATION, Playing
from magnetosuture_thread.jobs.replay_inputs import Given, opened, replay_summary, write_results
from magnetosuture_thread.offline.predictions import read_observations

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.interruption import Interruption
    from magnetosuture_thread.nodes.replay import LiveReplay

Log = Callable[[str], None]
Progress = Callable[[float], None]


def replay_live(
    bag_path: Path,
    output: Path,
    *,
    setup_name: str = "",
    rate: float = 1.0,
    source: str = "auto",
    start: float = 0.0,
    duration: float | None = None,
    loop: bool = False,
    remap: Mapping[str, str] | None = None,
    frame: str = "dish",
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
) -> ReplaySummary:
    """Play a bag through the nodes as processes of their own, and judge what they made of it.

    `output` is made at the end, whole or not at all: `bag/` with all outputs, `summary.json`,
    `summary.png` and the nodes' `logs/`. The coil bridge gets the recording driver, whatever the set-up
    says: a replayed bag never moves a needle. By its poses a bag is played without a tracker.

    Args:
        bag_path: a bag.
        output: folder to make.
        setup_name: name or path of the set-up; the one the bag names if empty.
        rate: how much faster than recorded.
        source: `camera`, `poses`, or `auto`: the camera where there are frames.
        start: seconds into the bag to begin at; the thread starts as it is first seen from then on.
        duration: [s]; to the bag's end if None.
        loop: whether it is played over and over until it is interrupted; the first pass is recorded and judged.
        remap: other names for topics of the bag, by the old one.
        frame: the bag's name of the dish frame.
        log: called with a line for a person at each stage.
        progress: called with the share played, 0 to 1.

    Raises:
        BagError: the bag cannot be used, or the output exists or cannot be written.
        ConfigurationError: the set-up cannot be used.
        GraphError: a node ended or did not come, or nothing was predicted.
        KeyboardInterrupt: interrupted before the first pass was done.
    """
    with ExitStack() as stack:
        given = stack.enter_context(
            opened(
                bag_path,
                setup_name=setup_name,
                source=source,
                start=start,
                duration=duration,
                remap=remap or {},
                frame=frame,
                log=log,
            )
        )
        if loop and given.duration < MIN_LOOP_DURATION:
            raise BagError(
                bag_path,
                f"gives {given.duration:.2f} s to play over and over; expected {MIN_LOOP_DURATION:g} s or more",
            )
        remark, refused = _look_through(given, log)
        if rate < 1.0:
            log("played slower than recorded: the coil bridge's watchdog, in real time, may stop between commands")
        if rate > 1.0:
            log("played faster than recorded: latencies count what waits in the queues")
        folder = stack.enter_context(whole_folder(output))
        job = _Replay(given, folder, rate, remark, refused, log, progress)
        summary, problem = job.run(loop)
    if problem:
        raise GraphError(f"{problem}; the first pass is in {output}")
    return summary


def _look_through(given: Given, log: Log) -> tuple[str, dict[str, int]]:
    """Check recorded poses and threads before any node starts; return what is odd, and what cannot be used."""
    if given.source == "camera":
        return "", {}
    looked = read_observations(given.recording, given.setup, source="poses", start=given.start, duration=given.duration)
    for _ in looked:
        pass
    if remark := looked.thread_problem():
        log(remark)
    return remark, dict(looked.refused)


@dataclass
class _Replay:
    """One replay; see `replay`."""

    given: Given
    folder: Path
    rate: float
    remark: str
    refused: dict[str, int]
    log: Log
    progress: Progress

    def run(self, loop: bool) -> tuple[ReplaySummary, str]:
        """Play the bag into the graph, record and judge its outputs; return what went wrong later, as well."""
        # Only here, where it is needed: without ROS the other commands still work.
        from magnetosuture_thread.nodes import topics
        from magnetosuture_thread.nodes.interruption import Interruption
        from magnetosuture_thread.nodes.processes import (
            NodeProcesses,
            environment_of,
            graph_environment,
            reserved_domain,
        )
        from magnetosuture_thread.nodes.replay import LiveReplay
        from magnetosuture_thread.nodes.replay_time import Timeline

        qos = self.folder / "lossless.yaml"
        playing, interruption = Playing(self.given), Interruption()
        problem = ""
        with reserved_domain() as domain:
            environment = graph_environment(domain)
            self.log(f"starting {', '.join(playing.nodes)} (ROS domain {domain}, this machine only)")
            with (
                environment_of(environment),
                NodeProcesses(playing.processes, playing.arguments(qos), environment, self.folder / "logs") as nodes,
            ):
                outputs = BagWriter(self.folder / "bag", self.given.notes)
                for topic in (topics.SCENE, *topics.OUTPUTS):
                    outputs.add_topic(topic.channel.recorded, topic.channel.type_name)

                def watch() -> None:
                    interruption.check()
                    nodes.check()

                live = LiveReplay(
                    domain,
                    Timeline(self.given.begin, self.rate),
                    played=playing.topics(),
                    nodes=len(playing.nodes),
                    receive=outputs.write,
                    watch=watch,
                    log=self.log,
                )
                try:
                    with outputs, interruption:
                        self._play(live, f"ROS_DOMAIN_ID={domain} ros2 service call /{PAUSE_REPLAY}")
                    self.log("judging what came out")
                    summary = self._judge(live)
                    if loop:
                        problem = self._play_on(live, interruption)
                finally:
                    live.close()
        qos.unlink()
        qos.with_name("scene.yaml").unlink()
        return summary, problem

    def _play(self, live: LiveReplay, pause: str) -> None:
        live.wait_for_graph()
        at = f" at {self.rate:g} times the speed" if self.rate != 1.0 else ""
        self.log(f"playing {self.given.duration:.1f} s{at}")
        self.log(f'to pause: {pause} std_srvs/srv/SetBool "{{data: true}}", to go on: false')
        length = max(self.given.duration, 1e-9)
        live.play(Playing(self.given).records(), lambda time: self.progress(min(1.0, time / length)))

    def _play_on(self, live: LiveReplay, interruption: Interruption) -> str:
        """Play on for who watches; return what ended it, if it was not a person."""
        self.log("the first pass is recorded and judged; playing on until Ctrl-C")
        try:
            with interruption:
                live.play_on(Playing(self.given).records)
        except KeyboardInterrupt:
            self.log("ended")
        except GraphError as error:
            return str(error)
        return ""

    def _judge(self, live: LiveReplay) -> ReplaySummary:
        """Put the outputs side by side; write summary.json and summary.png."""
        given = self.given
        collector = GraphCollector(given.setup.model.thread_length)
        recorded, replayed = CurrentSeries(), CurrentSeries()
        truth = [c for c in (GROUND_TRUTH_THREAD, CURRENTS) if given.recording.counts.get(c.recorded)]
        for record in given.recording.records(truth, start=given.start, duration=given.duration):
            message = record.decode()
            collector.add(record.topic, message) if record.topic == GROUND_TRUTH_THREAD.recorded else recorded.add(
                message
            )
        made = Bag(self.folder / "bag")
        for record in made.records(set(made.topics)):
            message = record.decode()
            collector.add(record.topic, message)
            if record.topic == CURRENTS.recorded:
                replayed.add(message)
        metrics, losses = collector.metrics(given.recording.start), live.losses
        source = NEEDLE_POSE.name if given.source == "poses" else ""
        frames = losses.played[source] if source else losses.frames_played
        if not len(metrics.series):
            said = "; ".join(f"{name}: {text}" for name, text in sorted(collector.health.items()))
            things = "poses" if source else "frames"
            raise GraphError(f"none of {frames} {things} gave a prediction, {collector.poses} had a needle; {said}")
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
            refused=self.refused,
            dropped=losses.dropped(),
            remark=self.remark,
        )
        write_results(self.folder, given, metrics, summary, self.log)
        return summary
