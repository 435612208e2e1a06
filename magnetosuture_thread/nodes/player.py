"""Plays recorded messages into the running graph, and passes on its outputs."""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any, TypeAlias

import rclpy.time
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_system_default
from rosgraph_msgs.msg import Clock

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.bags.reading import header_stamp, nanoseconds
from magnetosuture_thread.bags.storage import MAX_SILENCE, silence_text
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.clients import Participant, Receive, listen
from magnetosuture_thread.nodes.executor import Timeline
from magnetosuture_thread.nodes.node import read_report
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import GraphError

CLOCK_PERIOD = 10_000_000  # ns of simulated time between two messages on /clock
START_TIMEOUT = 180.0  # s for all nodes to be there
# s after we have found all nodes, for the nodes to have found us and each other: DDS announces a node a few times as it
# starts and then each 3 s, and on a busy machine the first of these get lost.
SETTLE = 3.2
QUIET = 0.5  # s without any answer, once all has been taken and answered: the graph is done
DEPTH = 300  # messages that may wait for a slow node before any is lost
Recorded: TypeAlias = Any  # a recorded message: `topic`, `time` [ns] and `data` (CDR bytes)


class Losses:
    """Keeps count of a replay.

    Args:
        arrived: stamps of the outputs that have come, by topic.

    Attributes:
        played: messages published, by topic.
        frames_taken: camera frames that the tracker says it has taken.
    """

    def __init__(self, arrived: Mapping[str, Mapping[int, float]]) -> None:
        self.played: Counter[str] = Counter()
        self.frames_taken = 0
        self._arrived = arrived
        self._refused: dict[str, int] = {}
        self._numbers: dict[str, int] = {}
        self._taken: Counter[str] = Counter()

    @property
    def frames_played(self) -> int:
        """Return the camera frames published."""
        return sum(self.played[channel.name] for channel in interface.CAMERA.values())

    @property
    def unanswered(self) -> int:
        """Return how many poses have not been answered yet; one that the model refuses never is."""
        channels = interface.NEEDLE_POSE, interface.PREDICTED_THREAD, interface.MARGINS
        poses, *answers = (set(self._arrived.get(channel.name, ())) for channel in channels)
        return len(poses.difference(*answers))

    def heard(self, topic: str, number: int | None) -> None:
        """Count an output of the graph, by the number that its publisher gave it, if the middleware tells."""
        if number is not None and number != topics.UNNUMBERED:
            self._numbers[topic] = max(self._numbers.get(topic, 0), number)
            self._taken[topic] += 1

    def count_diagnostics(self, data: bytes) -> None:
        """Count a node's status on /diagnostics."""
        for node, (_, values) in read_report(topics.DIAGNOSTICS.decode(data)).items():
            if node == "vision_tracker":
                self.frames_taken = max(self.frames_taken, int(values.get("frames", "0")))
            self._refused[node] = int(values.get("refused", "0"))

    def dropped(self) -> dict[str, int]:
        """Return how many messages got lost, by the way on which."""
        unanswered = self.unanswered - self._refused.get("thread_model", 0)
        unheard = sum(max(0, number - self._taken[topic]) for topic, number in self._numbers.items())
        counts = {"poses without an answer": max(0, unanswered), "outputs lost by the recording": unheard}
        if self.frames_played:
            counts = {"frames not taken by vision_tracker": self.frames_played - self.frames_taken, **counts}
        return counts


