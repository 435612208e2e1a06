"""What a commissioning leaves in its folder: a bag of every pulse, the setup, and the values of its summary."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from magnetosuture_thread.bags.packing import packed_pose, packed_rig_currents
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import read_pose, stamp_of
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.calibration.commission import SQUARE_ERROR, Bench, Commissioned
from magnetosuture_thread.calibration.pulse_model import (
    DELAY_UNIT,
    KINDS,
    LIGHT_UNIT,
    RESIDUAL_UNIT,
    Pulse,
    RigParameters,
)
from magnetosuture_thread.calibration.stop_checks import StopBench, check_stops
from magnetosuture_thread.coils.calibration import CoilCalibration
from magnetosuture_thread.coils.field import CoilProperties
from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.evaluation.metrics import plain_values
from magnetosuture_thread.geometry.polyline import Vector
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.rig.setups import Setup, read_setup
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.configuration import read_yaml
from magnetosuture_thread.settings.errors import BagError, ConfigurationError
from magnetosuture_thread.settings.files import whole_file, whole_folder
from magnetosuture_thread.settings.shared_parameters import EVERY_NODE, PARAMETERS, read_sections

SETUP_FILE, COILS_FILE, SUMMARY_FILE, REPORT_FILE, PULSES, STOPS_FILE = (
    "setup.yaml",
    "coils.yaml",
    "summary.json",
    "report.pdf",
    "pulses",
    "stops.json",
)
MEASURED, GAUGE, ASSUMED = "measured", "gauge", "assumed"


class RecordedBench:
    """A bench whose pulses are kept as bags; those that a run before has left are taken from there.

    Everything that is decided follows from pulses, so a run that was interrupted decides the same again, and goes on.

    Args:
        bench: that gives the pulses which are not there.
        folder: of the bags.
        notes: of each bag.

    Attributes:
        needle_length: as measured when the first pulse was given [m].
        reused: pulses that were there.
    """

    def __init__(self, bench: Bench, folder: Path, notes: Mapping[str, str]) -> None:
        self._bench, self._folder, self._notes, self._index = bench, folder, dict(notes), 0
        self.needle_length, self.reused = bench.needle_length, 0
        if (first := self._path(0)).exists():
            kept = Bag(first).notes
            if any(kept.get(key) != text for key, text in notes.items()):
                raise BagError(first, "is of another setup or rig; choose another folder")
            self.needle_length = float(kept["needle_length"])
        self._notes["needle_length"] = repr(self.needle_length)

    def pulse(self, currents: Vector, seconds: float) -> Pulse:
        """Return a pulse that is there, or give it and keep it; see `Bench`."""
        path, self._index = self._path(self._index), self._index + 1
        if not path.exists():
            write_pulse(path, self._bench.pulse(currents, seconds), self._notes)
            return read_pulse(path)  # as it will be read again
        pulse = read_pulse(path)
        if not np.allclose(pulse.currents, currents, rtol=0.0, atol=1e-12):
            raise BagError(path, "holds other currents than would be given now; choose another folder")
        self.reused += 1
        return pulse

    def _path(self, index: int) -> Path:
        return self._folder / f"{index:03d}"


def checked_stops(
    bench: StopBench, path: Path, log: Callable[[str], None], currents: Vector, speed: float
) -> list[str]:
    """Check what ends currents, each time that a rig is commissioned; return why nothing more may be done.

    Args:
        bench: to drive.
        path: of the file, which is written.
        log: called with a line for a person.
        currents: see `check_stops`.
        speed: the same.
    """
    checks = check_stops(bench, currents, speed, log)
    with whole_file(path) as partial:
        partial.write_text(json.dumps(checks, indent=2) + "\n", encoding="utf-8")
    return [f"{name}: {problem}" for name, problem in checks.items() if problem]


def read_stops(path: Path) -> dict[str, str]:
    """Return why each check failed, empty if it passed, by its name.

    Raises:
        ConfigurationError: the file is damaged.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return {str(name): str(problem) for name, problem in content.items()}
    except (AttributeError, ValueError):
        raise ConfigurationError("stops", path.name, "a file that commission wrote; remove it", str(path)) from None


