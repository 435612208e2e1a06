"""The executor with a kept wait set, beyond what the graphs of all other tests of nodes do with it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import pytest
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.task import Future

from magnetosuture_thread.nodes.executor import KeptWaitSetExecutor
from magnetosuture_thread.nodes.processes import reserved_domain
from test.shared import wait_until


@contextmanager
def spun(context: Any) -> Iterator[tuple[KeptWaitSetExecutor, Any, Callable[..., None]]]:
    """Yield an executor, a node in it, and a function that spins until a condition holds."""
    executor, node = KeptWaitSetExecutor(context=context), rclpy.create_node("one", context=context)
    executor.add_node(node)

    def until(condition: Callable[[], object]) -> None:
        wait_until(lambda: condition() or executor.spin_once(timeout_sec=0.1) or condition(), "the condition")

    yield executor, node, until
    executor.shutdown()
    node.destroy_node()


def test_a_task_that_awaits_is_resumed(shared_context):
    with spun(shared_context[0]) as (executor, _, until):

        async def waits() -> int:
            return 1 + len([await later])

        later = Future(executor=executor)
        task = executor.create_task(waits)
        executor.spin_once(timeout_sec=0.0)
        assert not task.done()
        executor.create_task(later.set_result, 3)
        until(task.done)
        assert task.result() == 2


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
