"""Procedures: what the needle is to do, as a list of goals in a YAML file.

setup: hernia_ring
limits: {speed: 0.002, tension: 0.0005}
goals:
  - pass_through: {between: [left_tissue, right_tissue], direction: [0.0, 1.0]}
  - wrap: {around: ring, angle: 6.283, sense: clockwise}
  - tighten: {tension: 1.0e-4, toward: [0.004, -0.013]}
  - withdraw: {}
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from magnetosuture_thread.configuration import (
    Configuration,
    from_mapping,
    quantity,
    read_yaml,
    read_yaml_text,
    suggest_names,
)
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.resources import find_procedure_file
from magnetosuture_thread.scene import WALL_NAME

MAX_GOALS = 100
HEADING_TOLERANCE = 0.3  # rad; of `GoTo.heading`
KEYS = {"setup", "scene", "goals", "limits"}
_PLACE: dict[str, Any] = {"unit": "m", "minimum": -0.5, "maximum": 0.5, "multiple": 2}


@dataclass(frozen=True)
class ProcedureLimits(Configuration):
    """What holds while a goal is pursued."""

    GROUP: ClassVar[str] = "limits"

    speed: float = quantity(0.002, "of the needle's tip", unit="m/s", minimum=1e-5, maximum=0.1)
    tension: float = quantity(10.0, "of the thread, by the model", unit="N", minimum=1e-9, maximum=10.0)
    friction_nodes: int = quantity(10_000, "nodes of the thread that are under friction", minimum=0, maximum=10_000)
    clearance: float = quantity(
        0.0, "of the needle's axis from wall and shapes; the bridge's keep_out if that is more",
        unit="m", minimum=0.0, maximum=0.1,
    )  # fmt: skip


@dataclass(frozen=True)
class GoTo(Configuration):
    """Bring the middle of the needle to a place, headed in a direction if one is given."""

    GROUP: ClassVar[str] = "go_to"

    position: tuple[float, ...] = quantity((), "x and y of the middle of the needle", **_PLACE)
    heading: tuple[float, ...] = quantity((), "of its chord; empty for any", unit="rad", minimum=-7.0, maximum=7.0)
    tolerance: float = quantity(5e-4, "of the position", unit="m", minimum=5e-5, maximum=0.05)

    def check(self) -> None:
        """Refuse a goal without a place, or with several headings."""
        if len(self.position) != 2:
            raise self.refused("position", "x and y [m]")
        if len(self.heading) > 1:
            raise self.refused("heading", "one angle [rad], or none")


@dataclass(frozen=True)
class PassThrough(Configuration):
    """Drive through the gap between two shapes, or a shape and the dish's wall, `wall`."""

    GROUP: ClassVar[str] = "pass_through"

    between: tuple[str, ...] = quantity((), "names of the two shapes")
    direction: tuple[float, ...] = quantity(
        (), "x and y of a vector along which it is passed", minimum=-1e3, maximum=1e3
    )

    def check(self) -> None:
        """Refuse anything but two shapes and a direction."""
        if len(self.between) != 2 or self.between[0] == self.between[1]:
            raise self.refused("between", "the names of two shapes")
        if len(self.direction) != 2 or not any(self.direction):
            raise self.refused("direction", "x and y of a vector that is not zero")


@dataclass(frozen=True)
class Wrap(Configuration):
    """Drive around a shape until the thread winds about it by an angle, with that of the wraps before."""

    GROUP: ClassVar[str] = "wrap"

    around: str = quantity("", "name of the shape")
    angle: float = quantity(0.0, "that the thread winds about it", unit="rad", minimum=0.0, maximum=3600.0)
    sense: str = quantity("counterclockwise", "of the way", choices=("clockwise", "counterclockwise"))

    def check(self) -> None:
        """Refuse a wrap by no angle, or by more than ten turns."""
        if not 0.0 < self.angle <= 20.0 * math.pi:
            raise self.refused("angle", f"an angle above 0 and up to ten turns, 62.83 rad{self.in_radians}")

    @property
    def in_radians(self) -> str:
        """What the angle would be if it was meant in degrees, in words."""
        return f"; degrees? {self.angle:g} degrees are {math.radians(self.angle):.4g} rad" if self.angle > 20.0 else ""

    @property
    def swept(self) -> float:
        """The angle, positive counterclockwise [rad]."""
        return self.angle if self.sense == "counterclockwise" else -self.angle


@dataclass(frozen=True)
class Tighten(Configuration):
    """Pull the thread until it is under a tension, as near to a shape as wanted, or both where both are given."""

    GROUP: ClassVar[str] = "tighten"

    tension: float = quantity(0.0, "peak of the thread, by the model, at which it is tight; 0 for any",
                              unit="N", minimum=0.0, maximum=10.0)  # fmt: skip
    clearance: float = quantity(0.0, "of the thread from the shape it goes around, at which it is tight; 0 for any",
                                unit="m", minimum=0.0, maximum=0.1)  # fmt: skip
    around: str = quantity("", "name of that shape")
    toward: tuple[float, ...] = quantity((), "x and y of the place that it is pulled to", **_PLACE)

    def check(self) -> None:
        """Refuse a goal that nothing ends."""
        if not (self.tension > 0.0 or self.clearance > 0.0):
            raise self.refused("tension", "a tension or a clearance above 0")
        if self.clearance > 0.0 and not self.around:
            raise self.refused("around", "the name of the shape that the clearance is from")
        if len(self.toward) != 2:
            raise self.refused("toward", "x and y [m]")