def write_pulse(path: Path, pulse: Pulse, notes: Mapping[str, str]) -> None:
    """Write a pulse as a bag: currents when they were switched, and the needle's poses.

    Raises:
        BagError: it exists, or cannot be written.
    """
    kept = {**notes, "ended": pulse.ended}
    with whole_folder(path) as folder, BagWriter(folder, kept, name=path.name) as bag:
        for channel in (interface.CURRENTS, interface.NEEDLE_POSE):
            bag.add_topic(channel.recorded, channel.type_name)
        for time, currents in ((pulse.on, pulse.currents), (pulse.off, np.zeros_like(pulse.currents))):
            stamp = round(1e9 * time)
            bag.write(interface.CURRENTS.recorded, stamp, packed_rig_currents(stamp, currents))
        for time, (x, y, angle) in zip(pulse.times, pulse.poses, strict=True):
            stamp, heading = round(1e9 * time), np.array([math.cos(angle), math.sin(angle)])
            bag.write(interface.NEEDLE_POSE.recorded, stamp, packed_pose(stamp, np.array([x, y]), heading))


def read_pulse(path: Path) -> Pulse:
    """Read a pulse that `write_pulse` wrote.

    Raises:
        BagError: the bag is damaged, or of something else.
    """
    bag, switched, times, poses = Bag(path), [], [], []
    for record in bag.records({interface.CURRENTS.recorded, interface.NEEDLE_POSE.recorded}):
        stamp = 1e-9 * stamp_of(record)
        if record.topic == interface.CURRENTS.recorded:
            switched.append((stamp, np.array(record.decode().current, dtype=float)))
        else:
            tail, heading, _ = read_pose(record)
            times.append(stamp)
            poses.append([*tail, math.atan2(heading[1], heading[0])])
    if bag.damage or len(switched) != 2 or not poses:
        raise BagError(path, f"is no whole pulse: {bag.damage or 'currents or poses are missing'}")
    (on, currents), (off, _) = switched
    array = np.array(poses)
    array[:, 2] = np.unwrap(array[:, 2])
    return Pulse(currents, on, off, np.array(times), array, bag.notes.get("ended", ""))


@dataclass(frozen=True)
class Value:
    """A value of a rig: what it is, and how it is known.

    Attributes:
        name: of the setup's parameter, with the coil's where it has its own.
        unit: SI.
        value: that was found.
        interval: half of its 95 % interval; nan where it has none.
        kind: measured, gauge (held, as only its product with others shows) or assumed.
        before: as believed by the setup; nan where it says nothing.
    """

    name: str
    unit: str
    value: float
    interval: float
    kind: str
    before: float

    @property
    def change(self) -> float:
        """How far it is off what was believed, an angle in rad, else as a share; nan without that or if held."""
        if self.kind == GAUGE:
            return math.nan
        if self.unit == "rad":
            return math.remainder(self.value - self.before, math.tau)
        if not self.before:
            return math.copysign(math.inf, self.value) if self.value else 0.0
        return self.value / self.before - 1.0

    @property
    def changed(self) -> bool:
        """Whether it is more than a tenth, or 0.1 rad, off what was believed."""
        return abs(self.change) > 0.1


