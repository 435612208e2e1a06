"""Simulated boards, and a driver on them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.coils.drivers.roboclaw import RoboClawDriver
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.rig.power import PowerStage, RoboClawBoard


class Bench:
    """Two boards and drivers on them; everything ends with the test."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.stage = PowerStage([str(folder / "a"), str(folder / "b")], 24.0, 1.0, 0.01)
        self.drivers: list[RoboClawDriver] = []

    @property
    def boards(self) -> list[RoboClawBoard]:
        """The boards, in order."""
        return self.stage.boards

    def share(self) -> None:
        """Put both boards on one line."""
        self.stage.close()
        self.stage = PowerStage([str(self.folder / "a")] * 2, 24.0, 1.0, 0.01)

    def settings(self, **changes: Any) -> CoilBridgeSettings:
        """Return settings for the boards."""
        ports = [str(line.path) for line in self.stage.lines for _ in line.boards]
        addresses = [board.address for board in self.boards]
        slow = {"max_speed": 0.005}  # with which the boards may have any timeout
        return CoilBridgeSettings(**{"roboclaw_ports": ports, "roboclaw_addresses": addresses, **slow, **changes})

    def open(self, *, ready: bool = True, apply_timeout: float | None = None, **changes: Any) -> RoboClawDriver:
        """Return an open driver, once it is ready."""
        self.stage.open()
        driver = RoboClawDriver(self.settings(**changes), apply_timeout=apply_timeout)
        self.drivers.append(driver)
        driver.open()
        if ready:
            self.wait(lambda: driver.state().ready, "the driver to be ready")
        return driver

    def wait(self, condition: Callable[[], bool], what: str, timeout: float = 10.0) -> None:
        """Wait until a condition holds."""
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, f"waited {timeout:g} s for {what}: {self.words()}"
            time.sleep(0.002)

    def words(self) -> str:
        """What goes on, for a failing test."""
        return f"{[driver.state() for driver in self.drivers]}, {[self.duties(k) for k in range(len(self.boards))]}"

    def duties(self, number: int) -> tuple[int, int]:
        """Return a board's duties now."""
        for line in self.stage.lines:
            line.advance()
        return self.boards[number].duties

    def heard(self, number: int, times: int = 5) -> None:
        """Wait until a board has been spoken to some more times."""
        board, left = self.boards[number], times
        last = board.heard

        def enough() -> bool:
            nonlocal last, left
            left -= board.heard > last
            last = board.heard
            return left <= 0

        self.wait(enough, "the driver to go on")

    @contextmanager
    def held(self, driver: RoboClawDriver, *currents: float) -> Iterator[None]:
        """Ask for currents again and again, as the bridge does."""
        ends = threading.Event()

        def ask() -> None:
            while not ends.wait(0.005):
                driver.apply(np.array(currents), time.monotonic())

        thread = threading.Thread(target=ask)
        thread.start()
        try:
            yield
        finally:
            ends.set()
            thread.join()

    def close(self) -> None:
        """End everything."""
        for driver in self.drivers:
            driver.close()
        self.stage.close()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Two boards, each on a line of its own."""
    made = Bench(tmp_path)
    yield made
    made.close()