@dataclass(frozen=True)
class Withdraw(Configuration):
    """Bring the needle out, to a place or to where the procedure began."""

    GROUP: ClassVar[str] = "withdraw"

    to: tuple[float, ...] = quantity((), "x and y of the middle of the needle; empty for where it began", **_PLACE)
    tolerance: float = quantity(1e-3, "of the position", unit="m", minimum=5e-5, maximum=0.05)

    def check(self) -> None:
        """Refuse half a place."""
        if len(self.to) not in (0, 2):
            raise self.refused("to", "x and y [m], or nothing")


Goal = GoTo | PassThrough | Wrap | Tighten | Withdraw
GOALS: dict[str, type[Goal]] = {kind.GROUP: kind for kind in (GoTo, PassThrough, Wrap, Tighten, Withdraw)}


@dataclass(frozen=True)
class Procedure:
    """Goals, one after the other, each with its limits.

    Attributes:
        name: of the procedure.
        setup: name or file of the setup that it is meant for; empty for any.
        scene: name or file of the scene that it is meant for, in place of the setup's; empty for that.
        goals: what is to be done.
        limits: while each goal is pursued.
    """

    name: str
    setup: str
    scene: str
    goals: tuple[Goal, ...]
    limits: tuple[ProcedureLimits, ...]

    @property
    def shape_names(self) -> frozenset[str]:
        """Names of the shapes that its goals need."""
        names: set[str] = set()
        for goal in self.goals:
            if isinstance(goal, PassThrough):
                names.update(name for name in goal.between if name != WALL_NAME)
            elif isinstance(goal, Wrap | Tighten) and goal.around:
                names.add(goal.around)
        return frozenset(names)

    @cached_property
    def windings(self) -> tuple[float, ...]:
        """What the thread is to wind about its shape after each wrap, positive counterclockwise [rad]; else 0."""
        wound: defaultdict[str, float] = defaultdict(float)
        found = []
        for goal in self.goals:
            if isinstance(goal, Wrap):
                wound[goal.around] += goal.swept
            found.append(wound[goal.around] if isinstance(goal, Wrap) else 0.0)
        return tuple(found)


def parse_procedure(content: Any, name: str, source: str = "") -> Procedure:
    """Return the procedure that a YAML file describes.

    Args:
        content: of the file.
        name: of the procedure.
        source: the file, for errors.

    Raises:
        ConfigurationError: it is no procedure; the message names goal and field.
    """
    if not isinstance(content, Mapping) or not set(content) <= KEYS or "goals" not in content:
        nothing = "nothing" if content is None else type(content).__name__
        given: Any = sorted(map(str, content)) if isinstance(content, Mapping) else nothing
        expected = "goals, and setup, scene and limits if they differ from the defaults"
        raise ConfigurationError("procedure", given, expected, source)
    setup, scene = content.get("setup", ""), content.get("scene", "")
    for key, value in (("setup", setup), ("scene", scene)):
        if not isinstance(value, str):
            raise ConfigurationError(f"procedure.{key}", value, f"the name of a {key}", source)
    goals, common = content["goals"], _mapping(content.get("limits", {}), "limits", source)
    from_mapping(ProcedureLimits, common, source)  # else each goal would be blamed for them
    if not isinstance(goals, list) or not 0 < len(goals) <= MAX_GOALS:
        given = len(goals) if isinstance(goals, list) else type(goals).__name__
        raise ConfigurationError("procedure.goals", given, f"a list of 1 to {MAX_GOALS} goals", source)
    found: list[Goal] = []
    limits: list[ProcedureLimits] = []
    for index, entry in enumerate(goals):
        where = f"goals[{index}]"
        kinds = [key for key in _mapping(entry, where, source) if key != "limits"]
        if len(kinds) != 1 or kinds[0] not in GOALS:
            expected = suggest_names(str(kinds[0]), list(GOALS)) if len(kinds) == 1 else "one kind of goal"
            raise ConfigurationError(where, kinds, expected, source)
        try:
            goal: Goal = from_mapping(GOALS[kinds[0]], _mapping(entry[kinds[0]], f"{where}.{kinds[0]}", source), source)
            own = {**common, **_mapping(entry.get("limits", {}), f"{where}.limits", source)}
            limits.append(from_mapping(ProcedureLimits, own, source))
        except ConfigurationError as error:
            prefix = "" if error.name.startswith("goals[") else f"{where}."
            raise ConfigurationError(f"{prefix}{error.name}", error.value, error.expectation, source) from None
        found.append(goal)
    return Procedure(name, setup, scene, tuple(found), tuple(limits))


def read_procedure(name: str) -> Procedure:
    """Return a procedure, given as a path or as the name of one that ships with the package.

    Files of setup and scene that lie beside it are found from any working directory.

    Raises:
        ConfigurationError: there is no such file, it cannot be read, or is no procedure.
    """
    path = find_procedure_file(name)
    found = parse_procedure(read_yaml(path, "procedure"), path.stem, str(path))
    return replace(found, setup=_beside(path, found.setup), scene=_beside(path, found.scene))


def read_procedure_text(text: str) -> Procedure:
    """Return a procedure, given by its name as `read_procedure` takes it, or by the YAML text of one.

    Raises:
        ConfigurationError: see `read_procedure`.
    """
    if ":" in text or "\n" in text:  # as every procedure has, and no name
        return parse_procedure(read_yaml_text(text, "procedure"), "procedure")
    return read_procedure(text)


def _beside(path: Path, name: str) -> str:
    """Return the path of a file that is named from the folder of another; the name as it is where there is none."""
    return str(path.parent / name) if Path(name).suffix and (path.parent / name).is_file() else name


def _mapping(value: Any, name: str, source: str) -> dict[str, Any]:
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise ConfigurationError(name, value, "names with values", source)
    return dict(value)
