"""Attacks the nodes of a simulated rig's graph, while a probe takes the times of their answers."""

from __future__ import annotations

import random
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from benchmarks.attack.hostile import READY, STOP, UNARMED, Attacker
from magnetosuture_thread.commands.live import START_TIMEOUT, OwnGraph, own_graph
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.errors import GraphError
from magnetosuture_thread.settings.interface import NODES, RIG_NODES, SCENE_SERVER

SETUP = "petri_35mm_polyamide"
TARGETS = (SCENE_SERVER, *RIG_NODES, *NODES)
CONSOLE = "console"  # which gets hostile messages, but no requests
MAX_DELAY, MAX_STOP_DELAY = 0.5, 0.2  # s
RATE = 150.0  # attacks a second
DISCOVERY_TIME = 8.0  # s for the services of all nodes, then for its clients: an answer to an unknown client is lost
LAST_ANSWERS = 20.0  # s for what is still unanswered


class Attack:
    """Counts of all attacks, and delays of all answers [s] by the node's name, or `STOP`.

    Args:
        count: of hostile requests, messages and times.
        progress: called with the share done, 0 to 1.
    """

    def __init__(self, count: int, progress: Callable[[float], None]) -> None:
        self._sent, self._events = Counter[str](), Counter[str]()
        self._delays = defaultdict[str, list[float]](list)
        self._broken: list[str] = []
        self._count, self._progress = count, progress

    def figures(self) -> tuple[dict[str, Any], list[str]]:
        """Return the figures, with what was broken, and lines for a person."""
        counts, answers = {name: self._events[name] for name in ("ended", "unanswered", UNARMED)}, {}
        words = ", ".join(f"{number} {kind}" for kind, number in self._sent.items())
        lines = [f"{words}: {counts['ended']} nodes ended, {counts['unanswered']} requests without an answer"]
        for name, delays in sorted(self._delays.items()):
            median, p99, largest = (float(1e3 * value) for value in np.quantile(delays, (0.5, 0.99, 1.0)))
            answers[name] = {"count": len(delays), "median_ms": median, "p99_ms": p99, "max_ms": largest}
            lines.append(f"{name}: {len(delays)} answers, median {median:.1f} ms, at most {largest:.1f} ms")
            limit = MAX_STOP_DELAY if name == STOP else MAX_DELAY
            if late := sum(delay > limit for delay in delays):
                took = f"took longer than {limit:g} s, at most {max(delays):.2f} s"
                self._broken.append(f"{name}: {late} of {len(delays)} answers {took}")
        if not self._delays[STOP]:
            self._broken.append("no emergency stop was answered")
        return {"sent": dict(self._sent), **counts, "answers": answers, "broken": self._broken}, lines

    def attack(self, count: int, chance: random.Random, clock: bool) -> None:
        """Attack a graph of its own."""
        setup = str(read_setup(SETUP).path.resolve())
        arguments = ["--params-file", setup]
        arguments += ["-p", "coil_bridge:driver:=simulated", "-p", "coil_bridge:autostart:=armed"]
        if clock:
            arguments += ["-p", "use_sim_time:=true", "-p", "rig_simulator:rate:=1.0"]
        with TemporaryDirectory() as temporary:
            logs = Path(temporary)
            with own_graph(TARGETS, arguments, logs, "", lambda text: None) as graph:
                graph.nodes.start(CONSOLE, arguments=["-p", "console:port:=0"])
                targets = f"nodes:=[{', '.join((CONSOLE, *TARGETS))}]"
                graph.nodes.start("probe", module="benchmarks.attack.hostile", arguments=["-p", targets])
                self._attack(graph, logs, count, chance, clock)
            for line in (logs / "probe.log").read_text().splitlines():
                name, _, delay = line.partition(" ")
                if delay and name in (STOP, CONSOLE, *TARGETS):
                    self._delays[name].append(float(delay))
                self._events[UNARMED] += line == UNARMED

    def _attack(self, graph: OwnGraph, logs: Path, count: int, chance: random.Random, clock: bool) -> None:
        context, options = Context(), {"start_parameter_services": False}
        rclpy.init(context=context, domain_id=graph.domain, args=[])
        node, listener = (rclpy.create_node(name, context=context, **options) for name in ("attacker", "listener"))
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            _wait_until(lambda: READY in (logs / "probe.log").read_text().splitlines(), graph)
            _wait_until(lambda: {CONSOLE, *TARGETS} <= set(node.get_node_names()), graph)
            _spin(executor, DISCOVERY_TIME)
            attacker = Attacker(node, listener, list(TARGETS), chance, clock=clock)
            _spin(executor, DISCOVERY_TIME)
            began = time.monotonic()
            for index in range(count):
                attacker.attack()
                self._progress((sum(self._sent.values()) + index + 1) / self._count)
                for name in (CONSOLE, *TARGETS):
                    if graph.nodes.ended(name):
                        last = (logs / f"{name}.log").read_text(errors="replace").strip().splitlines()[-1:]
                        self._broken.append(f"{name} ended after {index + 1} attacks: {' '.join(last)}")
                        self._events["ended"] += 1
                        graph.nodes.start(name)
                _spin(executor, began + (index + 1) / RATE - time.monotonic())
            until = time.monotonic() + LAST_ANSWERS
            while attacker.unanswered and time.monotonic() < until:
                _spin(executor, 0.1)
            self._events["unanswered"] += len(attacker.unanswered)
            for service, number in Counter(attacker.unanswered.values()).items():
                self._broken.append(f"{service}: {number} requests were not answered")
            self._sent.update(attacker.sent)
        finally:
            executor.shutdown()
            listener.destroy_node()
            node.destroy_node()
            context.try_shutdown()


def _wait_until(is_there: Callable[[], bool], graph: OwnGraph) -> None:
    """Wait until all nodes are there for someone."""
    deadline = time.monotonic() + START_TIMEOUT
    while not is_there():
        graph.nodes.check()
        if time.monotonic() > deadline:
            raise GraphError(f"after {START_TIMEOUT:g} s not all nodes have been discovered")
        time.sleep(0.1)


def _spin(executor: SingleThreadedExecutor, duration: float) -> None:
    """Take what has come, for a time [s]; at least once."""
    until = time.monotonic() + duration
    executor.spin_once(timeout_sec=0.0)
    while (left := until - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=left)
