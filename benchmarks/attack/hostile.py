"""Hostile requests, messages and times for the nodes of a running graph, varied at random, and a probe beside them.

As a program it is the probe: a node that asks every other node for an answer, and presses the emergency stop.
"""

from __future__ import annotations

import itertools
import math
import random
import re
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from typing import Any

import rclpy
from builtin_interfaces.msg import Time
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.client import Client
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from magnetosuture_thread import InvalidInputError
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.nodes.topics import Topic
from magnetosuture_thread.settings.interface import Service

TOPICS = (*topics.INPUTS, *topics.OUTPUTS, *topics.SETTINGS, *topics.SIMULATED, topics.RIG_CURRENTS)
# Whatever their content, these requests are orders, not attacks: only who may give them could be asked.
ORDERS = (Service.ARM, Service.EMERGENCY_STOP, Service.RESET, Service.PAUSE_RIG)
FIRST_IMPOSSIBLE_TRANSITION = 9
NUMBERS = (0.0, -0.0, 1.0, -1.0, 0.01, -0.02, 5e-324, 1e308, -1e308, math.inf, -math.inf, math.nan)
TEXTS = ("", " ", "dish", "map", "no_such", "use_sim_time", "viscosity", "a..b", "\x1b[2J", "‮", "../../etc/passwd", "{")
BITS = {"int8": 8, "int16": 16, "int32": 32, "int64": 64}
LENGTHS = (0, 1, 2, 3, 8, 300)
HUGE = 10_000_000  # characters
# Of the probe.
PERIOD = 0.02  # s between two questions
STOP_EVERY = 50  # questions
LIMIT = 3.0  # s without an answer, after which the next question is asked
READY, STOP, UNARMED = "ready", "stop", "unarmed"
SERVICE_SHARE, CLOCK_SHARE, HUGE_SHARE = 0.4, 0.1, 0.002

_SEQUENCE = re.compile(r"sequence<(?P<kind>.+?)(?:, (?P<bound>\d+))?>$|(?P<element>.+)\[(?P<count>\d+)\]$")


