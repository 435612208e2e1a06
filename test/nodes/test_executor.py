"""The executor with a kept wait set: what is called, when entities come and go, and how a wait ends."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest
import rclpy
from magnetosuture_msgs.action import ExecuteProcedure
from rclpy.action import ActionClient, ActionServer
from rclpy.executors import ExternalShutdownException
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from magnetosuture_thread.nodes.executor import KeptWaitSetExecutor
from magnetosuture_thread.nodes.processes import reserved_domain


@contextmanager
def spun(context: Any) -> Iterator[tuple[KeptWaitSetExecutor, Any, Callable[..., None]]]:
    """Yield an executor, a node in it, and a function that spins until a condition holds."""
    executor, node = KeptWaitSetExecutor(context=context), rclpy.create_node("one", context=context)
    executor.add_node(node)

    def until(condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + 30.0
        while not condition():
            assert time.monotonic() < deadline
            executor.spin_once(timeout_sec=0.1)

    yield executor, node, until
    executor.shutdown()
    node.destroy_node()


def test_messages_services_timers_guards_and_tasks_are_called(shared_context):
    with spun(shared_context[0]) as (executor, node, until):
        heard, ticks, triggered = list[str](), list[float](), list[int]()
        node.create_subscription(String, "words", lambda message: heard.append(message.data), 10)
        publisher = node.create_publisher(String, "words", 10)
        until(publisher.get_subscription_count)
        for word in ("a", "b", "c"):
            publisher.publish(String(data=word))
        until(lambda: heard == ["a", "b", "c"])
        timer = node.create_timer(0.01, lambda: ticks.append(time.monotonic()))
        until(lambda: len(ticks) >= 3)
        timer.cancel()
        count = len(ticks)
        executor.spin_once(timeout_sec=0.05)
        assert len(ticks) == count
        guard = node.create_guard_condition(lambda: triggered.append(1))
        guard.trigger()
        until(lambda: triggered)

        def answer(request: Any, response: Any) -> Any:
            response.success = True
            return response

        node.create_service(Trigger, "press", answer)
        client = node.create_client(Trigger, "press")
        until(client.service_is_ready)
        call = client.call_async(Trigger.Request())
        executor.spin_until_future_complete(call, timeout_sec=30.0)
        assert call.result().success

        async def waits() -> int:
            return 1 + len([await later])

        later = Future(executor=executor)
        task = executor.create_task(waits)
        executor.spin_once(timeout_sec=0.0)
        assert not task.done()
        executor.create_task(later.set_result, 3)
        until(task.done)
        assert task.result() == 2


def test_an_action_gives_feedback_is_cancelled_and_ends(shared_context):
    with spun(shared_context[0]) as (executor, node, until):
        ended, feedback = Future(executor=executor), list[Any]()

        async def execute(goal: Any) -> Any:
            goal.publish_feedback(ExecuteProcedure.Feedback())
            await ended
            goal.canceled() if goal.is_cancel_requested else goal.succeed()
            return ExecuteProcedure.Result(reason="over")

        server = ActionServer(node, ExecuteProcedure, "act", execute, cancel_callback=lambda goal: 2)
        client = ActionClient(node, ExecuteProcedure, "act")
        until(client.server_is_ready)
        sent = client.send_goal_async(ExecuteProcedure.Goal(), feedback.append)
        until(sent.done)
        result = sent.result().get_result_async()
        until(lambda: feedback)
        cancelled = sent.result().cancel_goal_async()
        until(cancelled.done)
        assert not result.done()
        ended.set_result(None)
        until(result.done)
        assert result.result().result.reason == "over"
        client.destroy()
        server.destroy()


def test_entities_come_and_go_while_it_spins(shared_context):
    with spun(shared_context[0]) as (executor, node, until):
        ticks = list[str]()

        def replace() -> None:  # itself, as a lifecycle node does when it is cleaned up
            ticks.append("first")
            node.destroy_timer(first)
            node.create_timer(0.01, lambda: ticks.append("second"))

        first = node.create_timer(0.01, replace)
        until(lambda: "second" in ticks)
        assert ticks.count("first") == 1
        other = rclpy.create_node("other", context=shared_context[0])
        other.create_timer(0.01, lambda: ticks.append("other"))
        spinning = threading.Thread(target=until, args=(lambda: "other" in ticks,))
        spinning.start()
        executor.add_node(other)  # by another thread, amid a wait
        spinning.join(30.0)
        assert "other" in ticks
        executor.remove_node(other)
        other.destroy_node()
        executor.spin_once(timeout_sec=0.0)
        count = ticks.count("other")
        until(lambda: ticks.count("second") > 20)
        assert ticks.count("other") == count


def test_a_timer_may_cancel_another_that_is_due(shared_context):
    with spun(shared_context[0]) as (_, node, until):
        timers, called = list[Any](), list[int]()

        def cancel_the_others(number: int) -> None:
            called.append(number)
            for timer in (each for each in timers if each is not timers[number]):
                timer.cancel()

        timers += [node.create_timer(0.002, partial(cancel_the_others, number)) for number in range(3)]
        time.sleep(0.01)  # all of them are due in one turn
        until(lambda: len(called) > 3)
        assert set(called) == {called[0]}


def test_what_a_callback_raises_comes_out_of_spin_and_the_others_go_on(shared_context):
    with spun(shared_context[0]) as (_, node, until):
        ticks = list[int]()

        def fail() -> None:
            raise RuntimeError("nobody foresaw this")

        failing = node.create_timer(0.001, fail)
        with pytest.raises(RuntimeError, match="nobody foresaw"):
            until(lambda: False)
        node.destroy_timer(failing)
        node.create_timer(0.001, lambda: ticks.append(1))
        until(lambda: len(ticks) > 2)


def test_a_context_that_is_shut_down_ends_the_wait():
    with reserved_domain() as domain:
        context = rclpy.Context()
        rclpy.init(context=context, args=[], domain_id=domain)
        with spun(context) as (executor, _, _):
            threading.Timer(0.1, context.try_shutdown).start()
            with pytest.raises(ExternalShutdownException):
                executor.spin_once()
