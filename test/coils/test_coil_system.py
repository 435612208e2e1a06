"""Bridge, driver and latch as one unit."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnetosuture_thread.coils.bridge import CoilBridge
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
    named, imported, neither = (
        "not_installed_yet:Bound",
        "magnetosuture_thread.geometry.barrier:Barrier",
        "antigravity:Bound",
    )
    system.import_barriers([named])
    system.check_barriers([named, imported])
    for name in (neither, "not_installed_yet:Another"):
        with pytest.raises(ConfigurationError, match="named when the node started"):
            system.check_barriers([named, name])
