"""What a calibration can fit, and how each enters the settings of the thread model.

Of the thread's bending stiffness EI and the liquid's drag across it, zeta_perp, only the ratio

    B = EI / zeta_perp   [m^4/s]

moves the thread: it is overdamped, and a wave of length l straightens in about l^4 / B. So `elastic_modulus` is
fitted as B, and written as the modulus that has this ratio at the set-up's viscosity, diameter, length and wetted
part. It is the thread's own modulus as far as those are true.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.model.settings import MAX_REST_ANGLE, ThreadModelSettings
from magnetosuture_thread.model.thread import MATERIALS

ATTACHMENT = "attachment"
OFFSET = "attachment_offset"
DOUBLED = math.log(2.0)
WIDEST = math.log(1.5)  # of a logarithm: half an interval beyond says nothing of use
LOGARITHM = 700.0  # whose exponential is a number yet
STIFFNESS = 1e3  # B is looked for within this factor of the material's
STIFFEST = 0.99e12  # Pa; just within what a set-up may say
OFFSET_COUNTS, OFFSET_MOST = 0.01, 0.1  # of the thread's length
MAX_KAPPA = 0.999  # kappa
LEAST_WEIGHT, GREATEST_WEIGHT = 1e-6, 1e7  # W_stiff; beyond, every step needs another solver

Settings = ThreadModelSettings


@dataclass(frozen=True)
class Parameter:
    """One number that can be fitted.

    Attributes:
        name: for a person.
        setting: the field of `ThreadModelSettings` that it belongs to.
        unit: of its value.
        kind: `log`: x = ln value, for what is positive; `plain`: x = value; `lost`: x = ln (1 - value).
        read: its value in settings.
        write: settings with another value.
        bounds: least and greatest value.
        counts: a change of x that counts: a factor of two, or what is said of it.
        widest: half of a 95 % interval of x beyond which the parameter counts as unknown.
    """

    name: str
    setting: str
    unit: str
    kind: str
    read: Callable[[Settings], float]
    write: Callable[[Settings, float], Settings]
    bounds: Callable[[Settings], tuple[float, float]]
    counts: Callable[[Settings], float]
    widest: Callable[[Settings], float]

    def to_fit(self, value: float) -> float:
        """Return x of a value."""
        if self.kind == "plain":
            return value
        return math.log(value if self.kind == "log" else 1.0 - value)

    def from_fit(self, x: float) -> float:
        """Return the value of x."""
        if self.kind == "plain":
            return float(x)
        return math.exp(x) if self.kind == "log" else 1.0 - math.exp(x)

    def fit_bounds(self, settings: Settings) -> tuple[float, float]:
        """Return least and greatest x."""
        low, high = sorted(self.to_fit(value) for value in self.bounds(settings))
        return low, high

    def reset(self, settings: Settings, start: Settings) -> Settings:
        """Return settings with what others say of this number."""
        if self.setting == OFFSET:
            return self.write(settings, self.read(start))
        changes: dict[str, Any] = {self.setting: getattr(start, self.setting)}
        return replace(settings, **changes)

    def interval(self, x: float, half: float) -> tuple[float, float]:
        """Return the ends of x - half ... x + half as values, the lower one first."""
        ends = (x - half, x + half) if self.kind == "plain" else (max(x - half, -LOGARITHM), min(x + half, LOGARITHM))
        low, high = sorted(self.from_fit(end) for end in ends)
        return low, high


def stiffness_over_drag(settings: Settings) -> float:
    """Return B = EI / zeta_perp [m^4/s]."""
    thread = settings.thread()
    return thread.bending_stiffness / thread.medium.drag_across


def with_stiffness_over_drag(settings: Settings, value: float) -> Settings:
    """Return settings whose `elastic_modulus` gives this B at their own drag."""
    of_one = stiffness_over_drag(replace(settings, elastic_modulus=1.0))
    return replace(settings, elastic_modulus=value / of_one)


def _stiffness_bounds(settings: Settings) -> tuple[float, float]:
    middle = stiffness_over_drag(replace(settings, elastic_modulus=0.0))  # the material's
    most = stiffness_over_drag(replace(settings, elastic_modulus=STIFFEST))
    return middle / STIFFNESS, min(middle * STIFFNESS, most)


def _curvature_bounds(settings: Settings) -> tuple[float, float]:
    most = min(2000.0, 0.99 * MAX_REST_ANGLE * settings.segments / settings.thread_length)
    return -most, most


def _offset(index: int, name: str) -> Parameter:
    def read(settings: Settings) -> float:
        return (settings.attachment_offset or (0.0, 0.0))[index]

    def write(settings: Settings, value: float) -> Settings:
        both = list(settings.attachment_offset or (0.0, 0.0))
        both[index] = value
        return replace(settings, attachment_offset=tuple(both) if any(both) else ())

    def bounds(settings: Settings) -> tuple[float, float]:
        most = min(0.01, OFFSET_MOST * settings.thread_length)
        return -most, most

    def counts(settings: Settings) -> float:
        return OFFSET_COUNTS * settings.thread_length

    return Parameter(f"offset {name}", OFFSET, "m", "plain", read, write, bounds, counts, counts)


def _plain(field: str) -> Callable[[Settings], float]:
    return lambda settings: float(getattr(settings, field))


def _replaced(field: str) -> Callable[[Settings, float], Settings]:
    def write(settings: Settings, value: float) -> Settings:
        changes: dict[str, Any] = {field: value}
        return replace(settings, **changes)

    return write


STIFFNESS_OVER_DRAG = Parameter(
    "stiffness over drag",
    "elastic_modulus",
    "m^4/s",
    "log",
    stiffness_over_drag,
    with_stiffness_over_drag,
    _stiffness_bounds,
    lambda settings: DOUBLED,
    lambda settings: WIDEST,
)
DRAG_ANISOTROPY = Parameter(
    "drag anisotropy",
    "drag_anisotropy",
    "",
    "log",
    _plain("drag_anisotropy"),
    _replaced("drag_anisotropy"),
    lambda settings: (0.05, 1.0),
    lambda settings: DOUBLED,
    lambda settings: WIDEST,
)
REST_CURVATURE = Parameter(
    "rest curvature",
    "rest_curvature",
    "1/m",
    "plain",
    _plain("rest_curvature"),
    _replaced("rest_curvature"),
    _curvature_bounds,
    lambda settings: 1.0 / settings.thread_length,  # by which the thread turns by one radian on its whole length
    lambda settings: 1.0 / settings.thread_length,
)
DAMPING = Parameter(
    "kappa",
    "paper_damping",
    "",
    "lost",
    _plain("paper_damping"),
    _replaced("paper_damping"),
    lambda settings: (0.0, MAX_KAPPA),
    lambda settings: DOUBLED,
    lambda settings: WIDEST,
)
STIFFNESS_WEIGHT = Parameter(
    "W_stiff",
    "paper_stiffness_weight",
    "",
    "log",
    lambda settings: settings.paper_stiffness_weight or MATERIALS[settings.material].stiffness_weight,
    _replaced("paper_stiffness_weight"),
    lambda settings: (LEAST_WEIGHT, GREATEST_WEIGHT),
    lambda settings: DOUBLED,
    lambda settings: WIDEST,
)
OF_FORMULATION: dict[str, tuple[Parameter, ...]] = {
    "rod": (STIFFNESS_OVER_DRAG, DRAG_ANISOTROPY, REST_CURVATURE, _offset(0, "along"), _offset(1, "left")),
    "paper": (DAMPING, STIFFNESS_WEIGHT),
}


def known_settings(formulation: str) -> tuple[str, ...]:
    """Return the names of the settings that can be fitted in a formulation."""
    names = dict.fromkeys(parameter.setting for parameter in OF_FORMULATION[formulation])
    return (*names, ATTACHMENT) if formulation == "rod" else tuple(names)


def chosen(formulation: str, names: Sequence[str] = ()) -> tuple[tuple[Parameter, ...], bool]:
    """Return the parameters to fit, and whether the attachment is one of them.

    Args:
        formulation: its name.
        names: of settings; all that the formulation has if empty.

    Raises:
        ConfigurationError: a name is none of those.
    """
    known = known_settings(formulation)
    for name in names:
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise ConfigurationError("parameters", name, f"some of {', '.join(known)}{hint}")
    wanted = names or known
    fitted = tuple(parameter for parameter in OF_FORMULATION[formulation] if parameter.setting in wanted)
    return fitted, ATTACHMENT in wanted
