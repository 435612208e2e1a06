"""What has to end a current: a bench on which each of it fails in its own way, and what is said then."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magnetosuture_thread.calibration.commission_files import checked_stops, read_stops
from magnetosuture_thread.calibration.pulse_model import Pulse
from magnetosuture_thread.calibration.stop_checks import check_stops
from magnetosuture_thread.settings.errors import ConfigurationError

SPEED, CURRENTS = 1e-3, np.array([0.05, 0.0, 0.0, 0.0])
PASSED = ["emergency stop", "no poses", "standstill of the bridge"]


class FakeBench:
    """A needle that goes at a speed for as long as currents flow, 50 ms late.

    Args:
        deaf: names of what ends no current.
        silent: names of what seems to end one by the bridge, while the needle moves on.
        near: whether the bridge's process can be stopped from here.
    """

    needle_length, driver_timeout = 7e-3, 0.2

    def __init__(self, deaf: tuple[str, ...] = (), silent: tuple[str, ...] = (), near: bool = True) -> None:
        self.deaf, self.silent, self.near = deaf, silent, near
        self.done: list[str] = []
        self.recovered = 0
        self.now = 10.0

    def disturbed_pulse(
        self, currents: np.ndarray, seconds: float, after: float, disturbance: Any, hold: float
    ) -> tuple[Pulse, float, float]:
        """Give currents for a time."""
        on = self.now
        with disturbance:
            what, begun, over = self.done[-1], on + after, on + after + hold
        boards = what == "standstill of the bridge"
        ended = on + seconds if what in self.deaf else begun + (0.2 if boards else 0.1)
        flows = over if what in self.deaf and boards else ended
        rest = over + 1.0 if what in self.silent else flows
        times = np.arange(on - 0.2, over + 1.0, 1.0 / 60.0)
        x = SPEED * (np.clip(times - 0.05, on, rest) - on)
        poses = np.column_stack([x, np.zeros_like(x), np.zeros_like(x)])
        reason = "" if what in self.deaf else {"no poses": "no needle pose for 0.2 s"}.get(what, what)
        self.now = over + 2.0
        return Pulse(currents, on, over if boards else ended, times, poses, reason), begun, over

    @contextmanager
    def _doing(self, what: str) -> Iterator[None]:
        self.done.append(what)
        yield

    def stopped(self) -> Any:
        """Press the emergency stop."""
        return self._doing("emergency stop")

    def blind(self) -> Any:
        """Let no poses come."""
        return self._doing("no poses")

    def frozen(self) -> Any:
        """Let the bridge stand still."""
        return self._doing("standstill of the bridge") if self.near else None

    def recover(self, causes: tuple[str, ...]) -> None:
        """Count, and reset only what a check has caused."""
        assert self.done[-1] in causes or self.done[-1] != "emergency stop"
        self.recovered += 1


def problems(bench: FakeBench) -> dict[str, str]:
    """Return what is wrong, by the name of each check."""
    return check_stops(bench, CURRENTS, SPEED, lambda line: None)


def test_each_is_tried_once_where_all_is_well():
    bench = FakeBench()
    assert problems(bench) == dict.fromkeys(PASSED, "")
    assert bench.done == PASSED
    assert bench.recovered == 3


@pytest.mark.parametrize("name", PASSED[:2])
def test_what_does_not_end_a_current_is_named_after_three_tries(name: str):
    bench = FakeBench(deaf=(name,))
    found = problems(bench)
    assert found.pop(name) == "currents ended by their time"
    assert not any(found.values())
    assert bench.done.count(name) == 3


@pytest.mark.parametrize("name", PASSED[:2])
def test_a_needle_that_moves_on_is_named_whatever_the_bridge_says(name: str):
    found = problems(FakeBench(silent=(name,)))
    assert found.pop(name).startswith("the needle moves on, by ")
    assert not any(found.values())


def test_boards_that_do_not_stop_by_themselves_are_found_by_the_camera():
    found = problems(FakeBench(deaf=("standstill of the bridge",)))
    assert found["standstill of the bridge"].startswith("the needle moves on, by 0.")


def test_a_bridge_on_another_computer_is_left_to_a_person():
    lines: list[str] = []
    checks = check_stops(FakeBench(near=False), CURRENTS, SPEED, lines.append)
    assert [*checks] == PASSED[:2]
    assert lines[-1].endswith("not checked from here: end the bridge by kill -9 while a current flows")


def test_all_is_checked_each_time_that_a_rig_is_commissioned(tmp_path: Path):
    path = tmp_path / "stops.json"
    bad = FakeBench(deaf=("no poses",))
    failures = checked_stops(bad, path, lambda line: None, CURRENTS, SPEED)
    assert failures == ["no poses: currents ended by their time"]
    good = FakeBench()
    assert checked_stops(good, path, lambda line: None, CURRENTS, SPEED) == []
    assert good.done == PASSED
    assert json.loads(path.read_text()) == dict.fromkeys(PASSED, "")
    assert checked_stops(good, path, lambda line: None, CURRENTS, SPEED) == []
    assert good.done == PASSED * 2
    path.write_text("[1]")
    with pytest.raises(ConfigurationError, match="a file that commission wrote"):
        read_stops(path)
