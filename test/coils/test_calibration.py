"""The file of the coils' calibration."""

from __future__ import annotations

from pathlib import Path

import pytest

from magnetosuture_thread.coils.calibration import CoilCalibration, read_calibration
from magnetosuture_thread.coils.field import CoilProperties
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.settings.errors import ConfigurationError

COILS = (
    CoilProperties("east", 0.01, 0.052, 0.024, 1.1e-3, 2.5, 3.0e-5),
    CoilProperties("north", 1.55, 0.048, 0.026, -1.3e-3),
    CoilProperties("west", 3.1, 0.05, 0.025, 1.2e-3, 2.7),
    CoilProperties("south", -1.6, 0.05, 0.025, 1.2e-5),
)
GIVEN = CoilCalibration("rig 1", "2026-11-21", "by hand; µT probe", COILS)
COIL = "{name: %s, angle: 0.0, distance: 0.05, radius: 0.025, field_per_current: 1.2e-3}"
THREE = f"[{COIL % 'a'}, {COIL % 'b'}, {COIL % 'c'}]"


def written(folder: Path, text: str) -> Path:
    path = folder / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_what_is_written_is_read(tmp_path: Path):
    assert read_calibration(written(tmp_path, GIVEN.to_yaml())) == GIVEN


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("model: [", "coil calibration: got .* expected valid YAML"),
        ("model: loops", "coils: got None, expected a list of at least 3"),
        (f"model: dipoles\ncoils: {THREE}", "model: got 'dipoles', expected loops, the only model"),
        (f"model: loops\ncoils: [{COIL % 'a'}]", "coils: got '1 coils', expected a list of at least 3"),
        (f"model: loops\ncoils: [{COIL % 'a'}, {COIL % 'b'}, {COIL % 'a'}]", "two of the name a"),
        ("model: loops\ncoils: " + THREE.replace("0.05", ".nan", 1), r"coils\[0\]\.distance: got nan"),
        ("model: loops\ncoils: " + THREE.replace("1.2e-3", "0.0", 1), r"coils\[0\]\.field_per_current: .* at least"),
        ("model: loops\ncoils: " + THREE.replace("radius: 0.025, ", "", 1), r"coils\[0\]\.radius: got None"),
        ("model: loops\ncoils: " + THREE.replace("radius", "turns: 9, radius", 1), r"coils\[0\]\.turns: got 9"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_with_its_name_the_key_and_the_value(
    tmp_path: Path, text: str, words: str
):
    path = written(tmp_path, text)
    with pytest.raises(ConfigurationError, match=words) as caught:
        read_calibration(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_the_bridge_takes_coils_model_reach_and_resistances_from_it(tmp_path: Path):
    path = written(tmp_path, GIVEN.to_yaml())
    settings = CoilBridgeSettings(calibration=str(path), coil_resistance=1.5)
    assert settings.coils_properties() == COILS
    assert settings.resistances() == (2.5, 1.5, 2.7, 1.5)
    assert settings.reach == pytest.approx(0.9 * 0.048)
    assert settings.allocation().names == ("east", "north", "west", "south")


def test_a_calibration_of_another_number_of_coils_is_refused(tmp_path: Path):
    path = written(tmp_path, GIVEN.to_yaml())
    with pytest.raises(
        ConfigurationError, match=r"coil_bridge\.calibration: got '4 coils .*expected 3, as in coil_ang"
    ):
        CoilBridgeSettings(calibration=str(path), coil_angles=(0.0, 2.0, 4.0))
