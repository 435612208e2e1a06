"""Time the coil bridge: how long until the duties of two simulated RoboClaw boards are zero.

The boards are on pseudo-terminals. Measured after a commander fell silent and after kill -9 of commander,
tracker and bridge; also how even the bridge's loop is. Meanwhile all cores are kept busy. Takes nine minutes.
Hostile messages are those of `python -m benchmarks attack nodes`.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from magnetosuture_thread.commands.command import make_log, progress, whole_number
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.rig.power.stage import PowerStage
from magnetosuture_thread.setups import read_setup

if TYPE_CHECKING:
    from magnetosuture_thread.nodes.clients import CoilClient
    from magnetosuture_thread.nodes.processes import NodeProcesses

SETUP = "petri_35mm_polyamide"
BURST, PAUSE = 0.2, 0.3  # s of commands, and of silence on average
MOVING = 0.3  # s for which the coils must be driven before something is killed
ATTEMPTS = 12  # to arm, each of up to 10 s
RESTART_AFTER = 6  # attempts; on a busy machine a bridge takes a minute to start
START_TIMEOUT = 60.0  # s for processes to start and to be heard, on a busy machine
REARM_AFTER = 10.0  # s without current, after which the bridge is armed again
TIMEOUT = 30.0  # s for anything to happen
KILL_BOUND = 0.25  # s; driver_timeout, and the boards' own clock
SUPPLY, RESISTANCE, INDUCTANCE = 24.0, 1.0, 0.005  # V, ohm, H of the simulated boards and coils

Log = Callable[[str], None]
Progress = Callable[[float], None]


def zero_delays(event: str, delays: Sequence[float], bound: float) -> dict[str, Any]:
    """Return the times from an event to zero duty on all boards: median, p99 and greatest [s].

    Args:
        event: what happened.
        delays: of each time that the coils were driven then [s]; at least one.
        bound: what they should not exceed [s]; `beyond` counts those that do.
    """
    median, p99, greatest = np.percentile(delays, [50.0, 99.0, 100.0]).tolist()
    beyond = int(np.sum(np.asarray(delays) > bound))
    figures = {"event": event, "count": len(delays), "median": median, "p99": p99, "greatest": greatest}
    return {**figures, "bound": bound, "beyond": beyond}


class DriveWatch:
    """Keeps when the coils of a power stage, all together, were driven and when not.

    A board forgets what is long past: look again before it has changed its duties some thousand times.

    Args:
        stage: the boards.

    Attributes:
        turns: when the coils were driven from then on, or not any more: (time [s], driven).
    """

    def __init__(self, stage: PowerStage) -> None:
        self._stage = stage
        self._on = [False] * len(stage.boards)
        self._seen = [-np.inf] * len(stage.boards)
        self.turns: list[tuple[float, bool]] = []

    @property
    def driven(self) -> bool:
        """Whether any coil was driven when we last looked."""
        return bool(self.turns) and self.turns[-1][1]

    def look(self) -> None:
        """Take what has happened since we last looked."""
        changes = []
        for line in self._stage.lines:
            line.advance()
        for index, board in enumerate(self._stage.boards):
            with next(line for line in self._stage.lines if board in line.boards).lock:
                timeline = list(board.timeline)
            changes += [(at, index, duties) for at, duties in timeline if at > self._seen[index]]
            self._seen[index] = timeline[-1][0] if timeline else self._seen[index]
        for at, index, duties in sorted(changes):
            self._on[index] = any(duties)
            if any(self._on) != self.driven:
                self.turns.append((at, any(self._on)))

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

    Attributes:
        restarts: how often a process that was started after a kill was not heard, until the bridge was started anew.
    """

    def __init__(
        self, stage: PowerStage, nodes: NodeProcesses, client: Callable[[], CoilClient], logs: Path, progress: Progress
    ) -> None:
        self.watch = DriveWatch(stage)
        self._nodes, self._client, self._logs, self._progress = nodes, client, logs, progress
        self.restarts = 0

    def start(self, name: str, **parameters: float | str) -> None:
        """Start the bridge, or a stand-in for a commander or a tracker."""
        if name == "coil_bridge":
            self._nodes.start(name)
            self.arm()
            return
        given = [f"kind:={name}", *(f"{key}:={value}" for key, value in parameters.items())]
        arguments = ["-r", f"__node:={name}", *(part for each in given for part in ("-p", each))]
        self._nodes.start(name, module="benchmarks.bridge.traffic", arguments=arguments)

    def stop_trials(self, trials: int) -> list[float]:
        """Let a commander fall silent again and again; return the times from its last command to zero [s]."""
        self.start("commander")
        self.drive()
        self._nodes.kill("commander")
        self.wait(lambda: not self._driven(), "zero")
        self.start("commander", burst=BURST, pause=PAUSE)
        log, delays, last = self._logs / "commander.log", list[float](), time.monotonic()
        while len(delays) < trials:
            time.sleep(0.2)
            stops = [float(line) for line in log.read_text().split("\n")[:-1]]  # the last line may be half written
            if self._driven():
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
            self.wait(lambda: not self._driven(), f"zero after {name} was killed")
            delays += self.watch.to_zero([began])
            self._progress((done + 1) / times)
            self.start(name)
        return delays

    def drive(self) -> None:
        """Wait until the coils have been driven for a while, and start all anew where they are not."""
        for _ in range(3):
            try:
                self.wait(self._driven_for_a_while, "the coils to be driven", START_TIMEOUT)
                return
            except GraphError:
                # A killed process may leave Fast DDS's shared memory such that no later one is heard.
                self.restarts += 1
                for name in ("commander", "tracker", "coil_bridge"):
                    self._nodes.kill(name)
                for name in ("coil_bridge", "tracker", "commander"):
                    self.start(name)
        self.wait(self._driven_for_a_while, "the coils to be driven")

    def arm(self) -> None:
        """Arm the bridge; start it anew where it is not heard."""
        for attempt in range(ATTEMPTS):
            try:
                # Another each time: the one that is not heard may be the client.
                with self._client() as client:
                    client.execute("reset")  # one that was killed while armed waits for it
                    client.execute("arm")
                return
            except GraphError as error:
                self._nodes.check()
                if attempt == ATTEMPTS - 1:
                    raise GraphError(f"the bridge cannot be armed: {error}") from None
                if attempt == RESTART_AFTER - 1:
                    self.restarts += 1
                    self._nodes.kill("coil_bridge")
                    self._nodes.start("coil_bridge")

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

    def _driven(self) -> bool:
        self.watch.look()
        return self.watch.driven

    def _driven_for_a_while(self) -> bool:
        return self._driven() and time.monotonic() - self.watch.turns[-1][0] > MOVING


