"""The graph's topics in ROS: publishers and subscriptions of the channels in `interface`.

`topics.NEEDLE_POSE` is the topic of `interface.NEEDLE_POSE`, `topics.INPUTS` those of `interface.INPUTS`, and so for
every channel and tuple of channels there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import Any, ClassVar, Protocol

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.files import MAX_FILE_BYTES
from magnetosuture_thread.settings.interface import Channel, Quality

QUALITIES = {
    Quality.SENSOR: qos_profile_sensor_data,
    Quality.FRAMES: QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT),
    Quality.NEWEST: QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
    Quality.RELIABLE: QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE),
    Quality.LATCHED: QoSProfile(
        depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
    ),
}
# Bytes that a message may have, by the package of its type; what is larger is not even decoded. What is read often, or
# by a person's page, has little; a scene of the most shapes has 120 kB.
MAX_BYTES = {
    **dict.fromkeys(("geometry_msgs", "std_msgs", "rosgraph_msgs"), 1 << 12),
    "diagnostic_msgs": 1 << 16,
    "sensor_msgs": MAX_FILE_BYTES,
    "visualization_msgs": 1 << 22,
}
UNNUMBERED = 2**64 - 1  # ROS's own word for a message without a number


class Subscriber(Protocol):
    """A node that reports messages that are refused, by the errors of their callbacks."""

    input_errors: ClassVar[tuple[type[Exception], ...]]
    create_subscription: Callable[..., Subscription]
    refuse: Callable[[Exception], None]


@dataclass(frozen=True)
class Topic:
    """A topic of a channel."""

    channel: Channel

    @property
    def name(self) -> str:
        """Return the name that nodes give to ROS."""
        return self.channel.recorded if self.channel.absolute else self.channel.name

    @property
    def qos(self) -> QoSProfile:
        """Return the quality of service."""
        return QUALITIES[self.channel.quality]

    @property
    def max_bytes(self) -> int:
        """Return how many bytes a message may have."""
        return MAX_BYTES.get(self.channel.type_name.partition("/")[0], 1 << 19)

    @property
    def message(self) -> Any:
        """Return the message class."""
        return ros_class(self.channel.type_name)

    def publisher(self, node: Node) -> Publisher:
        """Return a publisher whose reliability and depth can be overridden by parameters, as usual in ROS."""
        options = QoSOverridingOptions.with_default_policies()
        # A copy: rclpy writes overrides into the profile that it is given.
        return node.create_publisher(self.message, self.name, copy(self.qos), qos_overriding_options=options)

    def decode(self, data: bytes) -> Any:
        """Return a message that came as bytes.

        Raises:
            InvalidInputError: they are too many, cut off, or those of another definition of the type.
        """
        if len(data) > self.max_bytes:
            raise InvalidInputError(self.channel.name, f"{len(data)} bytes", f"at most {self.max_bytes}")
        try:
            return deserialize_message(data, self.message)
        except (RuntimeError, ValueError):  # rclpy's own kind of it is private
            expected = f"a {self.channel.type_name} of our definition"
            raise InvalidInputError(self.channel.name, f"{len(data)} bytes", expected) from None

    def subscribe(self, node: Subscriber, callback: Callable[..., None], *, raw: bool = False) -> Subscription:
        """Subscribe; reliability and depth can be overridden by parameters.

        What comes is bytes: what is too large is not made into a message first.

        Args:
            node: that subscribes; it reports messages that are refused.
            callback: called with each message that can be decoded, or with the CDR bytes of each.
            raw: whether with its bytes.
        """
        take = callback if raw else lambda data: self.decoded(node, data, callback)
        options = QoSOverridingOptions.with_default_policies()
        return node.create_subscription(
            self.message, self.name, take, copy(self.qos), qos_overriding_options=options, raw=True
        )

    def subscribe_numbered(
        self, node: Subscriber, callback: Callable[[Any, int], None], then: Callable[[], None] = lambda: None
    ) -> Subscription:
        """Subscribe, and get with each message the number that its publisher gave it.

        Where the middleware does not number messages, all that tells is how many publishers there are: of
        one, the messages are numbered here; of several, so that each message seems to be of another.

        Args:
            node: that subscribes; it reports messages that are refused.
            callback: called with each message that can be decoded, and its number.
            then: called after a message that was not refused; its errors are no refusals.
        """
        taken = 0

        def take(data: bytes, info: dict[str, Any]) -> None:
            nonlocal taken
            taken += 1
            number = info["publication_sequence_number"]
            if number is None or number == UNNUMBERED:
                gap = 1 if subscription.get_publisher_count() <= 1 else 10_000  # so far apart are those of several
                number = taken * gap
            if self.decoded(node, data, lambda message: callback(message, number)):
                then()

        subscription = self.subscribe(node, take, raw=True)
        return subscription

    def decoded(self, node: Subscriber, data: bytes, callback: Callable[[Any], None]) -> bool:
        """Call back with the message of some bytes; return whether the callback did not refuse it, else report that."""
        try:
            callback(self.decode(data))
        except node.input_errors as error:
            node.refuse(error)
            return False
        return True


def ros_class(type_name: str) -> Any:
    """Return the class of a type, for example of `std_srvs/srv/SetBool`."""
    package, kind, name = type_name.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


@cache
def topic_of(channel: Channel) -> Topic:
    """Return the topic of a channel."""
    return Topic(channel)


def __getattr__(name: str) -> Any:
    """Return the topic of the channel of this name, or those of a tuple of channels."""
    match getattr(interface, name, None):
        case Channel() as channel:
            return topic_of(channel)
        case [Channel(), *_] as channels:
            return tuple(map(topic_of, channels))
    raise AttributeError(f"{interface.__name__} has no channel {name}")


def publishing(node: Node, *sent: Topic) -> Callable[[Iterable[tuple[Channel, bytes]]], None]:
    """Return a function that publishes outputs, each a channel and CDR bytes, on the topics of these channels."""
    publishers = {topic.channel: topic.publisher(node) for topic in sent}

    def publish(outputs: Iterable[tuple[Channel, bytes]]) -> None:
        for channel, data in outputs:
            publishers[channel].publish(data)

    return publish


def lossless(depth: int) -> dict[str, Any]:
    """Return parameters for all nodes under which nothing is dropped while fewer than `depth` messages wait.

    A live graph drops what it cannot take in time, so that it never falls behind; a replayed bag is
    judged by every frame.
    """
    overrides = {
        channel.recorded: {role: {"reliability": "reliable", "depth": depth} for role in ("publisher", "subscription")}
        for channel in (*interface.INPUTS, *interface.OUTPUTS)
        if channel.quality is not Quality.LATCHED
    }
    return {"/**": {"ros__parameters": {"qos_overrides": overrides}}}
