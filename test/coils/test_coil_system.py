"""Bridge, driver and latch as one unit."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnetosuture_thread.coils.bridge import FIRST_WAY, CoilBridge
from magnetosuture_thread.coils.coil_system import CoilSystem
from magnetosuture_thread.coils.drivers import RecordingDriver
from magnetosuture_thread.coils.latch import StopRecord
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.geometry.scene import Scene
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError


@pytest.fixture
def system() -> CoilSystem:
    """An open system."""
    made, settings = CoilSystem(), CoilBridgeSettings()
    made.open(settings, CoilBridge(settings, made.latch, Scene()), RecordingDriver(4))
    return made


def test_its_end_is_zero_with_the_reason(system):
    system.step(500.0, 100.0)
    final = system.close("finalized")
    assert not final.allocation.currents.any()
    assert (final.reasons, final.publish) == (("finalized",), True)
    assert system.closed_reasons == ("finalized",)
    assert system.close() is None


def test_where_arming_cannot_be_recorded_it_does_not_arm(system, tmp_path: Path):
    (tmp_path / "state").write_text("a file in the place of the folder")
    system.recall(StopRecord(tmp_path / "state" / "bridge.stop"))
    system.latch.reset("")
    system.latch.activate()
    with pytest.raises(InvalidInputError, match="stop_file"):
        system.arm(True)
    assert not system.latch.armed
    system.arm_when_ready()
    system.step(500.0, 100.0)
    assert "stop_file" in system.latch.fault


@pytest.mark.parametrize("switch", ["disarm", "reset", "fault", "close"])
def test_any_switch_or_fault_before_cancels_that_it_arms_when_ready(system, switch: str):
    system.latch.activate()
    system.arm_when_ready()
    if switch == "disarm":
        system.arm(False)
    elif switch == "reset":
        system.reset()
    elif switch == "fault":
        system.driver.close()
        system.latch.trip("of a board")
        system.step(500.0, 100.0)
        system.driver.open()
        system.latch.reset("")
    else:
        settings = CoilBridgeSettings()
        system.close()
        system.open(settings, CoilBridge(settings, system.latch, Scene()), RecordingDriver(4))
    system.step(500.0, 100.01)
    assert not system.latch.armed


def test_only_barriers_that_were_named_at_the_start_or_imported_by_others_are_taken(system):
    named = "not_installed_yet:Bound"
    system.import_barriers([named])
    system.check_barriers([named, "magnetosuture_thread.geometry.barrier:Barrier"])
    for name in ("antigravity:Bound", "not_installed_yet:Another"):
        with pytest.raises(ConfigurationError, match="named when the node started"):
            system.check_barriers([named, name])


class MovingDriver(RecordingDriver):
    """A driver of something that moves."""

    moves_nothing = False


def opened(
    path: Path, settings: CoilBridgeSettings, driver: type[RecordingDriver] = MovingDriver
) -> tuple[CoilSystem, CoilBridge]:
    """Return system and bridge of a process that has begun with a setup."""
    system = CoilSystem()
    system.recall(StopRecord(path))
    bridge = CoilBridge(settings, system.latch, Scene())
    system.open(settings, bridge, driver(4))
    return system, bridge


def test_a_setup_that_a_needle_has_not_followed_with_moves_it_slowly_at_first(tmp_path: Path):
    path, known, changed = tmp_path / "bridge.stop", CoilBridgeSettings(), CoilBridgeSettings(coil_distance=0.06)
    system, bridge = opened(path, known)
    assert bridge.first_way == FIRST_WAY
    system.remember(ends=True)
    assert opened(path, known)[1].first_way == FIRST_WAY  # none has followed yet
    bridge.first_way = 0.0
    system.step(500.0, 100.0)
    system.remember(ends=True)
    assert opened(path, known)[1].first_way == 0.0
    assert opened(path, changed)[1].first_way == FIRST_WAY
    assert opened(path, changed, RecordingDriver)[1].first_way == 0.0
    simulated, _ = opened(path, changed, RecordingDriver)
    simulated.step(500.0, 100.0)
    simulated.remember(ends=True)
    system, bridge = opened(path, known)
    assert bridge.first_way == 0.0  # what moves nothing proves nothing, and forgets nothing
    bridge.first_way = bridge.slow_way  # as after a fault
    system.step(500.0, 100.0)
    system.remember(ends=True)
    assert opened(path, known)[1].first_way == FIRST_WAY
    path.write_text("disarmed\n")
    assert opened(path, known)[1].first_way == FIRST_WAY


@pytest.mark.parametrize(
    "change",
    [
        {"coil_angles": (0.1, 1.6, 3.1, 4.7)},
        {"needle_moment": 1e-3},
        {"motion_delay": 0.03},
        {"needle_drag": 0.03},
        {"coil_resistance": 9.0},
        {"aligning_field": 0.01},
        {"motion_compensation": True},
    ],
)
def test_what_moves_the_needle_otherwise_is_another_setup(change):
    assert CoilBridgeSettings(**change).identity != CoilBridgeSettings().identity
    assert CoilBridgeSettings(max_speed=0.01, rate=100.0).identity == CoilBridgeSettings().identity