def measure_bridge(
    trials: int,
    kills: int,
    *,
    busy: bool = True,
    log: Log = print,
    progress: Progress = lambda share: None,
) -> dict[str, Any]:
    """Measure a coil bridge that drives simulated RoboClaw boards, on a machine all of whose cores are busy.

    Args:
        trials: of a commander that falls silent.
        kills: of each process.
        log: called with a line for a person at each stage.
        progress: called with the share of a stage done, 0 to 1.
        busy: whether to keep all cores busy meanwhile; else boards have more time for an answer.

    Returns:
        The figures: `delays` as of `zero_delays`; `loop`, by how much an interval of the loop differs from its period
        (median, 99th percentile, greatest) [ms], its `rate` [Hz] and the process's `scheduling`;
        `restarts` as of `BridgeBench`.
    """
    # Only here, where it is needed: without ROS the other commands still work.
    from magnetosuture_thread.nodes.clients import CoilClient
    from magnetosuture_thread.nodes.processes import (
        NodeProcesses,
        environment_of,
        graph_environment,
        reserved_domain,
    )

    settings = read_setup(SETUP).coils
    delays: list[dict[str, Any]] = []

    def add(event: str, found: list[float], bound: float) -> None:
        delays.append(spread := zero_delays(event, found, bound))
        log(f"  {event}: median {1e3 * spread['median']:.1f}, maximum {1e3 * spread['greatest']:.1f} ms")

    with tempfile.TemporaryDirectory() as name, reserved_domain() as domain:
        folder = Path(name)
        ports = [str(folder / f"board_{index}") for index in range(2)]
        stage = PowerStage(ports, SUPPLY, RESISTANCE, INDUCTANCE)
        # No thread is predicted here, and nothing shall go slower for that; there is no needle that could follow.
        alone = {"without_prediction": "slow", "speed_without_prediction": settings.max_speed, "pose_uncertainty": 0.01}
        boards = {"roboclaw_ports": ports, "roboclaw_addresses": [board.address for board in stage.boards]}
        parameters = {"driver": "roboclaw", **boards, "coil_resistance": RESISTANCE, **alone}
        if not busy:  # a test, on a machine that others may keep busy
            parameters["roboclaw_answer_timeout"] = 0.5
        file = folder / "parameters.yaml"
        file.write_text(yaml.safe_dump({"/**/coil_bridge": {"ros__parameters": parameters}}), encoding="utf-8")
        arguments = ["--params-file", str(read_setup(SETUP).path), "--params-file", str(file)]
        environment, logs = graph_environment(domain), folder / "logs"
        stage.open()
        try:
            with environment_of(environment), NodeProcesses((), arguments, environment, logs) as nodes, _load(busy):
                bench = BridgeBench(stage, nodes, CoilClient, logs, progress)
                bench.start("coil_bridge")
                bench.start("tracker")
                log(f"{trials} times a commander that falls silent")
                add("last command", bench.stop_trials(trials), settings.command_timeout + 1.0 / settings.rate)
                with CoilClient() as client:
                    loop, scheduling = client.loop_timing()
                bench.start("commander")
                for victim in ("commander", "tracker", "coil_bridge"):
                    log(f"{kills} times kill -9 of the {victim}")
                    add(f"kill -9 of {victim}", bench.kills(victim, kills), KILL_BOUND)
        finally:
            stage.close()
    return {
        "delays": delays,
        **{"loop": loop, "scheduling": scheduling, "rate": settings.rate, "restarts": bench.restarts},
    }


