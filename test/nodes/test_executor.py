"""The executor calls back what rclpy's own does, and notices what was made or destroyed meanwhile."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from magnetosuture_thread.nodes.executor import LeanExecutor
from magnetosuture_thread.nodes.processes import reserved_domain

BEST_EFFORT = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


class Spun:
    """A node and the executor that is tried on it."""

    def __init__(self, domain: int) -> None:
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain, args=[])
        self.node = Node("tried", context=self.context)
        self.executor = LeanExecutor(context=self.context)
        self.executor.add_node(self.node)

    def until(self, condition: Callable[[], bool]) -> None:
        """Spin until a condition holds."""
        deadline = time.monotonic() + 10.0
        while not condition():
            assert time.monotonic() < deadline
            self.executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        """End it."""
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()


@pytest.fixture
def spun() -> Iterator[Spun]:
    """A node with its executor, on a domain of its own."""
    with reserved_domain() as domain:
        made = Spun(domain)
        yield made
        made.close()


def test_messages_timers_and_raw_bytes_come(spun):
    heard: list[str] = []
    raw: list[bytes] = []
    numbered: list[int] = []
    ticks: list[float] = []
    publisher = spun.node.create_publisher(String, "said", 10)
    spun.node.create_subscription(String, "said", lambda message: heard.append(message.data), 10)
    spun.node.create_subscription(String, "said", raw.append, 10, raw=True)
    spun.node.create_subscription(
        String, "said", lambda message, info: numbered.append(info["publication_sequence_number"]), 10
    )
    spun.node.create_timer(0.01, lambda: ticks.append(time.monotonic()))
    spun.until(lambda: publisher.get_subscription_count() == 3)
    for word in ("one", "two"):
        publisher.publish(String(data=word))
    spun.until(lambda: heard == ["one", "two"] and len(raw) == len(numbered) == 2 and len(ticks) >= 3)
    assert all(isinstance(data, bytes) for data in raw)


def test_one_callback_is_called_at_a_time(spun):
    heard: list[str] = []
    publisher = spun.node.create_publisher(String, "said", 10)
    spun.node.create_subscription(String, "said", lambda message: heard.append(message.data), 10)
    spun.until(lambda: publisher.get_subscription_count() == 1)
    publisher.publish(String(data="one"))
    publisher.publish(String(data="two"))
    spun.until(lambda: len(heard) > 0)
    assert heard == ["one"]
    spun.until(lambda: len(heard) == 2)


def test_what_is_made_and_destroyed_in_a_callback_is_noticed(spun):
    heard: list[str] = []
    first = spun.node.create_publisher(String, "first", 10)
    second = spun.node.create_publisher(String, "second", 10)

    def begin(message: String) -> None:
        spun.node.destroy_subscription(subscription)
        spun.node.create_subscription(String, "second", lambda message: heard.append(message.data), 10)

    subscription = spun.node.create_subscription(String, "first", begin, 10)
    spun.until(lambda: first.get_subscription_count() == 1)
    first.publish(String(data="begin"))
    spun.until(lambda: second.get_subscription_count() == 1)
    second.publish(String(data="on"))
    spun.until(lambda: heard == ["on"])
    spun.until(lambda: first.get_subscription_count() == 0)


def test_a_cancelled_timer_rests_until_it_is_reset(spun):
    ticks: list[int] = []
    timer = spun.node.create_timer(0.01, lambda: ticks.append(1))
    other: list[int] = []
    spun.node.create_timer(0.01, lambda: other.append(1))
    timer.cancel()
    spun.until(lambda: len(other) > 5)
    assert not ticks
    timer.reset()
    spun.until(lambda: len(ticks) > 2)


def test_services_are_answered_and_clients_hear_it(spun):
    def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.message = "done"
        return response

    spun.node.create_service(Trigger, "do", answer)
    client = spun.node.create_client(Trigger, "do")
    spun.until(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    spun.executor.spin_until_future_complete(future, timeout_sec=10.0)
    assert future.result().message == "done"


def test_a_coroutine_may_wait_while_others_go_on(spun):
    gate: Future = Future(executor=spun.executor)
    opened: list[str] = []
    ticks: list[int] = []

    async def wait_for_it() -> None:
        opened.append(await gate)

    spun.executor.create_task(wait_for_it)
    spun.node.create_timer(0.01, lambda: ticks.append(1))
    spun.until(lambda: len(ticks) > 3)
    assert not opened
    gate.set_result("open")
    spun.until(lambda: opened == ["open"])


def test_a_guard_condition_that_was_triggered_is_called(spun):
    called: list[int] = []
    guard = spun.node.create_guard_condition(lambda: called.append(1))
    guard.trigger()
    spun.until(lambda: called == [1])


def test_an_event_is_told_soon(spun):
    told: list[int] = []
    spun.node.create_publisher(String, "said", BEST_EFFORT)
    callbacks = SubscriptionEventCallbacks(incompatible_qos=lambda event: told.append(event.total_count))
    spun.node.create_subscription(String, "said", lambda message: None, 10, event_callbacks=callbacks)
    spun.until(lambda: told == [1])


def test_what_a_callback_raises_comes_out(spun):
    def fail() -> None:
        raise ValueError("of the callback")

    spun.node.create_timer(0.01, fail)
    with pytest.raises(ValueError, match="of the callback"):
        spun.until(lambda: False)


def test_a_wait_ends_at_its_time_or_with_the_context(spun):
    for kind in (0.0, 0.02):
        spun.executor.spin_once(timeout_sec=kind)
    spun.node.create_timer(0.01, spun.context.try_shutdown)
    with pytest.raises(ExternalShutdownException):
        spun.until(lambda: False)
