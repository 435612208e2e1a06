"""An executor whose wait set is kept until an entity is added or removed; simulated time of a replay or of the rig."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, suppress
from typing import Any

from rclpy.event_handler import EventHandler
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, await_or_execute
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.task import Task
from rclpy.waitable import NumberOfEntities


class KeptWaitSetExecutor(SingleThreadedExecutor):
    """Calls what is ready as rclpy's executor of one thread does, at less than half of its cost.

    rclpy gathers all entities of all nodes anew for each callback, and wakes itself twice by each. Here they are
    gathered when a node tells of a change, as rclpy's nodes do. A turn calls each entity that is ready once. Where a
    callback adds or removes an entity, the others are still ready in the next turn. A callback that awaits is resumed
    in each turn, and holds nobody else of its callback group off. Events, of which rclpy makes some for each publisher
    and subscription, are looked at once a second only.
    """

    def __init__(self, **options: Any) -> None:
        self._changed = True
        self._held = ExitStack()  # of the handles in the wait set, so that none is destroyed in it
        self._wait_set: Any = None
        self._entities: dict[str, dict[int, Any]] = {}  # of each kind, by pointer
        self._waitables: list[Any] = []
        self._events_due = 0.0
        super().__init__(**options)

    def wake(self) -> None:
        """Wake up, as an entity was added or removed."""
        self._changed = True
        super().wake()

    def add_node(self, node: Node) -> bool:
        """Add a node."""
        added = bool(super().add_node(node))
        self.wake()  # once it is there
        return added

    def remove_node(self, node: Node) -> None:
        """Remove a node."""
        super().remove_node(node)
        self.wake()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """End, and let go of all entities."""
        ended = bool(super().shutdown(timeout_sec))
        self._wait_set, self._entities, self._waitables = None, {}, []
        self._held.close()
        return ended

    def spin_until(self, condition: Callable[[], bool]) -> None:
        """Call what is ready until a condition holds, which is evaluated after each turn and each `wake`."""
        while not condition():
            self._turn(-1)

    def spin_some(self) -> None:
        """Call what is ready, without waiting, until nothing is ready any more, or for 100 turns in a flood."""
        for _ in range(100):
            if not self._turn(0):
                return

    def _spin_once_impl(self, timeout_sec: Any = None, wait_condition: Callable[[], bool] = lambda: False) -> None:
        seconds = getattr(timeout_sec, "timeout", timeout_sec)
        endless = seconds is None or seconds < 0.0
        nanoseconds = -1 if endless else round(1e9 * seconds)
        while not (self._is_shutdown or wait_condition() or self._turn(nanoseconds)) and endless:
            pass  # woken up by a change, with nothing to call

    def _turn(self, nanoseconds: int) -> bool:
        """Wait for so long, without end if negative, and call what is ready; return whether anything was."""
        if self._is_shutdown:
            return False
        resumed = self._resume_tasks()
        if self._changed:
            self._gather()
        self._wait_set.clear_entities()  # a wait leaves those only that are ready
        for kind, entities in self._entities.items():
            add = getattr(self._wait_set, f"add_{kind}")
            for entity in entities.values():
                add(entity.handle)
        now = time.monotonic()
        with_events = now >= self._events_due
        waitables = [waitable for waitable in self._waitables if with_events or not isinstance(waitable, EventHandler)]
        for waitable in waitables:
            waitable.add_to_wait_set(self._wait_set)
        self._events_due = now + 1.0 if with_events else self._events_due
        self._wait_set.wait(0 if resumed else nanoseconds)
        if not self._context.ok():
            raise ExternalShutdownException()
        ready = [] if self._is_shutdown else list(self._ready(waitables))
        for take, entity in ready:
            if self._changed and entity not in self._entities["guard_condition"].values():  # which are ready once
                break
            if (execute := take(entity)) is not None:
                self._begin(execute())
        return resumed or bool(ready)

    def _gather(self) -> None:
        """Make a wait set of all entities of all nodes."""
        self._changed = False
        self._held.close()
        self._held.enter_context(self._context.handle)
        nodes = self.get_nodes()
        entities = {
            "guard_condition": [self._guard, self._sigint_gc, *(guard for node in nodes for guard in node.guards)]
        }
        for kind in ("timer", "subscription", "client", "service"):
            entities[kind] = [entity for node in nodes for entity in getattr(node, f"{kind}s")]
        self._entities = {
            kind: {entity.handle.pointer: entity for entity in every if self._hold(entity.handle)}
            for kind, every in entities.items()
        }
        self._waitables = [waitable for node in nodes for waitable in node.waitables if self._hold(waitable)]
        guards, timers, subscriptions, clients, services = map(len, self._entities.values())
        count = NumberOfEntities(subscriptions, guards, timers, clients, services)
        for waitable in self._waitables:
            count += waitable.get_num_entities()
        kinds = ("subscription", "guard_condition", "timer", "client", "service", "event")
        numbers = (getattr(count, f"num_{kind}s") for kind in kinds)
        self._wait_set = rclpy_implementation.WaitSet(*numbers, self._context.handle)

    def _hold(self, handle: Any) -> bool:
        with suppress(rclpy_implementation.InvalidHandle):  # it was destroyed by another thread
            self._held.enter_context(handle)
            return True
        return False

    def _ready(self, waitables: list[Any]) -> Iterator[tuple[Callable[[Any], Any], Any]]:
        """Yield each entity that is ready, after the method of rclpy that takes its data."""
        for kind, entities in self._entities.items():
            take = getattr(self, f"_take_{kind}")
            for pointer in self._wait_set.get_ready_entities(kind):
                entity = entities.get(pointer)  # None for a part of a waitable
                is_called = getattr(entity, "callback", None) is not None or kind == "client"
                if entity is not None and is_called and (kind != "timer" or entity.handle.is_timer_ready()):
                    yield take, entity
        for waitable in waitables:
            if waitable.is_ready(self._wait_set):
                yield self._take_waitable, waitable

    def _begin(self, coroutine: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine until it ends or awaits; most end, and need no task."""
        try:
            coroutine.send(None)
        except StopIteration:
            return
        with self._tasks_lock:
            self._tasks.append((Task(coroutine, executor=self), None, None))

    def _take_timer(self, timer: Any) -> Any:
        """Take a timer, unless one that was called before it in this turn has cancelled it."""
        return super()._take_timer(timer) if timer.handle.is_timer_ready() else None

    def _take_service(self, service: Any) -> Any:
        """Take a request, as rclpy does; the service keeps when it was sent [ns], by the middleware of its client."""
        with suppress(rclpy_implementation.InvalidHandle), service.handle:  # else it was destroyed by another thread
            request, header = service.handle.service_take_request(service.srv_type.Request)

            async def execute() -> None:
                service.sent = header.source_timestamp
                answer = await await_or_execute(service.callback, request, service.srv_type.Response())
                service.send_response(answer, header)

            return None if header is None else execute
        return None

    def _resume_tasks(self) -> bool:
        """Begin or resume tasks; return whether one has ended, for which others may wait."""
        with self._tasks_lock:
            tasks = [task for task, *_ in self._tasks]
        try:
            for task in tasks:
                task()
                if (error := task.exception()) is not None:
                    raise error
        finally:
            with self._tasks_lock:
                self._tasks[:] = [entry for entry in self._tasks if not (entry[0].done() or entry[0].cancelled())]
        return any(task.done() for task in tasks)


