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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, get_args

from magnetosuture_thread.geometry.scene import WALL_NAME
from magnetosuture_thread.settings.configuration import (
    Configuration,
    from_mapping,
    quantity,
    read_yaml,
    read_yaml_text,
    suggest_names,
)
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.settings.files import find_file

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
class _Turns(Configuration):
    """An angle about a shape, in a sense."""

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
class Wrap(_Turns):
    """Drive around a shape until the thread winds about it by an angle, with that of the wraps before."""

    GROUP: ClassVar[str] = "wrap"


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


@dataclass(frozen=True)
class Wind(_Turns):
    """Bring the angle by which the thread winds about a shape to a value, whatever it was before."""

    GROUP: ClassVar[str] = "wind"

    tolerance: float = quantity(0.5, "of the angle", unit="rad", minimum=0.05, maximum=2.0)


@dataclass(frozen=True)
class Unwind(Configuration):
    """Drive around a shape until the thread winds about it by no more than an angle, in either sense."""

    GROUP: ClassVar[str] = "unwind"

    around: str = quantity("", "name of the shape")
    angle: float = quantity(
        math.pi, "that may be left, as a straight thread beside a shape has", unit="rad", minimum=0.2, maximum=62.9
    )


@dataclass(frozen=True)
class TakeOff(Configuration):
    """Take the thread off a shape: it winds by less than half a turn about it, and no part is near it."""

    GROUP: ClassVar[str] = "take_off"

    around: str = quantity("", "name of the shape")
    clearance: float = quantity(1e-3, "of the thread from the shape", unit="m", minimum=1e-5, maximum=0.05)


@dataclass(frozen=True)
class KeepSide(Configuration):
    """Bring the middle of the needle past a shape to a place, with the thread on one side of the shape."""

    GROUP: ClassVar[str] = "keep_side"

    around: str = quantity("", "name of the shape")
    side: str = quantity("left", "of the shape that the thread is on, as seen along it", choices=("left", "right"))
    to: tuple[float, ...] = quantity((), "x and y of the middle of the needle", **_PLACE)
    tolerance: float = quantity(1e-3, "of the position", unit="m", minimum=5e-5, maximum=0.05)

    def check(self) -> None:
        """Refuse half a place."""
        if len(self.to) != 2:
            raise self.refused("to", "x and y [m]")


@dataclass(frozen=True)
class Lay(Configuration):
    """Lay the thread, or a stretch of it, along a line, with either end first."""

    GROUP: ClassVar[str] = "lay"

    along: tuple[float, ...] = quantity((), "x and y of two or more points of the line, one after the other",
                                        unit="m", minimum=-0.5, maximum=0.5, multiple=2)  # fmt: skip
    tolerance: float = quantity(1e-3, "of the thread from the line", unit="m", minimum=5e-5, maximum=0.05)
    stretch: tuple[float, ...] = quantity((), "begin and end of the part of the thread, from the needle on; empty for "
                                          "any", unit="m", minimum=0.0, maximum=1.0, multiple=2)  # fmt: skip

    def check(self) -> None:
        """Refuse a line of no length, or such a stretch."""
        points = [self.along[k : k + 2] for k in range(0, len(self.along), 2)]
        if sum(map(math.dist, points, points[1:])) <= self.tolerance:
            raise self.refused("along", "a line that is longer than its tolerance, as [[0.0, 0.0], [0.01, 0.0]]")
        if self.stretch and (len(self.stretch) != 2 or not self.stretch[0] < self.stretch[1]):
            raise self.refused("stretch", "where it begins and ends, as [0.01, 0.03]")


@dataclass(frozen=True)
class BringEnd(Configuration):
    """Bring the free end of the thread to a place."""

    GROUP: ClassVar[str] = "bring_end"

    position: tuple[float, ...] = quantity((), "x and y of the free end", **_PLACE)
    tolerance: float = quantity(2e-3, "of the position", unit="m", minimum=5e-5, maximum=0.05)

    def check(self) -> None:
        """Refuse half a place."""
        if len(self.position) != 2:
            raise self.refused("position", "x and y [m]")


@dataclass(frozen=True)
class Wait(Configuration):
    """Keep the needle where it is."""

    GROUP: ClassVar[str] = "wait"

    time: float = quantity(1.0, "for which it is kept", unit="s", minimum=0.1, maximum=3600.0)


