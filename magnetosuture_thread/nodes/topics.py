"""The graph's topics in ROS: message classes and qualities of service."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

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
from rclpy.subscription import Subscription

from magnetosuture_thread import InvalidInputError, interface
from magnetosuture_thread.interface import Channel

SENSOR = qos_profile_sensor_data
# Of frames that wait only the newest two: a tracker that was held up would otherwise be late for many more, and coils
# rest while poses are old.
FRAMES = QoSProfile(depth=2, reliability=ReliabilityPolicy.BEST_EFFORT)
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

UNNUMBERED = 2**64 - 1  # ROS's own word for a message without a number
MAX_SEQUENCE_GAP = 10_000  # numbers so far apart are of different publishers


@dataclass(frozen=True)
class Topic:
    """A topic: its name and type, and its quality of service."""

    channel: Channel
    qos: QoSProfile
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
        return node.create_publisher(self.message, self.name, self.qos, qos_overriding_options=options)

    def subscribe(
        self,
        node: Node,
        callback: Callable[[Any], None],
        *,
        raw: bool = False,
        unheard: Callable[[InvalidInputError], None] | None = None,
    ) -> Subscription:
        """Subscribe; reliability and depth can be overridden by parameters.

        Args:
            node: that subscribes.
            callback: called with each message, or with its CDR bytes.
            raw: whether with its bytes.
            unheard: called when there is a publisher whose messages cannot come, as its quality of service is
                less than ours; by default ROS says so in the log.
        """

        def mismatched(event: Any) -> None:
            assert unheard is not None
            policy = qos_policy_name_from_kind(event.last_policy_kind).lower()
            expected = str(getattr(self.qos, policy).name).lower()
            unheard(InvalidInputError(f"publisher of {self.channel.name}", f"another {policy}", expected))

        return node.create_subscription(
            self.message,
            self.name,
            callback,
            self.qos,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=mismatched) if unheard else None,
            raw=raw,
        )

    def subscribe_numbered(self, node: Node, callback: Callable[[Any, int], None]) -> Subscription:
        """Subscribe, and get with each message the number that its publisher gave it.

        Where the middleware does not number messages, all that tells is how many publishers there are: of
        one, the messages are numbered here; of several, so that each message seems to be of another.
        """
        taken = 0

        def take(message: Any, info: dict[str, Any]) -> None:
            nonlocal taken
            taken += 1
            number = info["publication_sequence_number"]
            if number is None or number == UNNUMBERED:
                number = taken if subscription.get_publisher_count() <= 1 else taken * MAX_SEQUENCE_GAP
            callback(message, number)

        options = QoSOverridingOptions.with_default_policies()
        subscription = node.create_subscription(self.message, self.name, take, self.qos, qos_overriding_options=options)
        return subscription


IMAGE = Topic(interface.IMAGE, FRAMES)
COMPRESSED_IMAGE = Topic(interface.COMPRESSED_IMAGE, FRAMES)
CAMERA_INFO = Topic(interface.CAMERA_INFO, SENSOR)
NEEDLE_POSE = Topic(interface.NEEDLE_POSE, SENSOR)
TRACKER_STATE = Topic(interface.TRACKER_STATE, RELIABLE)
TIP_SETPOINT = Topic(interface.TIP_SETPOINT, RELIABLE)
GROUND_TRUTH_NEEDLE = Topic(interface.GROUND_TRUTH_NEEDLE, RELIABLE)
GROUND_TRUTH_THREAD = Topic(interface.GROUND_TRUTH_THREAD, RELIABLE)
OPERATOR_COMMAND = Topic(interface.OPERATOR_COMMAND, RELIABLE)
FILTER_STATE = Topic(interface.FILTER_STATE, RELIABLE)
NEEDLE_COMMAND = Topic(interface.NEEDLE_COMMAND, RELIABLE)
NEEDLE_SETPOINT = Topic(interface.NEEDLE_SETPOINT, RELIABLE)
MEASURED_THREAD = Topic(interface.MEASURED_THREAD, RELIABLE)
PREDICTED_THREAD = Topic(interface.PREDICTED_THREAD, RELIABLE)
MARGINS = Topic(interface.MARGINS, RELIABLE)
THREAD_MARKERS = Topic(interface.THREAD_MARKERS, RELIABLE)
SCENE = Topic(interface.SCENE, LATCHED)
SCENE_MARKERS = Topic(interface.SCENE_MARKERS, LATCHED)
MATERIAL = Topic(interface.MATERIAL, LATCHED)
CURRENTS = Topic(interface.CURRENTS, RELIABLE)
BRIDGE_STATE = Topic(interface.BRIDGE_STATE, LATCHED)
RIG_CURRENTS = Topic(interface.RIG_CURRENTS, RELIABLE)
FAULT_REQUEST = Topic(interface.FAULT_REQUEST, RELIABLE)
CLOCK = Topic(interface.CLOCK, SENSOR, absolute=True)
DIAGNOSTICS = Topic(interface.DIAGNOSTICS, RELIABLE, absolute=True)

INPUTS = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, NEEDLE_COMMAND, OPERATOR_COMMAND)
OUTPUTS = (
    NEEDLE_POSE,
    TRACKER_STATE,
    MEASURED_THREAD,
    PREDICTED_THREAD,
    MARGINS,
    THREAD_MARKERS,
    FILTER_STATE,
    NEEDLE_SETPOINT,
    CURRENTS,
    BRIDGE_STATE,
    DIAGNOSTICS,
)

SETTINGS = (SCENE, SCENE_MARKERS, MATERIAL)  # what may be told at any time, or never
SIMULATED = (GROUND_TRUTH_NEEDLE, GROUND_TRUTH_THREAD, TIP_SETPOINT, FAULT_REQUEST)  # by the rig and who steers it


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
