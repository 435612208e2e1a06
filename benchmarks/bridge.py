"""Time the coil bridge: how long until the duties of two simulated RoboClaw boards are zero.

The boards are on pseudo-terminals. Measured after a commander fell silent and after kill -9 of commander,
tracker and bridge; also how even the bridge's loop is, and what hostile messages can do. Meanwhile all cores
are kept busy. Takes nine minutes.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from benchmarks.report import figures_table
from magnetosuture_thread.coils.inputs import SILENCE_TIMEOUT
from magnetosuture_thread.commands.command import Terminal, whole_number
from magnetosuture_thread.rig.power import PowerStage
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.errors import GraphError

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.clients import CoilClient
    from magnetosuture_thread.nodes.processes import NodeProcesses

SETUP = "petri_35mm_polyamide"
START_TIMEOUT = 120.0  # s for a bridge to start and to be heard, on a busy machine
REARM_AFTER = 10.0  # s without current, after which the bridge is armed again
TIMEOUT = 60.0  # s for anything to happen
SUPPLY, RESISTANCE, INDUCTANCE = 24.0, 1.0, 0.005  # V, ohm, H of the simulated boards and coils

Log = Callable[[str], None]
Progress = Callable[[float], None]


def _spread(event: str, delays: Sequence[float], bound: float) -> dict[str, Any]:
    """Return the times from an event to zero duty on all boards [ms]; `beyond` counts those beyond the bound."""
    times = 1e3 * np.array(delays)
    median, p99, greatest = np.percentile(times, [50.0, 99.0, 100.0]).tolist()
    figures = {"event": event, "count": len(times), "median": median, "p99": p99, "greatest": greatest}
    return {**figures, "bound": 1e3 * bound, "beyond": int(np.sum(times > 1e3 * bound))}


class DriveWatch:
    """Keeps when the coils of a power stage, all together, were driven and when not.

    A board forgets what is long past: look again before it has changed its duties some thousand times.

    Args:
        stage: the boards.

    Attributes:
        turns: when the coils were driven from then on, or not any more: (time [s], driven).
        largest: greatest duty of any coil since it was set to zero.
    """

    def __init__(self, stage: PowerStage) -> None:
        self._stage = stage
        self._on = [False] * len(stage.boards)
        self._seen = [-np.inf] * len(stage.boards)
        self.turns: list[tuple[float, bool]] = []
        self.largest = 0

    def driven(self) -> bool:
        """Take what has happened since the last look, and return whether any coil is driven."""
        changes = []
        for line in self._stage.lines:
            line.advance()
        for index, board in enumerate(self._stage.boards):
            with next(line for line in self._stage.lines if board in line.boards).lock:
                timeline = list(board.timeline)
            changes += [(at, index, duties) for at, duties in timeline if at > self._seen[index]]
            self._seen[index] = timeline[-1][0] if timeline else self._seen[index]
        for at, index, duties in sorted(changes):
            self.largest = max(self.largest, *(abs(duty) for duty in duties))
            self._on[index] = any(duties)
            if any(self._on) != (bool(self.turns) and self.turns[-1][1]):
                self.turns.append((at, any(self._on)))
        return bool(self.turns) and self.turns[-1][1]

    def to_zero(self, times: Sequence[float]) -> list[float]:
        """Return, for each time that found the coils driven, how long it took until they were not [s].

        Args:
            times: [s]; those after which the coils have not been at zero yet are left out.
        """
        turned = np.array([at for at, _ in self.turns])
        after = np.searchsorted(turned, times, side="right")
        return [
            self.turns[index][0] - time
            for time, index in zip(times, after.tolist(), strict=True)
            if 0 < index < len(self.turns) and self.turns[index - 1][1]
        ]


class BridgeBench:
    """A bridge with simulated boards on serial lines, and all that can fail around it, as processes.

    Args:
        stage: the boards.
        nodes: the processes.
        client: makes one for the bridge's switches.
        logs: folder of what the processes print.
        progress: called with the share of a stage done, 0 to 1.
    """

    def __init__(
        self, stage: PowerStage, nodes: NodeProcesses, client: Callable[[], CoilClient], logs: Path, progress: Progress
    ) -> None:
        self.watch = DriveWatch(stage)
        self._nodes, self._client, self._logs, self._progress = nodes, client, logs, progress

    def start(self, name: str, **parameters: float | str) -> None:
        """Start the bridge, or a stand-in for a commander, a tracker or a fuzzer."""
        if name == "coil_bridge":
            self._nodes.start(name)
            self.arm()
            return
        values = {"kind": name, **parameters}
        arguments = ["-r", f"__node:={name}", *(part for key in values for part in ("-p", f"{key}:={values[key]}"))]
        self._nodes.start(name, module="benchmarks.traffic", arguments=arguments)

    def stop_trials(self, trials: int) -> list[float]:
        """Let a commander fall silent again and again; return the times from its last command to zero [s]."""
        self.start("commander")
        self.drive()
        self._nodes.kill("commander")
        self.wait(lambda: not self.watch.driven(), "zero")
        self.start("commander", burst=0.2, pause=0.3)  # s of commands, and of silence on average
        log, delays, last = self._logs / "commander.log", list[float](), time.monotonic()
        while len(delays) < trials:
            time.sleep(0.2)
            stops = [float(line) for line in log.read_text().split("\n")[:-1]]  # the last line may be half written
            if self.watch.driven():
                last = time.monotonic()
            elif time.monotonic() - last > REARM_AFTER:
                self.arm()  # a machine that stands still for longer than a board's answer may take is a fault
            delays = self.watch.to_zero(stops)
            self._progress(len(delays) / trials)
            if time.monotonic() > last + TIMEOUT:
                raise GraphError("waited in vain for the trials")
        self._nodes.kill("commander")
        return delays[:trials]

    def kills(self, name: str, times: int) -> list[float]:
        """Kill a process again and again while the coils are driven; return the times to zero [s]."""
        delays = []
        for done in range(times):
            self.drive()
            began = time.monotonic()
            self._nodes.kill(name)
            self.wait(lambda: not self.watch.driven(), f"zero after {name} was killed")
            delays += self.watch.to_zero([began])
            self._progress((done + 1) / times)
            self.start(name)
        return delays

    def fuzz(self, count: int) -> float:
        """Publish hostile messages and see that the bridge works afterwards.

        Returns:
            The greatest current asked of a board meanwhile [A].

        Raises:
            GraphError: it does not.
        """
        for name in ("commander", "tracker"):
            self._nodes.kill(name)
        # While the bridge still counts those that were killed as speaking, it would refuse all without looking.
        self.wait(lambda: not self.watch.driven(), "zero")
        time.sleep(2.0 * SILENCE_TIMEOUT)
        self.watch.driven()
        self.watch.largest = 0
        self.start("fuzzer", count=count)
        self.wait(lambda: self._nodes.ended("fuzzer"), "the fuzzer to end", TIMEOUT + count / 200.0)
        self._nodes.kill("fuzzer")  # whose work is done
        self.watch.driven()
        greatest = self.watch.largest / 32767 * SUPPLY / RESISTANCE  # the duty of the full supply
        self.arm()
        self.start("tracker")
        self.start("commander")
        self.drive()
        return greatest

    def drive(self) -> None:
        """Wait until the coils have been driven for 0.3 s."""
        driven = self.watch.driven
        self.wait(lambda: driven() and time.monotonic() - self.watch.turns[-1][0] > 0.3, "the coils to be driven")

    def arm(self) -> None:
        """Arm the bridge, which may just start."""
        deadline = time.monotonic() + START_TIMEOUT
        while True:
            try:
                with self._client() as client:
                    client.execute("reset")  # one that was killed while armed waits for it
                    client.execute("arm")
                return
            except GraphError as error:
                self._nodes.check()
                if time.monotonic() > deadline:
                    raise GraphError(f"the bridge cannot be armed: {error}") from None

    def wait(self, condition: Callable[[], bool], what: str, timeout: float = TIMEOUT) -> None:
        """Wait until a condition holds.

        Raises:
            GraphError: it does not within the timeout [s].
        """
        deadline = time.monotonic() + timeout
        while not condition():
            time.sleep(0.01)
            if time.monotonic() > deadline:
                with self._client() as client:
                    raise GraphError(f"waited in vain for {what}; the bridge says: {client.state()}")


def measure_bridge(trials: int, kills: int, hostile: int, log: Log, progress: Progress) -> dict[str, Any]:
    """Measure a coil bridge that drives simulated RoboClaw boards, on a machine all of whose cores are busy.

    Args:
        trials: of a commander that falls silent.
        kills: of each process.
        hostile: messages.
        log: called with a line for a person at each stage.
        progress: called with the share of a stage done, 0 to 1.

    Returns:
        The figures: `delays` to zero; `loop`, by how much an interval of the loop differs from its period
        (median, 99th percentile, greatest) [ms], its `rate` [Hz] and the process's `scheduling`; `hostile` messages,
        the `greatest_current` meanwhile and its limit `max_current` [A].
    """
    # Only here, where it is needed: without ROS the other commands still work.
    from magnetosuture_thread.nodes.clients import CoilClient
    from magnetosuture_thread.nodes.processes import NodeProcesses, environment_of, graph_environment, reserved_domain

    setup = read_setup(SETUP)
    settings, delays = setup.coils, list[dict[str, Any]]()

    def add(event: str, times: list[float], bound: float) -> None:
        delays.append(spread := _spread(event, times, bound))
        log(f"  {event}: median {spread['median']:.1f}, maximum {spread['greatest']:.1f} ms")

    with tempfile.TemporaryDirectory() as name, reserved_domain() as domain, ExitStack() as stack:
        folder = Path(name)
        ports = [str(folder / f"board_{index}") for index in range(2)]
        stage = PowerStage(ports, SUPPLY, RESISTANCE, INDUCTANCE)
        # No thread is predicted here, and nothing shall go slower for that; there is no needle that could follow.
        alone = {"without_prediction": "slow", "speed_without_prediction": settings.max_speed, "pose_uncertainty": 0.01}
        boards = {"roboclaw_ports": ports, "roboclaw_addresses": [board.address for board in stage.boards]}
        parameters = {"driver": "roboclaw", **boards, "coil_resistance": RESISTANCE, **alone}
        file = folder / "parameters.yaml"
        file.write_text(yaml.safe_dump({"/**/coil_bridge": {"ros__parameters": parameters}}), encoding="utf-8")
        arguments = ["--params-file", str(setup.path), "--params-file", str(file)]
        # Not by shared memory: what a killed process leaves of it may keep a later one from being heard.
        environment = {**graph_environment(domain), "FASTDDS_BUILTIN_TRANSPORTS": "UDPv4"}
        stage.open()
        stack.callback(stage.close)
        stack.enter_context(environment_of(environment))
        nodes = stack.enter_context(NodeProcesses((), arguments, environment, folder / "logs"))
        for _ in range(os.cpu_count() or 1):  # keep every core busy
            work = subprocess.Popen([sys.executable, "-c", "while True: pass"], start_new_session=True)
            stack.callback(work.wait)
            stack.callback(work.kill)
        bench = BridgeBench(stage, nodes, CoilClient, folder / "logs", progress)
        bench.start("coil_bridge")
        bench.start("tracker")
        log(f"{trials} times a commander that falls silent")
        add("last command", bench.stop_trials(trials), settings.command_timeout + 1.0 / settings.rate)
        with CoilClient() as client:
            loop, scheduling = loop_timing(client)
        bench.start("commander")
        for victim in ("commander", "tracker", "coil_bridge"):
            log(f"{kills} times kill -9 of the {victim}")
            # The bound is driver_timeout, and the boards' own clock.
            add(f"kill -9 of {victim}", bench.kills(victim, kills), 0.25)
        log(f"{hostile} hostile messages")
        greatest = bench.fuzz(hostile)
    return {
        "delays": delays,
        **{"loop": loop, "scheduling": scheduling, "rate": settings.rate, "hostile": hostile},
        **{"greatest_current": greatest, "max_current": settings.max_current},
    }


def loop_timing(client: CoilClient) -> tuple[list[float], str]:
    """Return the jitter of the bridge's loop (median, 99th percentile, maximum) [ms], and how its process is scheduled.

    Raises:
        GraphError: no diagnostics were received.
    """
    from magnetosuture_thread.nodes import topics
    from magnetosuture_thread.nodes.clients import Inbox
    from magnetosuture_thread.nodes.coil_bridge import JITTER_KEYS
    from magnetosuture_thread.nodes.node import SCHEDULING, read_report

    reports = Inbox(client.node, topics.DIAGNOSTICS, 10)

    def read() -> dict[str, str] | None:
        bridges = (read_report(report).get("coil_bridge", ("", {})) for report, _ in reports.read())
        return next((values for _, values in bridges if SCHEDULING in values), None)

    values = client.wait_for(read, lambda: GraphError("no coil_bridge diagnostics received"))
    return [float(values[name]) for name in JITTER_KEYS], values[SCHEDULING]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    option = parser.add_argument
    option("--trials", type=whole_number, default=500, metavar="N", help="a commander that falls silent (default: 500)")
    option("--kills", type=whole_number, default=20, metavar="N", help="kill -9 of each process (default: 20)")
    option("--hostile", type=whole_number, default=10_000, metavar="N", help="hostile messages (default: 10000)")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Time the bridge; return the figures."""
    log = terminal.log
    with terminal.progress("bridge") as advance:
        figures = measure_bridge(options.trials, options.kills, options.hostile, log, advance)
    names = ("median", "p99", "greatest", "bound")
    columns = {"": "{event}", **{name: f"{{{name}:.1f}}" for name in names}, "beyond": "{beyond}/{count}"}
    title = "coil bridge with simulated boards, all cores busy; times in ms to zero of all duties"
    terminal.print(figures_table(title, figures["delays"], columns))
    loop = ", ".join(f"{value:.2f}" for value in figures["loop"])
    log(f"loop at {figures['rate']:g} Hz, {figures['scheduling']}: off its period by {loop} ms (median, p99, maximum)")
    log("{hostile} hostile messages: at most {greatest_current:.2f} A of {max_current:.2f} A".format(**figures))
    return figures, True