class Attacker:
    """Sends one hostile request, message or time after the other.

    Most messages are of the graph itself: one that was published a moment ago, with something altered.

    Args:
        node: that sends them.
        listener: a node that no executor has, which gets what the graph publishes.
        targets: names of the nodes.
        chance: of the variation.
        clock: whether also times on /clock are sent.

    Attributes:
        sent: how many of each kind.
        unanswered: requests that wait for an answer, each with the name of its service.
    """

    def __init__(self, node: Node, listener: Node, targets: list[str], chance: random.Random, *, clock: bool) -> None:
        self._chance = chance
        self._stamp: Callable[[], Time] = lambda: node.get_clock().now().to_msg()
        self._seen: dict[str, bytes] = {}  # by the topic's name
        self._own: set[int] = set()  # hashes of what was sent, which comes back too
        self._publishers = {topic.name: topic.publisher(node) for topic in TOPICS}
        # Not waited for by any executor, which would do nothing else: one message is taken where one is needed. Raw
        # images are left out: with a subscriber to them, the middleware loses answers, which it sends again after 3 s.
        self._subscriptions = {
            topic.name: listener.create_subscription(topic.message, topic.name, print, topic.qos, raw=True)
            for topic in TOPICS
            if topic is not topics.IMAGE
        }
        self._clock = topics.CLOCK.publisher(node) if clock else None
        self._clients = [client for target in targets for client in _clients(node, target)]
        self.sent = {"requests": 0, "messages": 0, "times": 0}
        self.unanswered: dict[Any, str] = {}

    def attack(self) -> None:
        """Send one, of any kind."""
        share = self._chance.random()
        if self._clock is not None and share < CLOCK_SHARE:
            self._clock.publish(Clock(clock=self._time()))
            self.sent["times"] += 1
        elif share < SERVICE_SHARE:
            self._request(self._chance.choice(self._clients))
            self.sent["requests"] += 1
        else:
            topic = self._chance.choice(TOPICS)
            data = self._message(topic)
            self._own.add(hash(data))
            self._publishers[topic.name].publish(data)
            self.sent["messages"] += 1

    def _last(self, name: str) -> bytes:
        """Return the bytes of the graph's last message of a topic; none if there is none."""
        if (subscription := self._subscriptions.get(name)) is None:
            return b""
        with subscription.handle:
            while (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                if hash(data := bytes(taken[0])) not in self._own:
                    self._seen[name] = data
        return self._seen.get(name, b"")

    def _request(self, client: Client) -> None:
        request = client.srv_type.Request()
        spoil(request, 0.9, self._chance)
        if isinstance(request, ChangeState.Request):
            request.transition.id = self._chance.randrange(FIRST_IMPOSSIBLE_TRANSITION, 256)
        future = client.call_async(request)
        self.unanswered[future] = client.srv_name
        future.add_done_callback(lambda future: self.unanswered.pop(future, None))

    def _message(self, topic: Topic) -> bytes:
        """Return the bytes of a message of a topic, with something wrong in it, or nothing."""
        data = self._last(topic.name)
        how = self._chance.choice(("noise", "cut", "flip", "fields", "fields", "fields"))
        if self._chance.random() < HUGE_SHARE:
            message = topic.message()
            for name, kind in message.get_fields_and_field_types().items():
                if kind == "std_msgs/Header":
                    getattr(message, name).frame_id = "x" * HUGE
                elif kind == "string":
                    setattr(message, name, "x" * HUGE)
            return bytes(serialize_message(message))
        if how == "noise":
            return b"\x00\x01\x00\x00" + self._chance.randbytes(self._chance.choice((0, 1, 7, 100, 5000)))
        if how == "cut" and len(data) > 4:
            return data[: self._chance.randrange(4, len(data) + 1)]
        if how == "flip" and len(data) > 4:
            altered = bytearray(data)
            for _ in range(self._chance.choice((1, 2, 8))):
                altered[self._chance.randrange(4, len(altered))] ^= 1 << self._chance.randrange(8)
            return bytes(altered)
        try:
            message = topic.decode(data)
        except InvalidInputError:  # nothing yet, or an attack
            message = topic.message()
        spoil(message, self._chance.choice((0.02, 0.2, 0.8)), self._chance)
        if hasattr(message, "header") and self._chance.random() < 0.7:
            message.header.stamp, message.header.frame_id = self._stamp(), "dish"
        return bytes(serialize_message(message))

    def _time(self) -> Time:
        seconds = self._chance.choice((-1, -(2**31), 0, 5, 2**31 - 1, self._chance.randrange(1000)))
        return Time(sec=seconds, nanosec=self._chance.choice((0, 10**9, 2**32 - 1, self._chance.randrange(10**9))))


def spoil(message: Any, share: float, chance: random.Random) -> None:
    """Replace a share of all fields at random."""
    for name, kind in message.get_fields_and_field_types().items():
        if "/" in kind and "<" not in kind and "[" not in kind:
            spoil(getattr(message, name), share, chance)
        elif chance.random() < share:
            setattr(message, name, _value(kind, chance))


def _value(kind: str, chance: random.Random) -> Any:
    """Return a value of a field's type."""
    if match := _SEQUENCE.match(kind):
        most = int(match["bound"] or 1 << 30)
        count = int(match["count"]) if match["count"] else min(chance.choice(LENGTHS), most)
        return [_value(match["kind"] or match["element"], chance) for _ in range(count)]
    if kind.startswith(("string", "wstring")):
        text = chance.choice(TEXTS) * chance.choice((1, 1, 1, 500))
        bound = re.search(r"<(\d+)>", kind)
        return text[: int(bound[1])] if bound else text
    if kind in ("double", "float"):
        number = chance.choice((*NUMBERS, chance.uniform(-0.02, 0.02)))
        return number if kind == "double" or abs(number) < 1e38 or not math.isfinite(number) else 1e38
    if kind == "boolean":
        return chance.random() < 0.5
    if kind in ("octet", "byte"):
        return chance.randbytes(1)
    if kind.removeprefix("u") in BITS:
        bits = BITS[kind.removeprefix("u")]
        low, high = (0, 2**bits - 1) if kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return chance.choice((low, high, 0, 1, 10, min(200, high), chance.randint(low, high)))
    message = _interface(kind)()
    if isinstance(message, Parameter):
        message.name = chance.choice(TEXTS)
        message.value = ParameterValue(type=chance.choice((*range(11), 200)))
    spoil(message, 0.3, chance)
    return message


def _clients(node: Node, target: str) -> list[Client]:
    """Return clients for the services of a node, those left out that are `ORDERS`."""
    found = node.get_service_names_and_types_by_node(target, "/")
    # The answers to others wait here too, until they are passed over.
    waiting = QoSProfile(depth=1000)
    return [
        node.create_client(_interface(kinds[0]), name, qos_profile=waiting)
        for name, kinds in found
        if name.removeprefix("/") not in ORDERS
    ]


def _interface(name: str) -> Any:
    """Return the class of an interface: package/msg/Name, or package/Name for a message."""
    package, *middle, own = name.split("/")
    return getattr(import_module(".".join((package, *(middle or ("msg",))))), own)


def main() -> None:
    """Ask the nodes of the parameter `nodes` in turn, and print a line for each answer.

    A line has the node's name, or `STOP`, and the seconds until the answer came. `READY` is printed once all nodes have
    answered: while kernels compile, a node answers nobody. The bridge is armed before each emergency stop; where that
    was not possible, `UNARMED` is printed.
    """
    rclpy.init()
    node, executor = rclpy.create_node("probe"), SingleThreadedExecutor()
    executor.add_node(node)
    names = list(node.declare_parameter("nodes", [""]).value or ())
    clients = {name: node.create_client(GetParameters, f"{name}/get_parameters") for name in names}
    stop, reset = (node.create_client(Trigger, name) for name in (Service.EMERGENCY_STOP, Service.RESET))
    arm = node.create_client(SetBool, Service.ARM)
    turns = itertools.cycle(names)

    def ask(client: Client, request: Any) -> tuple[Any, float]:
        began, future = time.monotonic(), client.call_async(request)
        executor.spin_until_future_complete(future, LIMIT)
        return future.result() if future.done() else None, time.monotonic() - began

    silent = set(names)
    while silent:
        name = next(turns)
        if all(each.wait_for_service(LIMIT) for each in (clients[name], stop, arm)):
            silent -= {name} if ask(clients[name], GetParameters.Request())[0] is not None else set()
    print(READY, flush=True)
    for asked in itertools.count(1):
        time.sleep(PERIOD)
        if asked % STOP_EVERY:
            name = next(turns)
            _, delay = ask(clients[name], GetParameters.Request(names=["use_sim_time"]))
            print(name, f"{delay:.6f}", flush=True)
            continue
        ask(reset, Trigger.Request())
        answer, _ = ask(arm, SetBool.Request(data=True))
        if answer is None or not answer.success:
            print(UNARMED, flush=True)
        print(STOP, f"{ask(stop, Trigger.Request())[1]:.6f}", flush=True)


if __name__ == "__main__":
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        main()
