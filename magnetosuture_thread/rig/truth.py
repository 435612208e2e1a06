"""The truth of a simulated rig beside the setup that is believed: from a file, or drawn at random."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.rig.setups import Setup
from magnetosuture_thread.settings.configuration import from_mapping, to_mapping
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.shared_parameters import EVERY_NODE, key_matches, names_of, read_sections

RANDOM, SEEDS = "random:", 2**31
# A thread that the mechanics take and that does nothing: a stub with less than a thousandth of a needle's drag.
NO_THREAD: dict[str, Any] = {
    "thread_length": 1e-3,
    "thread_segments": 8,
    "thread_diameter": 1e-6,
    "thread_drag_across": 2e-4,
    "thread_drag_along": 1e-4,
    "thread_bending_stiffness": 1e-14,
    "thread_stretching_stiffness": 0.1,
    "thread_attachment": "pinned",
    "thread_friction": 0.0,
    "thread_start_curvature": 0.0,
    "obstacle_looks": (),
}


def with_rig(setup: Setup, rig: str) -> Setup:
    """Return a setup whose simulated rig is another one than it says.

    Args:
        setup: what the nodes believe.
        rig: a parameter file, whose section for `rig_simulator` changes that of the setup; or `random:SEED`, see
            `draw_rig`; empty for the setup's.

    Raises:
        ConfigurationError: the file cannot be used, there is no such seed, or the number of coils is another one.
    """
    if not rig:
        return setup
    if rig.startswith(RANDOM):
        seed = rig.removeprefix(RANDOM)
        if not (seed.isascii() and seed.isdigit() and int(seed) < SEEDS):
            raise ConfigurationError("--rig", rig, f"{RANDOM}SEED with a whole number below {SEEDS}")
        truth = draw_rig(setup.rig, int(seed))
    else:
        truth = _read_rig(setup.rig, Path(rig))
    if len(truth.coil_angles) != (count := len(setup.coils.coil_angles)):
        name = f"{RigSettings.GROUP}.coil_angles"
        raise ConfigurationError(name, list(truth.coil_angles), f"{count} of them, as in {setup.name}", rig)
    return replace(setup, rig=truth).with_scene(setup.scene)


def changed_parameters(rig: RigSettings, believed: RigSettings) -> dict[str, str]:
    """Return the parameters of `rig_simulator` in which a rig is not as it is believed to be, as YAML by name."""
    values, others = to_mapping(rig), to_mapping(believed)
    return {f"{rig.GROUP}:{name}": json.dumps(value) for name, value in values.items() if value != others[name]}


def _read_rig(rig: RigSettings, path: Path) -> RigSettings:
    sections, known = read_sections(path), names_of(RigSettings)
    shared = [{k: v for k, v in values.items() if k in known} for key, values in sections if key == EVERY_NODE]
    own = [values for key, values in sections if key != EVERY_NODE and key_matches(key, f"/{RigSettings.GROUP}")]
    if not own:
        raise ConfigurationError(
            "rig", [key for key, _ in sections], f"a section {EVERY_NODE}/{RigSettings.GROUP}", str(path)
        )
    truth: dict[str, Any] = to_mapping(rig)
    for values in (*shared, *own):
        truth |= values
    return from_mapping(RigSettings, truth, str(path))


def draw_rig(rig: RigSettings, seed: int) -> RigSettings:
    """Return a rig that somebody has built without measuring it.

    Each coil is turned by up to 0.2 rad and 0.5 to 2 times as strong, one is wound the other way, and two cables are
    exchanged; distance and radius of all differ by up to 10 %. The needle is 2.5 to 7 mm long, 0.7 to 1.1 times as
    strong and magnetised either way; the liquid has 0.3 to 3 Pa s, for the thread too. Currents come up to 80 ms late,
    and a field of up to 0.1 mT is always there. The camera is turned by any angle, shows every second rig mirrored, and
    its scale is off by up to 5 %, by which all lengths seem longer, and the field of a coil stays the same.

    Args:
        rig: that is changed.
        seed: of the chances.
    """
    random, count = np.random.default_rng([seed, 56]), len(rig.coil_angles)

    def between(low: float, high: float) -> float:
        return float(low * (high / low) ** random.uniform())

    gains = np.array([between(0.5, 2.0) for _ in range(count)])
    gains[random.integers(count)] *= -1.0
    angles = np.array(rig.coil_angles) + random.uniform(-0.2, 0.2, count)
    cables = random.choice(count, min(2, count), replace=False)
    angles[cables] = angles[cables[::-1]]
    scale, distance, radius = random.uniform(0.95, 1.05), random.uniform(0.9, 1.1), random.uniform(0.9, 1.1)
    viscosity = between(0.3, 3.0)
    drags = {n: getattr(rig, n) * viscosity / rig.viscosity for n in ("thread_drag_across", "thread_drag_along")}
    towards, strength = random.uniform(0.0, math.tau), 1e-4 * math.sqrt(random.uniform())
    return replace(
        rig,
        seed=seed,
        coil_angles=tuple(math.remainder(angle, math.tau) for angle in angles.tolist()),
        coil_gains=tuple(gains.tolist()),
        coil_distance=rig.coil_distance * distance * scale,
        coil_radius=rig.coil_radius * radius * scale,
        coil_length=rig.coil_length * scale,
        coil_turns=rig.coil_turns * scale,
        needle_length=between(2.5e-3, 7e-3) * scale,
        needle_magnetisation=rig.needle_magnetisation * random.uniform(0.7, 1.1) * float(random.choice([-1.0, 1.0])),
        viscosity=viscosity,
        **drags,
        current_delay=random.uniform(0.0, 0.08),
        residual_field=(strength * math.cos(towards), strength * math.sin(towards)),
        camera_rotation=random.uniform(-math.pi, math.pi),
        camera_mirrored=bool(random.integers(2)),
    )


def bare_rig(rig: RigSettings, random: np.random.Generator) -> RigSettings:
    """Return a rig whose needle has no thread and lies in the middle of an empty dish.

    Args:
        rig: that is changed.
        random: draws the needle's heading.
    """
    angle = float(random.uniform(-math.pi, math.pi))
    half = 0.5 * rig.needle_length
    start = (-half * math.cos(angle), -half * math.sin(angle), angle)
    return replace(rig, needle_start=start, **NO_THREAD)