@contextmanager
def _load(busy: bool) -> Iterator[None]:
    """Keep every core busy, if asked to."""
    work = [sys.executable, "-c", "while True: pass"]
    hogs = [subprocess.Popen(work, start_new_session=True) for _ in range((os.cpu_count() or 1) * busy)]
    try:
        yield
    finally:
        for hog in hogs:
            hog.send_signal(signal.SIGKILL)
            hog.wait()


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    for name, default, what in (
        ("trials", 500, "a commander that falls silent"),
        ("kills", 20, "kill -9 of each process"),
    ):
        parser.add_argument(
            f"--{name}", type=whole_number, default=default, metavar="N", help=f"{what} (default: {default})"
        )


def run(options: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Time the bridge; return the figures."""
    with progress(console, "bridge") as advance:
        figures = measure_bridge(options.trials, options.kills, log=make_log(console), progress=advance)
    console.print(bridge_table(figures))
    return figures, True


def bridge_table(figures: dict[str, Any]) -> Table:
    """Return the figures as a table that fits 80 columns."""
    table = Table(title="coil bridge with simulated boards, all cores busy; times in ms", title_justify="left")
    table.caption = f"zero: of the duties of all boards; loop at {figures['rate']:g} Hz, {figures['scheduling']}"
    table.add_column("", no_wrap=True)
    for name in ("median", "p99", "maximum", "bound", "beyond"):
        table.add_column(name, justify="right", no_wrap=True)
    for each in figures["delays"]:
        values = (f"{1e3 * each[name]:.1f}" for name in ("median", "p99", "greatest", "bound"))
        table.add_row(each["event"], *values, f"{each['beyond']}/{each['count']}")
    table.add_row("loop off its period", *(f"{value:.2f}" for value in figures["loop"]), "", "")
    table.add_row("restarts after a kill", "", "", "", "", str(figures["restarts"]))
    return table