def values_of(result: Commissioned, believed: CoilBridgeSettings) -> list[Value]:
    """Return the values that were found, in the order of a report.

    A distance or radius of the coils that pulses tell no better than a ruler is assumed.
    """
    assert result.model is not None
    rig, needle, coils = result.model.parameters, believed.needle(), believed.coils_properties()
    wide = result.model.intervals
    values = []
    for k, coil in enumerate(coils):
        angle, strength = math.remainder(float(rig.angles[k]), math.tau), float(rig.fields[k])
        values.append(Value(f"{coil.name} angle", "rad", angle, wide[f"angle {k}"], MEASURED, coil.angle))
        field = wide[f"field {k}"] * abs(strength)
        values.append(Value(f"{coil.name} field_per_current", "T/A", strength, field, MEASURED, coil.field_per_current))
    own_drag, thread = needle.slack_drag, believed.thread_drag * liquid_factor(rig, believed)
    shares = (
        ("needle_length", "m", rig.length, wide["length"], believed.needle_length),
        ("coil_distance", "m", rig.distance, wide["distance"], float(np.mean([coil.distance for coil in coils]))),
        ("coil_radius", "m", rig.radius, wide["radius"], float(np.mean([coil.radius for coil in coils]))),
        ("needle_drag without thread", "N s/m", rig.drag[0], wide["drag along"], own_drag),
        ("needle_drag_across", "N s/m", rig.drag[1], wide["drag across"], needle.drag_across),
        ("needle_turning_drag", "N m s", rig.drag[2], wide["turning drag"], needle.turning_drag),
    )
    for name, unit, value, share, before in shares:
        kind = ASSUMED if share > 0.25 else MEASURED
        values.append(Value(name, unit, value, share * value, kind, before))
    nothing, delay = math.nan, DELAY_UNIT * wide["delay"]
    values.append(Value("motion_delay", "s", rig.delay, delay, MEASURED, believed.motion_delay))
    for axis, residual in zip("xy", rig.residual.tolist(), strict=True):
        interval = RESIDUAL_UNIT * wide[f"residual {axis}"]
        values.append(Value(f"residual field {axis}", "T", residual, interval, MEASURED, nothing))
    for axis, light in zip("xy", rig.light.tolist(), strict=True):
        share = wide[f"light {axis}"]
        kind = ASSUMED if share > 0.5 * 1.96 * KINDS["light x"][0] else MEASURED  # else little more than was assumed
        values.append(Value(f"light {axis}", "m", light, LIGHT_UNIT * share, kind, nothing))
    mean = math.exp(np.log(np.abs(rig.fields)).mean())
    values.append(Value("mean field_per_current", "T/A", mean, nothing, GAUGE, mean))
    values.append(Value("needle_moment", "A m^2", rig.moment, nothing, GAUGE, needle.moment))
    values.append(Value("thread_drag", "N s/m", thread, nothing, ASSUMED, believed.thread_drag))
    return values


def liquid_factor(rig: RigParameters, believed: CoilBridgeSettings) -> float:
    """Return by how many times as much as believed the liquid resists: the thread too, as the needle for its length."""
    needle = believed.needle()
    return (rig.drag[0] / rig.length) / (needle.slack_drag / needle.length)


def write_setup(folder: Path, result: Commissioned, setup: Setup, date: str) -> Path:
    """Write the setup with what was found, and the coils' calibration that it names; return its path.

    What is simulated where there is no rig stays as the setup had it.

    Raises:
        ConfigurationError: what was found is outside of what a setup can hold; nothing is written.
    """
    assert result.model is not None
    rig, believed = result.model.parameters, setup.coils
    sizes = rig.distance, rig.radius
    coils = [
        CoilProperties(coil.name, math.remainder(angle, math.tau), *sizes, field, resistance=coil.resistance)
        for coil, angle, field in zip(believed.coils_properties(), rig.angles, rig.fields.tolist(), strict=True)
    ]
    notes = "by pulses of the coils; strengths are relative, their mean is that of the setup before"
    path, liquid = (folder / COILS_FILE).resolve(), liquid_factor(rig, believed)
    thread = believed.thread_drag * liquid
    simulated = {"coil_angles": list(setup.rig.coil_angles), "needle_length": setup.rig.needle_length}
    changes: dict[str, dict[str, Any]] = {
        EVERY_NODE: {"needle_length": round(rig.length, 7), "coil_angles": [round(coil.angle, 6) for coil in coils]},
        f"{EVERY_NODE}/{CoilBridgeSettings.GROUP}": {
            "calibration": str(path),
            "commissioning": False,
            "needle_moment": rig.moment,
            "needle_drag": rig.drag[0] + thread,
            "thread_drag": thread,
            "max_pull": believed.max_pull * liquid,
            "needle_drag_across": rig.drag[1],
            "needle_turning_drag": rig.drag[2],
            "motion_delay": rig.delay,
        },
    }
    sections, key = changed_sections(setup.path, changes), f"{EVERY_NODE}/{RigSettings.GROUP}"
    sections[key] = {**simulated, **sections.get(key, {})}
    text = setup_text(sections)
    with whole_file(path) as partial:
        partial.write_text(CoilCalibration(setup.name, date, notes, tuple(coils)).to_yaml(), encoding="utf-8")
    with whole_file(folder / SETUP_FILE) as partial:
        partial.write_text(f"# {setup.name}, commissioned {date}; see {SUMMARY_FILE}.\n{text}", encoding="utf-8")
        read_setup(str(partial))
    return folder / SETUP_FILE


