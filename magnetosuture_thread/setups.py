"""Set-ups: the settings of all nodes, from one YAML file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from magnetosuture_thread.coils.settings import CoilBridgeSettings
from magnetosuture_thread.configuration import from_mapping, load_setup, read_yaml, to_mapping
from magnetosuture_thread.console.settings import ConsoleSettings
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.guidance.settings import PathFollowerSettings
from magnetosuture_thread.model.settings import ThreadModelSettings
from magnetosuture_thread.resources import setup_file
from magnetosuture_thread.rig.settings import RigSettings
from magnetosuture_thread.vision.settings import VisionTrackerSettings

CLASSES = (
    VisionTrackerSettings,
    ThreadModelSettings,
    CoilBridgeSettings,
    RigSettings,
    PathFollowerSettings,
    ConsoleSettings,
)

SAME = (
    (("vision_tracker", "thread_length"), ("thread_model", "length")),
    (("coil_bridge", "needle_length"), ("vision_tracker", "needle_length")),
    (("path_follower", "needle_length"), ("vision_tracker", "needle_length")),
    (("path_follower", "needle_curvature"), ("coil_bridge", "needle_curvature")),
    (("coil_bridge", "dish_diameter"), ("vision_tracker", "dish_diameter")),
    (("console", "dish_diameter"), ("vision_tracker", "dish_diameter")),
    (("console", "needle_length"), ("vision_tracker", "needle_length")),
    (("console", "needle_curvature"), ("coil_bridge", "needle_curvature")),
    (("coil_bridge", "disc_obstacles"), ("thread_model", "disc_obstacles")),
    (("coil_bridge", "polygon_obstacles"), ("thread_model", "polygon_obstacles")),
    (("coil_bridge", "polygon_sizes"), ("thread_model", "polygon_sizes")),
)


@dataclass(frozen=True)
class Setup:
    """One set-up.

    Attributes:
        name: the file's name without its ending.
        path: the file.
        vision: settings of the vision tracker.
        model: settings of the thread model.
        coils: settings of the coil bridge.
        rig: settings of the simulated rig.
        follower: settings of the path follower.
        console: settings of the operator's page.
    """

    name: str
    path: Path
    vision: VisionTrackerSettings
    model: ThreadModelSettings
    coils: CoilBridgeSettings
    rig: RigSettings
    follower: PathFollowerSettings
    console: ConsoleSettings


def read_setup(name: str) -> Setup:
    """Read a set-up, given as a path or as the name of one that ships with the package.

    Raises:
        ConfigurationError: there is no such file, or it holds anything invalid.
    """
    path = setup_file(name)
    settings = load_setup(path, CLASSES)
    settings[ConsoleSettings.GROUP] = _console(path, settings)
    # What several nodes must know of the same thing is in the section of each, as ROS has it.
    for one, other in SAME:
        value, expected = (getattr(settings[group], field) for group, field in (one, other))
        if value != expected:
            raise ConfigurationError(".".join(one), value, f"{expected}, as {'.'.join(other)}", str(path))
    points = np.reshape(settings["path_follower"].waypoints, (-1, 2))
    radius = 0.5 * settings["vision_tracker"].dish_diameter
    outside = points[np.linalg.norm(points, axis=1) >= radius].tolist()
    if outside:
        raise ConfigurationError("path_follower.waypoints", outside[0], f"within the dish, {radius:g} m", str(path))
    return Setup(path.stem, path, *(settings[cls.GROUP] for cls in CLASSES))


def _console(path: Path, settings: dict[str, Any]) -> ConsoleSettings:
    """Return the page's settings: what its section does not say of dish and needle is as the other nodes have it.

    Set-ups from before the page have no such section, and those in their bags neither.
    """
    group = ConsoleSettings.GROUP
    section = read_yaml(path, "set-up file").get(group, {"ros__parameters": {}})
    mine = [(field, other) for (owner, field), other in SAME if owner == group]
    given = section["ros__parameters"]
    told = {field: getattr(settings[owner], name) for field, (owner, name) in mine if field not in given}
    return from_mapping(ConsoleSettings, {**to_mapping(settings[group]), **told}, str(path))
