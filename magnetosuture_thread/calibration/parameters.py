"""The parameters that a calibration can fit, and how each enters the settings of the thread model.

Of the thread's bending stiffness EI and the liquid's drag across it, zeta_perp, only the ratio

    B = EI / zeta_perp   [m^4/s]

moves the thread: it is overdamped, and a wave of length l straightens in about l^4 / B. So `elastic_modulus` is
fitted as B, and written as the modulus that has this ratio at the setup's viscosity, diameter, length and wetted
part. It is the thread's own modulus as far as those are true.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

from magnetosuture_thread.estimator.settings import ThreadModelSettings
from magnetosuture_thread.settings.errors import ConfigurationError
from magnetosuture_thread.thread.material import MATERIALS, MAX_ELASTIC_MODULUS, MAX_REST_ANGLE, MIN_ELASTIC_MODULUS

ATTACHMENT = "attachment"
OFFSET = "attachment_offset"

Settings = ThreadModelSettings


@dataclass(frozen=True)
class Parameter:
    """One number that can be fitted.

    Attributes:
        name: for a person.
        setting: the field of `ThreadModelSettings` that it belongs to.
        unit: of its value.
        kind: `log`: x = ln value, for what is positive; `plain`: x = value; `lost`: x = ln (1 - value).
        bounds: least and greatest value.
        getter: its value in settings, if it is not the setting itself.
        setter: settings with another value, likewise.
    """

    name: str
    setting: str
    unit: str
    kind: str
    bounds: Callable[[Settings], tuple[float, float]]
    getter: Callable[[Settings], float] | None = None
    setter: Callable[[Settings, float], Settings] | None = None

    def counts(self, settings: Settings) -> float:
        """Return the change of x that counts: a factor of two, 1 % of the length, or one radian on all of it."""
        length = settings.thread_length
        return {"m": 0.01 * length, "1/m": 1.0 / length}.get(self.unit, math.log(2.0))

    def read(self, settings: Settings) -> float:
        """Return its value in settings."""
        return float(getattr(settings, self.setting)) if self.getter is None else self.getter(settings)

    def write(self, settings: Settings, value: float) -> Settings:
        """Return settings with another value."""
        if self.setter is not None:
            return self.setter(settings, value)
        changes: dict[str, Any] = {self.setting: value}
        return replace(settings, **changes)

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
        low, high = sorted(map(self.to_fit, self.bounds(settings)))
        return low, high

    def interval(self, x: float, half: float) -> tuple[float, float]:
        """Return the ends of x - half ... x + half as values, the lower one first."""
        limit = math.inf if self.kind == "plain" else 700.0  # whose exponential is a number yet
        low, high = sorted(map(self.from_fit, (max(x - half, -limit), min(x + half, limit))))
        return low, high


def stiffness_over_drag(settings: Settings) -> float:
    """Return B = EI / zeta_perp [m^4/s]."""
    thread = settings.thread()
    return thread.bending_stiffness / thread.medium.drag_across


def with_stiffness_over_drag(settings: Settings, value: float) -> Settings:
    """Return settings whose `elastic_modulus` gives this B at their own drag."""
    per_modulus = stiffness_over_drag(replace(settings, elastic_modulus=MIN_ELASTIC_MODULUS)) / MIN_ELASTIC_MODULUS
    return replace(settings, elastic_modulus=value / per_modulus)


def _stiffness_bounds(settings: Settings) -> tuple[float, float]:
    middle = stiffness_over_drag(replace(settings, elastic_modulus=0.0))  # the material's
    # Just within what a setup may say.
    extremes = (1.01 * MIN_ELASTIC_MODULUS, 0.99 * MAX_ELASTIC_MODULUS)
    least, most = (stiffness_over_drag(replace(settings, elastic_modulus=modulus)) for modulus in extremes)
    return max(1e-3 * middle, least), min(1e3 * middle, most)


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
        most = min(0.01, 0.1 * settings.thread_length)
        return -most, most

    return Parameter(f"offset {name}", OFFSET, "m", "plain", bounds, read, write)


STIFFNESS_OVER_DRAG = Parameter(
    "stiffness over drag",
    "elastic_modulus",
    "m^4/s",
    "log",
    _stiffness_bounds,
    getter=stiffness_over_drag,
    setter=with_stiffness_over_drag,
)
DRAG_ANISOTROPY = Parameter("drag anisotropy", "drag_anisotropy", "", "log", lambda settings: (0.05, 1.0))
REST_CURVATURE = Parameter("rest curvature", "rest_curvature", "1/m", "plain", _curvature_bounds)
DAMPING = Parameter("kappa", "paper_damping", "", "lost", lambda settings: (0.0, 0.999))
STIFFNESS_WEIGHT = Parameter(
    "W_stiff",
    "paper_stiffness_weight",
    "",
    "log",
    lambda settings: (1e-6, 1e7),  # beyond, every step needs another solver
    getter=lambda settings: settings.paper_stiffness_weight or MATERIALS[settings.material].stiffness_weight,
)
OF_FORMULATION: dict[str, tuple[Parameter, ...]] = {
    "rod": (STIFFNESS_OVER_DRAG, DRAG_ANISOTROPY, REST_CURVATURE, _offset(0, "along"), _offset(1, "left")),
    "paper": (DAMPING, STIFFNESS_WEIGHT),
}


def choose_parameters(formulation: str, names: Sequence[str] = ()) -> tuple[tuple[Parameter, ...], bool]:
    """Return the parameters to fit, and whether the attachment is one of them.

    Args:
        formulation: its name.
        names: of settings; all that the formulation has if empty.

    Raises:
        ConfigurationError: a name is none of those.
    """
    known = dict.fromkeys(parameter.setting for parameter in OF_FORMULATION[formulation])
    if formulation == "rod":
        known[ATTACHMENT] = None
    for name in names:
        if name not in known:
            close = get_close_matches(name, known, n=1)
            hint = f" (did you mean {close[0]}?)" if close else ""
            raise ConfigurationError("parameters", name, f"some of {', '.join(known)}{hint}")
    wanted = names or known
    fitted = tuple(parameter for parameter in OF_FORMULATION[formulation] if parameter.setting in wanted)
    return fitted, ATTACHMENT in wanted
