"""Parameters that several nodes have, and files of parameters: sections for nodes, and setups made of such sections.

Shared parameters are each declared once, in a class that the settings of these nodes inherit from.

Those of `SHARED` are written once in a setup under `/**`. Every node receives all parameters under `/**`. It uses those
of its settings and ignores the other shared ones. Any other unknown parameter is refused.

A section's key says for which nodes it is, as in ROS: `/**` for all, `/**/coil_bridge` for those of this name in any
namespace, `/lab1/coil_bridge` for one. Of several sections for one node, a later one overrides an earlier one,
whichever is the more specific: so rclpy has it, tried with `/**` before and after a node's own section.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from magnetosuture_thread.settings.configuration import (
    ROS_PARAMETERS,
    Configuration,
    configuration_fields,
    errors_of_file,
    from_mapping,
    quantity,
    read_yaml,
    suggest_names,
)
from magnetosuture_thread.settings.errors import ConfigurationError

PARAMETERS = "ros__parameters"
EVERY_NODE = "/**"


@dataclass(frozen=True)
class LifecycleSettings(Configuration):
    """The state that a lifecycle node enters, and how it is scheduled; each node has its own values."""

    autostart: str = quantity(
        "active", "state that the node enters by itself at start", choices=("unconfigured", "inactive", "active")
    )
    realtime_priority: int = quantity(
        5,
        "real-time priority of the process, where permitted, below that of the coil bridge; 0 for none",
        minimum=0,
        maximum=99,
    )


@dataclass(frozen=True)
class SceneName(Configuration):
    """The dish and the shapes in it."""

    scene: str = quantity("", "scene file: a path, or the name of one in config/scenes; none waits for the topic scene")


@dataclass(frozen=True)
class NeedleLength(Configuration):
    """The needle's size."""

    needle_length: float = quantity(0.007, "length of the needle along its body", "m", 0.001, 0.05)


@dataclass(frozen=True)
class NeedleArc(NeedleLength):
    """The needle's axis, an arc."""

    needle_curvature: float = quantity(
        0.0, "curvature of the needle's arc, positive to the left of its heading", "1/m", -1000.0, 1000.0
    )

    def check(self) -> None:
        """Refuse a coiled needle."""
        check_needle(self.GROUP, self.needle_length, self.needle_curvature)


@dataclass(frozen=True)
class NeedleWidth(Configuration):
    """The needle's thickness."""

    needle_width: float = quantity(0.0004, "width of the needle's body", "m", 5e-5, 0.005)


@dataclass(frozen=True)
class CommandFilter(Configuration):
    """How close to wall and shapes commands may bring the needle, and which of them friction slows."""

    keep_out: float = quantity(
        0.0005, "least clearance of the needle's axis to wall and shapes, half of its width included", "m", 2.5e-5, 0.05
    )
    pose_margin: float = quantity(
        0.0, "clearance beside keep_out, for the error of a pose that is extrapolated to the present", "m", 0.0, 0.005
    )
    friction_feedback: str = quantity(
        "all", "which commands the thread's friction slows: all, or the operator's alone", choices=("all", "operator")
    )


@dataclass(frozen=True)
class ThreadLength(Configuration):
    """The thread's size."""

    thread_length: float = quantity(0.019, "rest length of the thread", "m", 0.001, 2.0)


@dataclass(frozen=True)
class Viscosity(Configuration):
    """The liquid in the dish."""

    viscosity: float = quantity(
        1.0, "dynamic viscosity of the liquid; glycerin at room temperature is about 1", "Pa s", 1e-4, 100.0
    )


@dataclass(frozen=True)
class CoilDrivers(Configuration):
    """The coils, and the drivers of their currents."""

    coil_angles: tuple[float, ...] = quantity(
        (0.0, 0.5 * math.pi, math.pi, -0.5 * math.pi),
        "direction of each coil from the dish's centre, against the x axis",
        "rad",
        -2.0 * math.pi,
        2.0 * math.pi,
    )
    driver_timeout: float = quantity(
        0.2, "drivers switch off after this long without new currents; whole tenths for RoboClaw boards", "s", 0.05, 1.0
    )


SHARED = (SceneName, NeedleArc, NeedleWidth, CommandFilter, ThreadLength, Viscosity, CoilDrivers)
SHARED_PARAMETERS = tuple(setting.name for cls in SHARED for setting in configuration_fields(cls))
"""Names of the shared parameters."""


def check_needle(group: str, length: float, curvature: float) -> None:
    """Check that a needle is bent no more than a half circle, as its chord would not be along it any more.

    Args:
        group: section of the settings, for the error.
        length: of the arc [m].
        curvature: [1/m].

    Raises:
        ConfigurationError: the arc turns by more.
    """
    max_turn = 1.02 * math.pi  # tail to tip [rad]; a little more than what suture needles have
    if abs(curvature) * length > max_turn:
        expectation = f"at most {max_turn / length:.0f} 1/m, a half circle for a needle of {length:g} m"
        raise ConfigurationError(f"{group}.needle_curvature", curvature, expectation)


