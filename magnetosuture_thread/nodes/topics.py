"""The graph's topics in ROS: message classes and qualities of service."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_policy_name_from_kind,
    qos_profile_sensor_data,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

from magnetosuture_thread import InvalidInputError, interface
from magnetosuture_thread.interface import Channel
from magnetosuture_thread.untrusted import MAX_BLOCK_BYTES

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.node import GuardedNode

SENSOR = qos_profile_sensor_data
# Of frames that wait only the newest two: a tracker that was held up would otherwise be late for many more, and coils
# rest while poses are old.
FRAMES = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

UNNUMBERED = 2**64 - 1  # ROS's own word for a message without a number
MAX_SEQUENCE_GAP = 10_000  # numbers so far apart are of different publishers

# Bytes of a message; what is larger is not even read. A pose or a command has a few hundred.
SMALL, STATUS, TEXTS, SHAPES, DRAWN = 1 << 12, 1 << 16, 1 << 18, 1 << 19, 1 << 22


@dataclass(frozen=True)
class Topic:
    """A topic: its name and type, its quality of service, and how large a message of it may be [bytes]."""

    channel: Channel
    qos: QoSProfile
    max_bytes: int = SMALL
    absolute: bool = False

    @property
    def name(self) -> str:
        """Return the name that nodes give to ROS."""
        return self.channel.recorded if self.absolute else self.channel.name

    @property
    def message(self) -> Any:
        """Return the message class."""
        package, _, name = self.channel.type_name.split("/")
        return getattr(import_module(f"{package}.msg"), name)

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
            wanted = f"a {self.channel.type_name} of our definition"
            raise InvalidInputError(self.channel.name, f"{len(data)} bytes", wanted) from None

    def subscribe(
        self,
        node: GuardedNode,
        callback: Callable[[Any], None],
        *,
        raw: bool = False,
        unheard: Callable[[InvalidInputError], None] | None = None,
    ) -> Subscription:
        """Subscribe; reliability and depth can be overridden by parameters.

        Args:
            node: that subscribes; it reports messages that are refused.
            callback: called with each message that can be decoded, or with the CDR bytes of each.
            raw: whether with its bytes.
            unheard: called when there is a publisher whose messages cannot come, as its quality of service is
                less than ours; by default ROS says so in the log.
        """

        def mismatched(event: Any) -> None:
            assert unheard is not None
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            expected = str(getattr(self.qos, policy).name).lower()
            unheard(InvalidInputError(f"publisher of {self.channel.name}", f"another {policy}", expected))

        def take(data: bytes) -> None:
            try:
                message = self.decode(data)
            except InvalidInputError as error:
                node.refuse(error)
            else:
                callback(message)

        events = SubscriptionEventCallbacks(incompatible_qos=mismatched) if unheard else None
        return self._subscribe(node, callback if raw else take, event_callbacks=events)

    def subscribe_numbered(self, node: GuardedNode, callback: Callable[[Any, int], None]) -> Subscription:
        """Subscribe, and get with each message the number that its publisher gave it.

        Where the middleware does not number messages, all that tells is how many publishers there are: of
        one, the messages are numbered here; of several, so that each message seems to be of another.
        """
        taken = 0

        def take(data: bytes, info: dict[str, Any]) -> None:
            nonlocal taken
            taken += 1
            number = info["publication_sequence_number"]
            if number is None or number == UNNUMBERED:
                number = taken if subscription.get_publisher_count() <= 1 else taken * MAX_SEQUENCE_GAP
            try:
                message = self.decode(data)
            except InvalidInputError as error:
                node.refuse(error)
            else:
                callback(message, number)

        subscription = self._subscribe(node, take)
        return subscription

    def _subscribe(self, node: GuardedNode, take: Callable[..., None], **options: Any) -> Subscription:
        """Subscribe to the bytes of the messages: what is too large is not made into a message first."""
        overriding = QoSOverridingOptions.with_default_policies()
        return node.create_subscription(
            self.message, self.name, take, copy(self.qos), qos_overriding_options=overriding, raw=True, **options
        )


IMAGE = Topic(interface.IMAGE, FRAMES, MAX_BLOCK_BYTES)
COMPRESSED_IMAGE = Topic(interface.COMPRESSED_IMAGE, FRAMES, MAX_BLOCK_BYTES)
CAMERA_INFO = Topic(interface.CAMERA_INFO, SENSOR, STATUS)
NEEDLE_POSE = Topic(interface.NEEDLE_POSE, SENSOR)
TRACKER_STATE = Topic(interface.TRACKER_STATE, RELIABLE, STATUS)
TIP_SETPOINT = Topic(interface.TIP_SETPOINT, RELIABLE)
GROUND_TRUTH_NEEDLE = Topic(interface.GROUND_TRUTH_NEEDLE, RELIABLE)
GROUND_TRUTH_THREAD = Topic(interface.GROUND_TRUTH_THREAD, RELIABLE)
GROUND_TRUTH_PULL = Topic(interface.GROUND_TRUTH_PULL, RELIABLE)
OPERATOR_COMMAND = Topic(interface.OPERATOR_COMMAND, RELIABLE)
FILTER_STATE = Topic(interface.FILTER_STATE, RELIABLE, STATUS)
NEEDLE_COMMAND = Topic(interface.NEEDLE_COMMAND, RELIABLE)
NEEDLE_SETPOINT = Topic(interface.NEEDLE_SETPOINT, RELIABLE)
MEASURED_THREAD = Topic(interface.MEASURED_THREAD, RELIABLE, SHAPES)
THREAD_OBSERVATION = Topic(interface.THREAD_OBSERVATION, RELIABLE, SHAPES)
PREDICTED_THREAD = Topic(interface.PREDICTED_THREAD, RELIABLE, SHAPES)
ESTIMATED_THREAD = Topic(interface.ESTIMATED_THREAD, RELIABLE, SHAPES)
FORECAST = Topic(interface.FORECAST, RELIABLE, SHAPES)
MARGINS = Topic(interface.MARGINS, RELIABLE, SHAPES)
THREAD_MARKERS = Topic(interface.THREAD_MARKERS, RELIABLE, DRAWN)
SCENE = Topic(interface.SCENE, LATCHED, 1 << 17)  # the largest scene has 120 kB
SCENE_MARKERS = Topic(interface.SCENE_MARKERS, LATCHED, DRAWN)
MATERIAL = Topic(interface.MATERIAL, LATCHED, TEXTS)
CURRENTS = Topic(interface.CURRENTS, RELIABLE, STATUS)
BRIDGE_STATE = Topic(interface.BRIDGE_STATE, LATCHED, STATUS)
RIG_CURRENTS = Topic(interface.RIG_CURRENTS, RELIABLE, STATUS)
FAULT_REQUEST = Topic(interface.FAULT_REQUEST, RELIABLE)
PROCEDURE_STATE = Topic(interface.PROCEDURE_STATE, LATCHED, STATUS)
PROCEDURE_PLAN = Topic(interface.PROCEDURE_PLAN, LATCHED, SHAPES)
PROCEDURE_HOLD = Topic(interface.PROCEDURE_HOLD, NEWEST)
CLOCK = Topic(interface.CLOCK, SENSOR, absolute=True)
DIAGNOSTICS = Topic(interface.DIAGNOSTICS, RELIABLE, STATUS, absolute=True)

INPUTS = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, NEEDLE_COMMAND, OPERATOR_COMMAND)
OUTPUTS = (
    NEEDLE_POSE,
    TRACKER_STATE,
    MEASURED_THREAD,
    THREAD_OBSERVATION,
    PREDICTED_THREAD,
    ESTIMATED_THREAD,
    FORECAST,
    MARGINS,
    THREAD_MARKERS,
    FILTER_STATE,
    NEEDLE_SETPOINT,
    CURRENTS,
    BRIDGE_STATE,
    DIAGNOSTICS,
)

ON_REQUEST = (FORECAST,)  # outputs that nobody publishes unless a parameter asks for them
SETTINGS = (SCENE, SCENE_MARKERS, MATERIAL)  # what may be told at any time, or never
GROUND_TRUTH = (GROUND_TRUTH_NEEDLE, GROUND_TRUTH_THREAD, GROUND_TRUTH_PULL)
SIMULATED = (*GROUND_TRUTH, TIP_SETPOINT, FAULT_REQUEST)  # by the rig and who steers it

PROCEDURES = (PROCEDURE_STATE, PROCEDURE_PLAN, PROCEDURE_HOLD)  # of the needle planner, where there is one


def lossless(depth: int) -> dict[str, Any]:
    """Return parameters for all nodes under which nothing is dropped while fewer than `depth` messages wait.

    A live graph drops what it cannot take in time, so that it never falls behind; a replayed bag is
    judged by every frame.
    """
    overrides = {
        f"/{topic.channel.name}": {
            role: {"reliability": "reliable", "depth": depth} for role in ("publisher", "subscription")
        }
        for topic in (*INPUTS, *OUTPUTS)
        if topic.qos is not LATCHED
    }
    return {"/**": {"ros__parameters": {"qos_overrides": overrides}}}