class LiveReplay(Participant):
    """A node that plays messages into the graph with /clock, and passes on all outputs.

    What it plays that is an output of a node otherwise, as poses are where no tracker runs, it passes on as well. Its
    service `replay/pause` lets time stand still.

    Args:
        domain: the graph's ROS domain.
        timeline: the simulated time.
        bag_start: time of the bag's first message [ns].
        played: topics to play.
        nodes: how many nodes there are to be; all follow /clock.
        receive: called with topic, simulated time [ns] and CDR bytes of every output.
        watch: called while waiting; raises if the graph is broken.
        log: called with a line for a person when time stands still or goes on.

    Attributes:
        published: of each input topic, when the message of a stamp was published [s].
        arrived: of each output topic, when the first message of a stamp arrived [s]; of currents, of a command's stamp.
        losses: what was played, taken and lost.
    """

    def __init__(
        self,
        domain: int,
        timeline: Timeline,
        *,
        bag_start: int,
        played: Collection[topics.Topic],
        nodes: int,
        receive: Receive,
        watch: Callable[[], None],
        log: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._time, self._bag_start, self._nodes = timeline, bag_start, nodes
        self._receive, self._watch, self._log = receive, watch, log
        self._last_answer = time.perf_counter()
        self._still, self._last_clock = timeline.start, 0.0
        self.published: dict[str, dict[int, float]] = defaultdict(dict)
        self.arrived: dict[str, dict[int, float]] = defaultdict(dict)
        self.losses = Losses(self.arrived)
        super().__init__("replay", domain=domain)
        self.node.serve(interface.Service.PAUSE_REPLAY, self._on_pause)
        self._clock = self.node.create_publisher(Clock, "/clock", qos_profile_system_default)
        self._inputs = {}
        for topic in played:  # by a quality of service that waits for slow readers: only the replay has time to
            quality = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=topic.qos.durability)
            self._inputs[topic.channel.recorded] = self.node.create_publisher(topic.message, topic.name, quality)
        echoed = set(played) & set(topics.OUTPUTS)
        self._echoed = {topic.channel.recorded for topic in echoed}
        # Poses are played where no tracker runs.
        unheard = {*echoed, topics.TRACKER_STATE, topics.THREAD_OBSERVATION} if echoed else set()
        self._outputs = {
            topic: listen(self.node, topic, DEPTH, partial(self._on_output, topic), reliable=True)
            for topic in topics.OUTPUTS
            if topic not in unheard
        }

    def wait_for_graph(self) -> None:
        """Wait until every played input has a subscriber and every output a publisher.

        Raises:
            GraphError: the nodes do not come, or one ends.
        """
        deadline = time.perf_counter() + START_TIMEOUT
        complete: float | None = None
        while complete is None or time.perf_counter() - complete < SETTLE:
            self._take()
            self._publish_clock(self._time.start)
            time.sleep(0.02)
            unnoticed = (interface.CAMERA_INFO.recorded, interface.SCENE.recorded)
            publishers = [pair for pair in self._inputs.items() if pair[0] not in unnoticed]
            missing = [name for name, publisher in publishers if not publisher.get_subscription_count()]
            heard = [pair for pair in self._outputs.items() if pair[0] is not topics.FORECAST]  # by request
            missing += [topic.name for topic, subscription in heard if not subscription.get_publisher_count()]
            if self._clock.get_subscription_count() < self._nodes:
                missing.append("/clock")
            complete = None if missing else complete or time.perf_counter()
            if time.perf_counter() > deadline:
                raise GraphError(f"after {START_TIMEOUT:g} s the graph is not complete: nobody at {', '.join(missing)}")

    def play(self, records: Iterable[Recorded], progress: Callable[[float], None]) -> None:
        """Play messages at their times, then wait until the graph has answered.

        Args:
            records: by time; topics that are not played are passed over.
            progress: called with the time played since the start [s].
        """
        self._time.begin()
        clock = last = reached = self._time.start
        for record in records:
            if (publisher := self._inputs.get(record.topic)) is None:
                continue
            if record.time - last > 1e9 * MAX_SILENCE:
                clock = reached = self._drain(clock)  # what is under way belongs before the silence
                if clock < record.time:
                    self._log(silence_text((last - self._bag_start) * 1e-9, (record.time - self._bag_start) * 1e-9))
                    self._time.skip_to(record.time)
                    clock = record.time
            last = record.time
            clock = self._run_clock(clock, record.time)
            self._publish_clock(max(record.time, reached))
            self._publish(publisher, record)
            progress((record.time - self._time.start) * 1e-9)
        self._drain(clock)

    def play_on(self, records: Callable[[], Iterable[Recorded]]) -> None:
        """Play messages over and over, for who watches; nothing is recorded any more.

        Time is set back before each pass, and the nodes begin anew.
        """
        self._receive = lambda topic, time, data: None
        while True:
            self.arrived.clear()
            self.losses = Losses(self.arrived)
            self.play(records(), lambda time: None)

    def _publish(self, publisher: Any, record: Recorded) -> None:
        name, stamp, now = record.topic.lstrip("/"), header_stamp(record.data), time.time()
        publisher.publish(record.data)
        self.losses.played[name] += 1
        if stamp is not None:
            self.published[name][stamp] = now
        if record.topic in self._echoed and stamp is not None:
            self.arrived[name].setdefault(stamp, now)
        if record.topic in (interface.SCENE.recorded, *self._echoed):
            self._receive(record.topic, record.time, bytes(record.data))

    def _drain(self, clock: int) -> int:
        """Let time go on until the graph has taken and answered all, and no more answers come; return the next tick."""
        deadline = self._time.running() + 30.0
        self._last_answer = time.perf_counter()
        while self._time.running() < deadline:
            losses = self.losses
            enough = 3.0 if losses.unanswered else QUIET  # s; poses that are left the model refuses, or they got lost
            if losses.frames_taken >= losses.frames_played and time.perf_counter() > self._last_answer + enough:
                break
            clock = self._run_clock(clock, clock + CLOCK_PERIOD)
        return clock

    def _run_clock(self, clock: int, until: int) -> int:
        """Publish /clock up to a simulated time, taking outputs all the while; return the next tick."""
        self._take()  # however late we are
        while clock < until:
            self._wait_until(clock)
            self._publish_clock(clock)
            clock += CLOCK_PERIOD
        self._wait_until(until)
        return clock

    def _wait_until(self, simulated: int) -> None:
        """Take outputs until a simulated time is there."""
        while (left := self._time.left(simulated)) > 0.0:
            self._take()
            time.sleep(min(left, 0.002))
            if self._time.paused and time.perf_counter() - self._last_clock > 0.1:
                self._publish_clock(self._still)

    def _take(self) -> None:
        """Take the outputs that have come, and answer requests."""
        self._watch()
        self.spin_some()

    def _on_output(self, topic: topics.Topic, data: bytes, info: dict[str, Any]) -> None:
        with suppress(InvalidInputError, ValueError):  # not a message of ours
            is_currents = topic.channel is interface.CURRENTS  # which count by the command that they follow, if any
            stamp = nanoseconds(topic.decode(data).command) or None if is_currents else header_stamp(data)
            if stamp is not None:
                # When it reached this process: how long it waited here for its turn is not the graph's delay.
                self.arrived[topic.channel.name].setdefault(stamp, info["received_timestamp"] * 1e-9)
            if topic in (topics.NEEDLE_POSE, topics.MEASURED_THREAD, topics.PREDICTED_THREAD, topics.MARGINS):
                self._last_answer = time.perf_counter()
                self.losses.heard(topic.channel.name, info["publication_sequence_number"])
            if topic.channel is interface.DIAGNOSTICS:
                self.losses.count_diagnostics(data)
            self._receive(topic.channel.recorded, self._time.now(), data)

    def _on_pause(self, request: Any) -> str:
        message = self._time.on_pause(request)
        self._log(message)
        return message

    def _publish_clock(self, simulated: int) -> None:
        self._still, self._last_clock = simulated, time.perf_counter()
        self._clock.publish(Clock(clock=rclpy.time.Time(nanoseconds=simulated).to_msg()))
