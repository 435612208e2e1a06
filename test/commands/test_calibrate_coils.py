"""The command `calibrate-coils`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread import cli
from magnetosuture_thread.coils.calibration import read_calibration
from magnetosuture_thread.coils.field import LoopCoils, coils_around
from magnetosuture_thread.coils.settings import CoilBridgeSettings

ANGLES = (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi)


def probe(folder: Path, reach: float = 0.015, background: float = 3e-5) -> Path:
    """Write what a probe reads of four coils, and without current."""
    coils, random = LoopCoils(coils_around(ANGLES, 0.052, 0.024, 1.1e-3)), np.random.default_rng(0)
    lines = ["coil,current,x,y,bx,by"]
    for coil, current in ((0, 0.0), (0, 2.0), (1, 2.0), (2, -2.0), (3, 2.0)):
        for x, y in reach * random.uniform(-0.7, 0.7, (20, 2)):
            field = current * coils.per_current(np.array([x, y]))[:, coil] + random.normal(background, 1e-5, 2)
            lines.append(f"{coil},{current},{x:.6f},{y:.6f},{field[0]:.8f},{field[1]:.8f}")
    path = folder / "probe.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_calibration_is_written_that_the_bridge_takes(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = tmp_path / "rig_7.yaml"
    assert cli.main(["calibrate-coils", str(probe(tmp_path)), "--output", str(output)]) == 0
    shown = capsys.readouterr().out
    assert "100 readings, residual" in shown
    written = read_calibration(output)
    assert written.name == "rig_7"
    settings = CoilBridgeSettings(calibration=str(output))
    for coil, angle in zip(settings.coils_properties(), ANGLES, strict=True):
        assert np.cos(coil.angle - angle) == pytest.approx(1.0, abs=1e-3)
        assert coil.distance == pytest.approx(0.052, rel=0.1)
        assert coil.field_per_current == pytest.approx(1.1e-3, rel=0.02)


def test_what_fails_leaves_the_calibration_before(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output, measurements = tmp_path / "rig.yaml", probe(tmp_path)
    output.write_text("before")
    lines = measurements.read_text().splitlines()
    wrong = "\n".join([*lines[:7], "0,2.0,0.001,0.001,1000.0,0.0", *lines[8:]])
    far = probe(tmp_path, background=2e-3).read_text()  # far above the earth's
    for text, words in (
        (wrong, f"{measurements}, line 8, bx: got 1000.0, expected a number from -1 to 1 T"),
        (far, "are all fields in T"),
    ):
        measurements.write_text(text)
        assert cli.main(["calibrate-coils", str(measurements), "--output", str(output)]) == 1
        assert words in capsys.readouterr().err
        assert output.read_text() == "before"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["probe.csv", "rig.yaml"]