def read_sections(path: Path, what: str = "parameter file") -> list[tuple[str, dict[str, Any]]]:
    """Return the sections of a parameter file in their order: key and parameters by name.

    A namespace may be a level of its own, as in `lab1: {coil_bridge: {ros__parameters: {}}}`. Keys are returned with a
    leading slash.

    Args:
        path: the file.
        what: it is, for errors.

    Raises:
        ConfigurationError: the file cannot be read, is no YAML, or is no parameter file.
    """
    content = read_yaml(path, what)
    if not isinstance(content, Mapping):
        # What the file holds is not shown: it may be none of ours.
        shown = None if content is None else f"content of type {type(content).__name__}"
        raise ConfigurationError(what, shown, f"sections by node, each with {PARAMETERS}", str(path))
    return list(_sections("", content, str(path)))


def _sections(above: str, content: Mapping[str, Any], source: str) -> Iterable[tuple[str, dict[str, Any]]]:
    for name, section in content.items():
        key = f"{above}/{str(name).strip('/')}"
        if not isinstance(section, Mapping) or not section:
            raise ConfigurationError(key, section, f"one key, {PARAMETERS}", source)
        if PARAMETERS not in section:
            yield from _sections(key, section, source)
            continue
        values = section[PARAMETERS]
        if len(section) > 1:
            raise ConfigurationError(key, list(section), f"one key, {PARAMETERS}", source)
        if not isinstance(values, Mapping):
            raise ConfigurationError(f"{key}.{PARAMETERS}", values, "parameters by name", source)
        for parameter, value in values.items():
            if isinstance(value, list) and len({type(entry) for entry in value}) > 1:  # ROS takes no such file
                at = f"{key}.{parameter}"
                raise ConfigurationError(at, value, "entries of one kind: 0.0, not 0", source)
        yield key, {str(parameter): value for parameter, value in values.items()}


def key_matches(key: str, node: str) -> bool:
    """Return whether a section is for a node: `*` stands for one name, `**` for any number of them, none too.

    Args:
        key: of the section, with a leading slash.
        node: its fully qualified name.

    >>> key_matches("/**/coil_bridge", "/lab1/coil_bridge"), key_matches("/coil_bridge", "/lab1/coil_bridge")
    (True, False)
    """
    parts = {"**": "(/[^/]+)*", "*": "/[^/]+"}
    pattern = "".join(parts.get(part, "/" + re.escape(part)) for part in key.strip("/").split("/"))
    return re.fullmatch(pattern, node) is not None


def load_setup(
    path: Path, classes: Sequence[type[Configuration]], only: Collection[str] | None = None
) -> dict[str, Any]:
    """Read a setup: a ROS 2 parameter file with shared parameters under `/**` and a section for each node.

    Args:
        path: the YAML file.
        classes: the nodes' configuration classes; the `GROUP` of each is the name that its section's key ends in.
        only: groups to return, others being known only; None for all.

    Returns:
        A configuration object for each class, by its `GROUP`; what no section gives keeps its default.

    Raises:
        ConfigurationError: the file cannot be read, is no parameter file, or holds anything invalid.
    """
    known = {cls.GROUP: cls for cls in classes}
    values: dict[str, dict[str, Any]] = {group: {} for group in known}
    space = ""
    with errors_of_file(str(path)):
        for key, section in read_sections(path, "setup file"):
            above, _, group = key.rpartition("/")
            section = {name: value for name, value in section.items() if name.split(".")[0] not in ROS_PARAMETERS}
            if key == EVERY_NODE:
                for name in section:
                    if name not in SHARED_PARAMETERS:
                        expected = f"a shared parameter, {suggest_names(name, SHARED_PARAMETERS)}"
                        expected += "; others in their node's section"
                        raise ConfigurationError(f"{EVERY_NODE}.{name}", section[name], expected)
                for group, cls in known.items():
                    values[group].update((name, section[name]) for name in section.keys() & names_of(cls))
                continue
            if group not in known:
                raise ConfigurationError(key, group, suggest_names(group, [EVERY_NODE, *known]))
            if above and "*" not in above and above != (space := space or above):
                raise ConfigurationError(key, above, f"one namespace in a setup, as {space} before")
            values[group].update(section)
        return {
            group: from_mapping(cls, values[group]) for group, cls in known.items() if only is None or group in only
        }


def names_of(cls: type[Configuration]) -> set[str]:
    """Return the names of the parameters of a configuration class."""
    return {setting.name for setting in configuration_fields(cls)}
