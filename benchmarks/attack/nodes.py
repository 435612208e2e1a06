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

from benchmarks.attack.hostile import Attacker
from benchmarks.attack.page import WatchingPage
from benchmarks.attack.probe import READY, STOP, UNARMED
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.interface import NODES, RIG_NODES, SCENE_SERVER
from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment, reserved_domain
from magnetosuture_thread.setups import read_setup

SETUP = "petri_35mm_polyamide"
TARGETS = (SCENE_SERVER, *RIG_NODES, *NODES)
CONSOLE, PAGE = "console", "page"
WORDS = {STOP: "emergency stop: {} answers", PAGE: "operator's page: {} intervals between states"}
MAX_DELAY, MAX_STOP_DELAY = 0.5, 0.2  # s
RATE = 150.0  # attacks a second
CLOCK_SHARE = 0.25  # of all attacks, on a graph with a simulated clock
START_TIMEOUT = 240.0  # s; the first start on a machine compiles
DISCOVERY_TIME = 8.0  # s for the services of all nodes, then for its clients: an answer to an unknown client is lost
LAST_ANSWERS = 20.0  # s for what is still unanswered


def attack_nodes(
    count: int, seed: int, progress: Callable[[float], None] = lambda share: None
) -> tuple[dict[str, Any], list[str], bool]:
    """Attack all nodes, first by the time of the day, then by a simulated clock.

    Args:
        count: of hostile requests, messages and times.
        seed: of the variation.
        progress: called with the share done, 0 to 1.

    Returns:
        Figures, lines for a person, and whether all promises were kept.
    """
    with_clock = round(CLOCK_SHARE * count)
    sent, delays, events = Counter[str](), defaultdict[str, list[float]](list), Counter[str]()
    examples: list[str] = []
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        progress(done / count)

    for number, clock in ((count - with_clock, False), (with_clock, True)):
        if number:
            examples += _attack_graph(number, random.Random(f"{seed} {clock}"), clock, sent, delays, events, advance)
    figures: dict[str, Any] = {"sent": dict(sent), "ended": events["ended"], "unanswered": events["unanswered"]}
    figures |= {"unarmed": events[UNARMED], "answers": {name: _summary(each) for name, each in sorted(delays.items())}}
    broken = list(examples)
    for name, each in delays.items():
        limit = MAX_STOP_DELAY if name == STOP else MAX_DELAY
        if late := sum(delay > limit for delay in each):
            broken.append(
                f"{name}: {late} of {len(each)} answers took longer than {limit:g} s, at most {max(each):.2f} s"
            )
    if not delays[STOP]:
        broken.append("no emergency stop was answered")
    figures["broken"] = broken
    lines = [
        ", ".join(f"{number} {kind}" for kind, number in sent.items())
        + f": {events['ended']} nodes ended, {events['unanswered']} requests without an answer"
    ]
    for name, each in figures["answers"].items():
        what = WORDS.get(name, f"{name}: {{}} answers").format(each["count"])
        lines.append(f"{what}, median {each['median_ms']:.1f} ms, at most {each['max_ms']:.1f} ms")
    return figures, [*lines, *broken[:20]], not broken


def _attack_graph(
    count: int,
    chance: random.Random,
    clock: bool,
    sent: Counter[str],
    delays: dict[str, list[float]],
    events: Counter[str],
    advance: Callable[[], None],
) -> list[str]:
    """Attack a graph of its own; add to the figures, and return what went wrong."""
    problems: list[str] = []
    setup = str(read_setup(SETUP).path.resolve())
    arguments = ["--params-file", setup, "-p", "coil_bridge:driver:=simulated", "-p", "coil_bridge:autostart:=armed"]
    if clock:
        arguments += ["-p", "use_sim_time:=true", "-p", "rig_simulator:rate:=1.0"]
    with reserved_domain() as domain, TemporaryDirectory() as temporary:
        environment, logs = graph_environment(domain), Path(temporary)
        with (
            environment_of(environment),
            NodeProcesses(TARGETS, arguments, environment, logs) as nodes,
            WatchingPage(logs / f"{CONSOLE}.log") as page,
        ):
            targets = f"nodes:=[{', '.join(TARGETS)}]"
            nodes.start(CONSOLE, arguments=["-p", "console:port:=0"])
            nodes.start("probe", module="benchmarks.attack.probe", arguments=["-p", targets])
            context = Context()
            rclpy.init(context=context, domain_id=domain, args=[])
            node = rclpy.create_node("attacker", context=context, start_parameter_services=False)
            listener = rclpy.create_node("listener", context=context, start_parameter_services=False)
            executor = SingleThreadedExecutor(context=context)
            executor.add_node(node)
            try:
                _wait_until(lambda: READY in (logs / "probe.log").read_text().splitlines(), nodes)
                _wait_until(lambda: {CONSOLE, *TARGETS} <= set(node.get_node_names()), nodes)
                _spin(executor, DISCOVERY_TIME)
                attacker = Attacker(node, listener, list(TARGETS), chance, clock=clock)
                _spin(executor, DISCOVERY_TIME)
                _wait_until(lambda: bool(page.gaps), nodes)
                page.gaps.clear()
                began = time.monotonic()
                for index in range(count):
                    attacker.attack()
                    advance()
                    for name in (CONSOLE, *TARGETS):
                        if nodes.ended(name):
                            last = (logs / f"{name}.log").read_text(errors="replace").strip().splitlines()[-1:]
                            problems.append(f"{name} ended after {index + 1} attacks: {' '.join(last)}")
                            events["ended"] += 1
                            nodes.start(name)
                    _spin(executor, began + (index + 1) / RATE - time.monotonic())
                until = time.monotonic() + LAST_ANSWERS
                while attacker.unanswered and time.monotonic() < until:
                    _spin(executor, 0.1)
                events["unanswered"] += len(attacker.unanswered)
                for service, number in Counter(attacker.unanswered.values()).items():
                    problems.append(f"{service}: {number} requests were not answered")
                sent.update(attacker.sent)
                delays[PAGE] += page.gaps
                if page.losses:
                    problems.append(f"the page lost the console {page.losses} times")
            finally:
                executor.shutdown()
                listener.destroy_node()
                node.destroy_node()
                context.try_shutdown()
        for line in (logs / "probe.log").read_text().splitlines():
            name, _, delay = line.partition(" ")
            if delay and name in (STOP, *TARGETS):
                delays[name].append(float(delay))
            events[UNARMED] += line == UNARMED
    return problems


def _wait_until(is_there: Callable[[], bool], nodes: NodeProcesses) -> None:
    """Wait until all nodes are there for someone."""
    deadline = time.monotonic() + START_TIMEOUT
    while not is_there():
        nodes.check()
        if time.monotonic() > deadline:
            raise GraphError(f"after {START_TIMEOUT:g} s not all nodes have been discovered")
        time.sleep(0.1)


def _spin(executor: SingleThreadedExecutor, duration: float) -> None:
    """Take what has come, for a time [s]; at least once."""
    until = time.monotonic() + duration
    executor.spin_once(timeout_sec=0.0)
    while (left := until - time.monotonic()) > 0.0:
        executor.spin_once(timeout_sec=left)


def _summary(delays: list[float]) -> dict[str, float]:
    """Return the figures of some delays [s]."""
    median, p99, largest = 1e3 * np.quantile(delays, (0.5, 0.99, 1.0))
    return {"count": len(delays), "median_ms": float(median), "p99_ms": float(p99), "max_ms": float(largest)}