class Timeline:
    """Maps simulated to real time; before it begins, and while it is paused, simulated time stands still.

    Args:
        start: the simulated time to begin with [ns].
        rate: how much faster than real time it runs.

    Attributes:
        start: as given.
        stood: real time of all pauses that are over [s].
        lag: simulated time that was left out, as the computer was too slow for it [s].
        skipped: simulated time that was left out, as nothing happens in it [s].
    """

    def __init__(self, start: int, rate: float) -> None:
        self.start = start
        self._rate = rate
        self._began: float | None = None
        self._paused: float | None = None
        self.stood = self.lag = self.skipped = 0.0

    def begin(self) -> None:
        """Begin, or begin anew, at the start."""
        self._began, self.stood, self.skipped = time.perf_counter(), 0.0, 0.0
        self._paused = self._began if self._paused is not None else None

    @property
    def paused(self) -> bool:
        """Whether it is paused."""
        return self._paused is not None

    def on_pause(self, request: Any) -> str:
        """Pause the time, or resume it, by a request of SetBool; return which."""
        now = time.perf_counter()
        if request.data and self._paused is None:
            self._paused = now
        elif not request.data and self._paused is not None:
            if self._began is not None:
                self.stood += now - self._paused
            self._paused = None
        return f"{'paused' if request.data else 'goes on'} at {self.elapsed():.2f} s"

    def running(self) -> float:
        """Return for how long it has been running, by real time, since it began [s]."""
        if self._began is None:
            return 0.0
        now = time.perf_counter() if self._paused is None else self._paused
        return now - self._began - self.stood

    def elapsed(self) -> float:
        """Return the simulated time since the start [s]."""
        return self.running() * self._rate - self.lag + self.skipped

    def skip_to(self, simulated: int) -> None:
        """Leave out the time until a simulated time [ns]."""
        self.skipped += (simulated - self.now()) * 1e-9

    def now(self) -> int:
        """Return the simulated time [ns]."""
        return self.start + round(self.elapsed() * 1e9)

    def left(self, simulated: int) -> float:
        """Return how long it takes until a simulated time [ns], in real time [s]; for ever while it is paused."""
        if self._paused is not None:
            return math.inf
        return ((simulated - self.start) * 1e-9 - self.skipped) / self._rate - self.running()