WindingGoal = Wrap | Wind | Unwind | TakeOff | KeepSide
"""Goals by which the thread is to wind about a shape by an angle within an interval, see `Procedure.windings`."""
ThreadGoal = Wind | Unwind | TakeOff | KeepSide | Lay | BringEnd
"""Goals of the thread whose ways are found by forecasts."""
PlaceGoal = GoTo | Withdraw | KeepSide
"""Goals that end where the middle of the needle is at a place."""
Goal = GoTo | PassThrough | Wrap | Tighten | Withdraw | ThreadGoal | Wait
GOALS: dict[str, type[Goal]] = {kind.GROUP: kind for kind in get_args(Goal)}


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
            elif isinstance(goal, WindingGoal | Tighten) and goal.around:
                names.add(goal.around)
        return frozenset(names)

    @cached_property
    def windings(self) -> tuple[tuple[float, float], ...]:
        """What the thread may wind about its shape once each `WindingGoal` is met, else anything [rad].

        Least and greatest angle from the free end to the needle, positive counterclockwise. A wrap adds to the wraps
        before, and to what `wind` has set. A thread that is straight, but for its ends, winds by up to half a turn.
        """
        wound: defaultdict[str, float] = defaultdict(float)
        found = []
        for goal in self.goals:
            allowed = -math.inf, math.inf
            if isinstance(goal, Wrap):
                wound[goal.around] += goal.swept
                allowed = (wound[goal.around], math.inf) if goal.swept > 0.0 else (-math.inf, wound[goal.around])
            elif isinstance(goal, Wind):
                wound[goal.around] = goal.swept
                allowed = goal.swept - goal.tolerance, goal.swept + goal.tolerance
            elif isinstance(goal, Unwind | TakeOff):
                wound[goal.around] = 0.0
                left = goal.angle if isinstance(goal, Unwind) else math.pi
                allowed = -left, left
            elif isinstance(goal, KeepSide):
                wound[goal.around] = 0.0
                allowed = (0.0, 2.0 * math.pi) if goal.side == "right" else (-2.0 * math.pi, 0.0)
            found.append(allowed)
        return tuple(found)

    def lasting(self, goal: int) -> dict[str, int]:
        """Return the last `WindingGoal` before a goal about each shape, by the shape's name, in their order."""
        last: dict[str, int] = {}
        for index, each in enumerate(self.goals[:goal]):
            if isinstance(each, WindingGoal):
                last.pop(each.around, None)
                last[each.around] = index
        return last


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
    common = _mapping(content.get("limits", {}), "limits", source)
    from_mapping(ProcedureLimits, common, source)  # else each goal would be blamed for them
    goals = content["goals"]
    found = list(_goals_of(goals, common, "goals", source))
    if len(found) > MAX_GOALS:
        raise ConfigurationError(
            "procedure.goals", len(found), f"1 to {MAX_GOALS} goals, repeated ones counted", source
        )
    return Procedure(name, setup, scene, *map(tuple, zip(*found, strict=True)))


def _goals_of(goals: Any, common: Mapping[str, Any], where: str, source: str) -> Iterator[tuple[Goal, ProcedureLimits]]:
    """Return goals with their limits, those of `repeat` as often as they are repeated."""
    if not isinstance(goals, list) or not 0 < len(goals) <= MAX_GOALS:
        given = len(goals) if isinstance(goals, list) else type(goals).__name__
        raise ConfigurationError(
            where if "." in where else "procedure.goals", given, f"a list of 1 to {MAX_GOALS} goals", source
        )
    for index, entry in enumerate(goals):
        at = f"{where}[{index}]"
        kinds = [key for key in _mapping(entry, at, source) if key != "limits"]
        known = [*GOALS, "repeat"] if where == "goals" else [*GOALS]  # not nested: their number stays bounded
        if len(kinds) != 1 or kinds[0] not in known:
            expected = suggest_names(str(kinds[0]), known) if len(kinds) == 1 else "one kind of goal"
            raise ConfigurationError(at, kinds, expected, source)
        content = _mapping(entry[kinds[0]], f"{at}.{kinds[0]}", source)
        own = {**common, **_mapping(entry.get("limits", {}), f"{at}.limits", source)}
        if kinds[0] == "repeat":
            times = content.get("times")
            if set(content) != {"times", "goals"} or type(times) is not int or not 1 <= times <= MAX_GOALS:
                raise ConfigurationError(f"{at}.repeat", content, "times, from 1 on, and goals", source)
            yield from times * list(_goals_of(content["goals"], own, f"{at}.repeat.goals", source))
            continue
        points = content.get("along")
        if isinstance(points, list) and all(isinstance(point, list) and len(point) == 2 for point in points):
            content["along"] = [value for point in points for value in point]
        try:
            yield from_mapping(GOALS[kinds[0]], content, source), from_mapping(ProcedureLimits, own, source)
        except ConfigurationError as error:
            prefix = "" if error.name.startswith("goals[") else f"{at}."
            raise ConfigurationError(f"{prefix}{error.name}", error.value, error.expectation, source) from None


def read_procedure(name: str) -> Procedure:
    """Return a procedure, given as a path or as the name of one that ships with the package.

    Files of setup and scene that lie beside it are found from any working directory.

    Raises:
        ConfigurationError: there is no such file, it cannot be read, or is no procedure.
    """
    path = find_file("procedure", name)
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
