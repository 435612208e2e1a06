"""Plays recorded messages into the running graph and takes what comes out."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import rclpy
import rclpy.time
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_system_default
from rclpy.serialization import deserialize_message
from rosgraph_msgs.msg import Clock

from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.interface import CAMERA, CAMERA_INFO, CURRENTS, DIAGNOSTICS, NODES
from magnetosuture_thread.nodes import messages, topics
from magnetosuture_thread.nodes.coil_messages import command_stamp

CLOCK_PERIOD = 0.01  # s of simulated time between two messages on /clock
START_TIMEOUT = 180.0  # s for all nodes to be there
# s after we have found all nodes, for the nodes to have found us and each other: DDS announces a node a few times as it
# starts and then each 3 s, and on a busy machine the first of these get lost.
SETTLE = 3.2
QUIET = 0.5  # s without any answer, once the tracker has taken all frames: the graph is done
DRAIN_TIMEOUT = 30.0  # s after the last input at the most
DEPTH = 300  # messages that may wait for a slow node before any is lost
_AT_ONCE = 100  # outputs taken between two inputs at the most


class Recorded(Protocol):
    """A recorded message: see `bags.reader.Record`."""

    @property
    def topic(self) -> str:
        """With its leading slash."""

    @property
    def time(self) -> int:
        """When it was recorded [ns]."""

    @property
    def data(self) -> bytes:
        """CDR bytes."""


class LiveReplay:
    """A node that plays messages into the graph with /clock, and passes on all outputs.

    Args:
        domain: the graph's ROS domain.
        start: the simulated time to begin with [ns].
        rate: how much faster than recorded.
        receive: called with topic, simulated time [ns] and CDR bytes of every output.
        watch: called while waiting; raises if the graph is broken.

    Attributes:
        published: of each input topic, when the message of a stamp was published [s].
        arrived: of each output topic, when the first message of a stamp arrived [s]; of currents, of a command's stamp.
    """

    def __init__(
        self,
        domain: int,
        start: int,
        rate: float,
        receive: Callable[[str, int, bytes], None],
        watch: Callable[[], None],
    ) -> None:
        self._start = start
        self._rate = rate
        self._receive = receive
        self._watch = watch
        self._began: float | None = None
        self._last_answer = time.perf_counter()
        self._taken = 0
        self._frames_taken = 0
        self.published: dict[str, dict[int, float]] = defaultdict(dict)
        self.arrived: dict[str, dict[int, float]] = defaultdict(dict)
        self._context = Context()
        rclpy.init(context=self._context, domain_id=domain, args=[])
        self._node = rclpy.create_node("replay", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._clock = self._node.create_publisher(Clock, "/clock", qos_profile_system_default)
        self._inputs = {
            topic.channel.recorded: self._node.create_publisher(topic.message, topic.name, _lossless(topic.qos))
            for topic in topics.INPUTS
        }
        self._outputs = {
            topic.name: self._node.create_subscription(
                topic.message, topic.name, self._taker(topic), _lossless(topic.qos), raw=True
            )
            for topic in topics.OUTPUTS
        }

    def close(self) -> None:
        """Leave the graph."""
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def wait_for_graph(self, played: Iterable[str]) -> None:
        """Wait until every played input has a subscriber and every output a publisher.

        Args:
            played: input topics that will be played, with their leading slash.

        Raises:
            GraphError: the nodes do not come, or one ends.
        """
        needed = [name for name in played if name != CAMERA_INFO.recorded]
        deadline = time.perf_counter() + START_TIMEOUT
        complete: float | None = None
        while complete is None or time.perf_counter() - complete < SETTLE:
            self._watch()
            self._publish_clock(self._start)
            self._executor.spin_once(timeout_sec=0.02)
            missing = [name for name in needed if not self._inputs[name].get_subscription_count()]
            missing += [name for name, output in self._outputs.items() if not output.get_publisher_count()]
            if self._clock.get_subscription_count() < len(NODES):
                missing.append("/clock")
            if missing:
                complete = None
            elif complete is None:
                complete = time.perf_counter()
            if time.perf_counter() > deadline:
                raise GraphError(f"after {START_TIMEOUT:g} s the graph is not complete: nobody at {', '.join(missing)}")

    def play(self, records: Iterable[Recorded], progress: Callable[[float], None]) -> None:
        """Play messages at their times, then wait until the graph has answered.

        Args:
            records: by time; topics that are no inputs are passed over.
            progress: called with the time played since the start [s].
        """
        self._began = time.perf_counter()
        clock = self._start
        frames = 0
        for record in records:
            publisher = self._inputs.get(record.topic)
            if publisher is None:
                continue
            clock = self._run_clock(clock, record.time)
            self._publish_clock(record.time)
            stamp = messages.header_stamp(record.data)
            if stamp is not None:
                self.published[record.topic.lstrip("/")][stamp] = time.time()
            publisher.publish(record.data)
            frames += record.topic in {channel.recorded for channel in CAMERA.values()}
            progress((record.time - self._start) * 1e-9)
        self._drain(clock, frames)

    def _drain(self, clock: int, frames: int) -> None:
        """Let time go on until the tracker has taken all frames and no more answers come."""
        deadline = time.perf_counter() + DRAIN_TIMEOUT
        self._last_answer = time.perf_counter()
        while time.perf_counter() < deadline:
            if self._frames_taken >= frames and time.perf_counter() > self._last_answer + QUIET:
                return
            clock = self._run_clock(clock, clock + round(CLOCK_PERIOD * 1e9))

    def _run_clock(self, clock: int, until: int) -> int:
        """Publish /clock up to a simulated time, taking outputs all the while; return the next tick."""
        self._take_waiting()
        while clock < until:
            self._spin_until(clock)
            self._publish_clock(clock)
            clock += round(CLOCK_PERIOD * 1e9)
        self._spin_until(until)
        return clock

    def _take_waiting(self) -> None:
        """Take outputs that have come already, however late we are."""
        self._watch()
        for _ in range(_AT_ONCE):
            before = self._taken
            self._executor.spin_once(timeout_sec=0.0)
            if self._taken == before:
                return

    def _spin_until(self, simulated: int) -> None:
        """Take outputs until the wall clock reaches a simulated time."""
        assert self._began is not None
        due = self._began + (simulated - self._start) * 1e-9 / self._rate
        while (left := due - time.perf_counter()) > 0.0:
            self._watch()
            self._executor.spin_once(timeout_sec=min(left, 0.01))

    def _simulated(self) -> int:
        """Return the simulated time now [ns]; before playing it stands still."""
        if self._began is None:
            return self._start
        return self._start + round((time.perf_counter() - self._began) * self._rate * 1e9)

    def _taker(self, topic: topics.Topic) -> Callable[[Any, Any], None]:
        """Return the callback of an output topic."""
        name = topic.channel.name
        answers = topic in (topics.NEEDLE_POSE, topics.SEEN_THREAD, topics.PREDICTED_THREAD, topics.MARGINS)

        def take(data: bytes, info: dict[str, int]) -> None:
            now = time.perf_counter()
            self._taken += 1
            stamp = command_stamp(data) if topic.channel is CURRENTS else messages.header_stamp(data)
            if stamp is not None:
                # When it reached this process: how long it waited here for its turn is not the graph's delay.
                self.arrived[name].setdefault(stamp, info["received_timestamp"] * 1e-9)
            if answers:
                self._last_answer = now
            if topic.channel is DIAGNOSTICS:
                self._frames_taken = max(self._frames_taken, _frames_taken(data))
            self._receive(topic.channel.recorded, self._simulated(), bytes(data))

        return take

    def _publish_clock(self, simulated: int) -> None:
        self._clock.publish(Clock(clock=rclpy.time.Time(nanoseconds=simulated).to_msg()))


def _lossless(qos: QoSProfile) -> QoSProfile:
    """Return a quality of service that waits for slow readers; only the replay has time to."""
    return QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=qos.durability)


def _frames_taken(data: bytes) -> int:
    """Return how many frames the tracker says that it has taken; 0 if this is another node's message."""
    for status in deserialize_message(data, DiagnosticArray).status:
        for value in status.values:
            if value.key == "frames":
                return int(value.value)
    return 0
