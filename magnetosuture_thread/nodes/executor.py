"""The executor of this package: rclpy's, without its cost for each message."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from inspect import iscoroutinefunction
from typing import Any

from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.executors import TimeoutObject as Timeout
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.subscription import Subscription
from rclpy.waitable import NumberOfEntities

EVENTS = 0.1  # s between two looks at events, as that a publisher does not fit: there are dozens, and none comes often
_WITH_INFO = Subscription.CallbackType.WithMessageInfo
_KINDS = {  # of what is waited for, in the order in which it is called, and what a node calls it
    "timer": "timers",
    "subscription": "subscriptions",
    "guard_condition": "guards",
    "client": "clients",
    "service": "services",
}
_COUNTED = ("subscription", "guard_condition", "timer", "client", "service")  # in the order of NumberOfEntities


class LeanExecutor(SingleThreadedExecutor):
    """Does what `SingleThreadedExecutor` does, one callback at a time, at a third of its processor time.

    rclpy collects all that a node could wait for anew before each wait, and waits twice for each message, as what it
    has taken wakes it up once more. Here what to wait for is collected when it has changed, which rclpy tells by
    `wake`, and timers and subscriptions are called directly. All that is rare goes by rclpy's own ways: services,
    clients, events, and coroutines that wait for something.

    Args:
        context: of the nodes; the default one if None.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self._changed = True
        self._held = ExitStack()
        self._ready: deque[tuple[Callable[..., None], Any, Any]] = deque()
        self._set: Any = None
        self._known: dict[str, dict[int, tuple[Callable[..., None], Any, Any]]] = {}
        self._handles: list[tuple[Callable[[Any], None], Any]] = []
        self._guards: list[Any] = []
        self._waitables: list[tuple[Any, Any]] = []
        self._on_event = self._by_rclpy(self._take_waitable)
        self._next_look = 0.0

    def add_node(self, node: Any) -> bool:
        """Take a node's callbacks on."""
        added = bool(super().add_node(node))
        self._changed = True
        return added

    def remove_node(self, node: Any) -> None:
        """Leave a node's callbacks alone from now on."""
        super().remove_node(node)
        self._changed = True

    def wake(self) -> None:
        """Look anew at what there is to wait for: rclpy calls this when anything was made or destroyed."""
        self._changed = True
        super().wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """Stop, and let go of all that was waited for."""
        ended = bool(super().shutdown(timeout_sec))
        self._ready.clear()
        self._held.close()
        return ended

    def _spin_once_impl(
        self, timeout_sec: float | Timeout | None = None, wait_condition: Callable[[], bool] = lambda: False
    ) -> None:
        """Wait for one callback and call it."""
        if self._tasks:
            self._tasks: list[Any] = [task for task in self._tasks if not (task[0].done() or task[0].cancelled())]
            if self._tasks:  # coroutines that wait for others: rclpy knows how
                self._ready.clear()
                super()._spin_once_impl(timeout_sec, wait_condition)
                return
        seconds = timeout_sec.timeout if isinstance(timeout_sec, Timeout) else timeout_sec
        deadline = None if seconds is None or seconds < 0.0 else time.monotonic() + seconds
        while not self._is_shutdown and not wait_condition():
            if self._changed:
                self._collect()
            if not self._ready:
                self._wait(deadline)
                if self._changed:
                    continue
            if self._ready:
                call, entity, node = self._ready.popleft()
                call(entity, node)
                return
            if self._tasks or (deadline is not None and time.monotonic() >= deadline):
                return

    def _collect(self) -> None:
        """Collect what there is to wait for, and hold it, so that nothing is destroyed that is waited for."""
        if not self._context.ok():
            raise ExternalShutdownException
        self._changed = False
        self._ready.clear()
        self._held.close()
        self._held = ExitStack()
        nodes = self.get_nodes()
        found = {kind: self._hold(nodes, name) for kind, name in _KINDS.items()}
        self._waitables = self._hold(nodes, "waitables")
        self._held.enter_context(self._context.handle)
        self._guards = [guard for guard, _ in found["guard_condition"]]
        size = NumberOfEntities(*(len(found[kind]) for kind in _COUNTED))
        size.num_guard_conditions += 2  # the executor's own
        for waitable, _ in self._waitables:
            size += waitable.get_num_entities()
        self._set = rclpy_implementation.WaitSet(
            size.num_subscriptions,
            size.num_guard_conditions,
            size.num_timers,
            size.num_clients,
            size.num_services,
            size.num_events,
            self._context.handle,
        )
        self._handles = [
            (getattr(self._set, f"add_{kind}"), entity.handle)
            for kind, entities in found.items()
            for entity, _ in entities
        ]
        self._handles += [(self._set.add_guard_condition, guard.handle) for guard in (self._guard, self._sigint_gc)]
        self._known = {
            kind: {entity.handle.pointer: (self._caller(kind, entity), entity, node) for entity, node in entities}
            for kind, entities in found.items()
            if entities
        }
        self._next_look = 0.0

    def _caller(self, kind: str, entity: Any) -> Callable[[Any, Any], None]:
        """Return what calls an entity back."""
        directly = {"timer": self._call_timer, "subscription": self._call_subscription}
        if kind in directly and not iscoroutinefunction(entity.callback):
            return directly[kind]
        return self._by_rclpy(getattr(self, f"_take_{kind}"))

    def _hold(self, nodes: list[Any], name: str) -> list[tuple[Any, Any]]:
        """Return all of a kind, with their nodes, but those that are destroyed."""
        held = []
        for node in nodes:
            for entity in getattr(node, name):
                with suppress(rclpy_implementation.InvalidHandle):
                    self._held.enter_context(getattr(entity, "handle", entity))
                    held.append((entity, node))
        return held

    def _wait(self, deadline: float | None) -> None:
        """Wait until something is ready, at most until a deadline [s]."""
        waits, now = self._set, time.monotonic()
        waits.clear_entities()
        for add, handle in self._handles:
            add(handle)
        for guard in self._guards:
            if guard._executor_triggered:
                guard.trigger()  # something else came first
        looks = now >= self._next_look
        if looks:
            self._next_look = now + EVENTS
            for waitable, _ in self._waitables:
                waitable.add_to_wait_set(waits)
        longest = self._next_look if deadline is None else min(deadline, self._next_look)
        waits.wait(max(0, round((longest - now) * 1e9)))
        if not self._context.ok():
            raise ExternalShutdownException
        for kind, known in self._known.items():
            for pointer in waits.get_ready_entities(kind):
                if (found := known.get(pointer)) is not None:
                    self._ready.append(found)
        for guard in self._guards:
            guard._executor_triggered = guard.handle.pointer in waits.get_ready_entities("guard_condition")
        if looks:
            self._ready += [(self._on_event, event, node) for event, node in self._waitables if event.is_ready(waits)]

    def _by_rclpy(self, take: Callable[[Any], Any]) -> Callable[[Any, Any], None]:
        """Return what calls back as rclpy does."""

        def call(entity: Any, node: Any) -> None:
            if not entity.callback_group.can_execute(entity):
                return
            handler = self._make_handler(entity, node, take)
            handler()
            if handler.done():
                handler.result()  # raises what the callback raised

        return call

    def _call_timer(self, timer: Any, node: Any) -> None:
        try:
            with timer.handle:
                if not timer.handle.is_timer_ready():  # it was cancelled meanwhile
                    return None
                timer.handle.call_timer()
        except rclpy_implementation.InvalidHandle:
            return None
        return timer.callback()

    def _call_subscription(self, subscription: Any, node: Any) -> None:
        try:
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        except rclpy_implementation.InvalidHandle:
            return None
        if taken is None:
            return None
        if subscription._callback_type is _WITH_INFO:
            return subscription.callback(*taken)
        return subscription.callback(taken[0])