def changed_sections(path: Path, changes: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the parameters of a setup's file by section, with some of them changed.

    Raises:
        ConfigurationError: the file cannot be read.
    """
    sections: dict[str, dict[str, Any]] = {}
    for key, values in (*read_sections(path), *changes.items()):
        sections.setdefault(key, {}).update(values)
    return sections


def setup_text(sections: Mapping[str, Mapping[str, Any]]) -> str:
    """Return parameters by section as the text of a setup's file."""
    return yaml.safe_dump({key: {PARAMETERS: values} for key, values in sections.items()}, sort_keys=False)


def read_rig(folder: Path, believed: CoilBridgeSettings) -> RigParameters:
    """Return the rig that a commissioning in a folder found.

    Raises:
        ConfigurationError: there is no summary with values.
    """
    path = folder / SUMMARY_FILE
    content = read_yaml(path, "summary of a commissioning")
    listed = content.get("values", []) if isinstance(content, dict) else []
    values = {str(entry["name"]): float(entry["value"]) for entry in listed}
    try:
        names = [coil.name for coil in believed.coils_properties()]
        drags = ("needle_drag without thread", "needle_drag_across", "needle_turning_drag")
        along, across, turning = (values[name] for name in drags)
        return RigParameters(
            angles=np.array([values[f"{name} angle"] for name in names]),
            fields=np.array([values[f"{name} field_per_current"] for name in names]),
            distance=values["coil_distance"],
            radius=values["coil_radius"],
            moment=values["needle_moment"],
            length=values["needle_length"],
            drag=(along, across, turning),
            delay=values["motion_delay"],
            residual=np.array([values["residual field x"], values["residual field y"]]),
            light=np.array([values.get("light x", 0.0), values.get("light y", 0.0)]),
        )
    except KeyError as error:
        raise ConfigurationError("values", f"no {error}", "those of this setup's coils", str(path)) from None


def verify_square(
    result: Commissioned, setup: Setup, follow_square: Callable[[CoilBridgeSettings], tuple[float, str]]
) -> Commissioned:
    """Let the needle follow a square with the setup that would be written; return the result with what came of it.

    Args:
        result: of the pulses.
        setup: that was believed.
        follow_square: steers the needle slowly around it by a coil bridge with such settings; returns the largest
            distance from it [m], and why its end was not reached, empty if it was.
    """
    if result.failures:
        return result
    with TemporaryDirectory() as folder:
        coils = read_setup(str(write_setup(Path(folder), result, setup, ""))).coils
        apart, problem = follow_square(coils)
    if not problem and apart > SQUARE_ERROR:
        problem = f"the needle is {1e3 * apart:.2f} mm off ({1e3 * SQUARE_ERROR:g} mm allowed)"
    return replace(result, square=apart, failures=(f"square: {problem}",) if problem else ())


def summary_of(result: Commissioned, setup: Setup, how: Mapping[str, Any]) -> dict[str, Any]:
    """Return verdict, findings, verification and values as plain values.

    Args:
        result: of the commissioning.
        setup: that was believed.
        how: it was done: what the poses are of, the rig, the time it took.
    """
    summary: dict[str, Any] = {"setup": setup.name, "verdict": "refused" if result.failures else "pass"}
    summary |= {"failures": list(result.failures), "findings": list(result.findings), **how}
    summary["ladder"] = [plain_values(answer) for answer in result.answers]
    largest = max(float(np.abs(pulse.currents).max()) for pulse in result.pulses)
    summary |= {"pulses": len(result.pulses), "largest_current": largest}
    if len(result.errors):
        worst, heading = result.errors.max(axis=0).tolist()
        median = float(np.median(result.errors[:, 0]))
        summary["verification"] = {"median_error": median, "worst_error": worst, "worst_heading": heading}
    if math.isfinite(result.square):
        summary["verification"]["square"] = result.square
    if result.model is not None:
        values = values_of(result, setup.coils)
        summary["values"] = [{**plain_values(value), "changed": value.changed} for value in values]
        summary["not_known_well_enough"] = list(result.open)
    return summary
