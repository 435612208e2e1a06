"""The base class of every barrier, the built-in ones and those that users add."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.polyline import Points, as_numbers, finite_array
from magnetosuture_thread.geometry.scene import MAX_NAME_CHARS, is_name
from magnetosuture_thread.settings.configuration import Quantity
from magnetosuture_thread.settings.errors import ConfigurationError, InvalidInputError, shortened

NO_OBSTACLE = -1
CONNECTIVITY, COMPRESSION, OBSTACLE = "connectivity", "compression", "obstacle"
ENHANCED_CONNECTIVITY, STIFFNESS, WALL = "enhanced_connectivity", "stiffness", "wall"
BUILT_IN = (CONNECTIVITY, COMPRESSION, OBSTACLE, ENHANCED_CONNECTIVITY, STIFFNESS, WALL)
"""Names of the barriers that the formulations bring."""
MAX_BARRIERS = 32


class Gradient(NamedTuple):
    """Derivatives of m rows by the positions of the k nodes that each of them depends on.

    Attributes:
        nodes: indices of these nodes, shape (m, k); the last is the one that a margin names.
        values: derivative of h by the position of each, shape (m, k, d).
    """

    nodes: NDArray[np.intp]
    values: NDArray[np.float64]


@dataclass(frozen=True)
class BarrierRows:
    """All rows of one barrier at given positions.

    Attributes:
        name: of the barrier.
        nodes: the nodes that each row depends on, shape (m, k); the last is the one that a margin names.
        obstacle: index of the scene's shape of each row, `NO_OBSTACLE` where there is none, shape (m,).
        value: h of each row, safe at >= 0, shape (m,); its unit is the barrier's.
        gradient: derivative of h by the position of each of its nodes, shape (m, k, d).
        clearance: the same margin as a distance, shape (m,) [unit of the positions].
    """

    name: str
    nodes: NDArray[np.intp]
    obstacle: NDArray[np.intp]
    value: NDArray[np.float64]
    gradient: NDArray[np.float64]
    clearance: NDArray[np.float64]


class Barrier(ABC):
    """A control barrier function: rows h(x) that are safe at h >= 0. Subclass it to add one of your own.

    Each row becomes a constraint of the step's quadratic program, linearised about the predicted end y of the step,

        h(y) + grad h(y)' (x + dt u - y) >= (1 - min(gain, 1 / dt) dt) h(x)

    over the velocities u of the nodes, until it holds at the end of the step. A row that depends on nodes of which
    the first and the last are at most two apart keeps the program banded; any other costs a substitution more.

    `positions` are those of all nodes of a thread, shape (n + 1, d) [m], node 0 at the needle's tail; for a
    `NeedleSafetyFilter` those of points along the needle, from tail to tip.

    Attributes:
        name: of the barrier in margins, messages and reports; unique among a thread's barriers.
        gain: alpha, how fast h may decay towards 0 [1/s]; inf only asks for h >= 0 at the end of each step.
        slack_weight: W of the slack that lets a row give way; inf makes it hard.
        ros_time: time of the next evaluation by the clock of the poses' stamps, set before `set_time` is called [s].
        needle: at that time, the point where the thread is fixed [m] and the needle's heading, a unit vector, shapes
            (d,); None where a `NeedleSafetyFilter` evaluates the barrier, and in `check_gradient`.

    Source: A. D. Ames et al., Control Barrier Functions: Theory and Applications, 2019, section II, in discrete time.
    """

    name: str = ""
    gain: float = math.inf
    slack_weight: float = math.inf
    ros_time: float = 0.0
    needle: tuple[Points, Points] | None = None

    def set_time(self, time: float) -> None:  # noqa: B027 - most barriers do not move
        """Set the time of the next evaluation; a barrier that moves overrides this.

        Args:
            time: since the needle's first pose [s].
        """

    @property
    def moves(self) -> bool:
        """Whether the barrier moves with time."""
        return type(self).set_time is not Barrier.set_time

    def move_to(self, stamp: float, first: float, needle: tuple[Points, Points] | None = None) -> None:
        """Set the needle and both times, the next evaluation's stamp and what has passed since the first pose [s]."""
        self.ros_time, self.needle = stamp, needle
        self.set_time(stamp - first)

    def rows_after(self, before: Points, positions: Points) -> BarrierRows:
        """Return all rows at positions to which the nodes moved from `before`, for barriers whose side that decides."""
        return self.rows(positions)

    @abstractmethod
    def value(self, positions: Points) -> NDArray[np.float64]:
        """Return h of each row, shape (m,)."""

    @abstractmethod
    def gradient(self, positions: Points) -> Gradient:
        """Return the derivatives of the same rows."""

    def clearance(self, positions: Points) -> NDArray[np.float64]:
        """Return each row's margin as a distance: how far its nodes have to move for h to change its sign, shape (m,).

            h / |grad h|

        to first order; h itself where the gradient is 0.
        """
        value, gradient = self.value(positions), self.gradient(positions)
        slope = np.sqrt(np.einsum("rkd,rkd->r", gradient.values, gradient.values))
        return value / np.where(slope > 0.0, slope, 1.0)

    def rows(self, positions: Points) -> BarrierRows:
        """Return value, gradient and clearance together, checked.

        Raises:
            InvalidInputError: their shapes do not agree, a node is none of the thread's, or a number is not finite.
        """
        value = np.asarray(self.value(positions), dtype=np.float64)
        nodes, gradient = (np.asarray(part) for part in self.gradient(positions))
        count = len(value) if value.ndim == 1 else -1
        if nodes.ndim != 2 or len(nodes) != count or nodes.shape[1] == 0 or nodes.dtype.kind not in "iu":
            shapes = f"values of shape {value.shape}, nodes of shape {nodes.shape} and type {nodes.dtype}"
            raise _refused(self, shapes, "shapes (m,) and (m, k), k >= 1, nodes integers")
        shape = (*nodes.shape, positions.shape[1])
        if gradient.shape != shape:
            raise _refused(self, f"derivatives of shape {gradient.shape}", f"shape {shape}")
        if count and not (nodes.min() >= 0 and nodes.max() < len(positions)):
            raise _refused(self, f"nodes from {nodes.min()} to {nodes.max()}", f"nodes from 0 to {len(positions) - 1}")
        clearance = np.asarray(self.clearance(positions), dtype=np.float64)
        if clearance.shape != value.shape:
            raise _refused(self, f"clearances of shape {clearance.shape}", f"shape {value.shape}")
        if not all(np.isfinite(numbers).all() for numbers in (value, gradient, clearance)):
            raise _refused(self, "a number that is not finite", "finite numbers")
        obstacle = np.full(count, NO_OBSTACLE, dtype=np.intp)
        return BarrierRows(self.name, nodes.astype(np.intp), obstacle, value, gradient.astype(np.float64), clearance)


def _refused(barrier: Barrier, value: str, expectation: str) -> InvalidInputError:
    return InvalidInputError(f"barrier {barrier.name}", value, expectation)


def check_gradient(barrier: Barrier, positions: Points, tolerance: float = 1e-4) -> float:
    """Compare the gradient of a barrier with central differences of its values, by every node.

    Args:
        barrier: that has its time already, if it moves.
        positions: of the nodes, where the values are smooth, shape (n, d) [m].
        tolerance: greatest error that is accepted, as a part of the greatest derivative.

    Returns:
        The greatest error, as a part of the greatest derivative.

    Raises:
        InvalidInputError: a derivative is another, with row, node and axis; the number of rows changes close by; or
            what the barrier returns does not fit together, see `Barrier.rows`.
    """
    dimension = 3 if as_numbers("positions", positions).shape[-1:] == (3,) else 2
    positions = finite_array("positions", positions, (None, dimension), Quantity("", "m"))
    # A millionth of the extent: a difference loses as much by rounding as by the curvature.
    rows, step = barrier.rows(positions), 1e-6 * float(np.ptp(positions, axis=0).max())
    stated, measured = np.zeros((2, len(rows.value), *positions.shape))
    np.add.at(stated, (np.arange(len(stated))[:, None], rows.nodes), rows.gradient)
    for node, axis in np.ndindex(positions.shape):
        moved = np.zeros(positions.shape)
        moved[node, axis] = step
        ahead, behind = (barrier.rows(place).value for place in (positions + moved, positions - moved))
        if not ahead.shape == behind.shape == rows.value.shape:
            raise _refused(barrier, "another number of rows close by", "the same")
        measured[:, node, axis] = (ahead - behind) / (2.0 * step)
    error = np.abs(stated - measured)
    error /= max(float(np.abs([stated, measured]).max(initial=0.0)), np.finfo(float).tiny)
    if error.max(initial=0.0) > tolerance:
        row, node, axis = np.unravel_index(int(error.argmax()), error.shape)
        problem = f"derivative {stated[row, node, axis]:g} of row {row} by node {node}, axis {axis}"
        raise _refused(barrier, problem, f"{measured[row, node, axis]:g}, as the values change")
    return float(error.max(initial=0.0))


class RowBarrier(Barrier):
    """A built-in barrier: compiled code writes all of its rows at once."""

    @abstractmethod
    def rows(self, positions: Points) -> BarrierRows:
        """Return all rows at positions of shape (n + 1, d)."""

    def value(self, positions: Points) -> NDArray[np.float64]:
        """Return h of each row, shape (m,)."""
        return self.rows(positions).value

    def gradient(self, positions: Points) -> Gradient:
        """Return the derivatives of the same rows."""
        rows = self.rows(positions)
        return Gradient(rows.nodes, rows.gradient)

    def clearance(self, positions: Points) -> NDArray[np.float64]:
        """Return each row's margin as a distance, shape (m,)."""
        return self.rows(positions).clearance


def check_barriers(barriers: tuple[Barrier, ...]) -> None:
    """Refuse barriers that share a name.

    Raises:
        ConfigurationError: something is not a barrier, or a name is missing, taken, or longer than `MAX_NAME_CHARS`.
    """
    if len(barriers) > MAX_BARRIERS:
        raise ConfigurationError("barriers", f"{len(barriers)} barriers", f"at most {MAX_BARRIERS}")
    taken = set(BUILT_IN)
    for index, barrier in enumerate(barriers):
        if not isinstance(barrier, Barrier):
            raise ConfigurationError(f"barriers[{index}]", barrier, "an instance of a subclass of Barrier")
        name = barrier.name
        if not is_name(name):
            raise ConfigurationError(
                f"barriers[{index}].name", name, f"1 to {MAX_NAME_CHARS} printable characters, no blank at an end"
            )
        if name in taken:
            raise ConfigurationError(f"barriers[{index}].name", name, "a name that no other barrier has")
        Quantity("", "1/s", minimum=1e-6, unlimited=True).checked(f"{name}.gain", barrier.gain)
        Quantity("", minimum=1e-12, unlimited=True).checked(f"{name}.slack_weight", barrier.slack_weight)
        taken.add(name)


def import_barriers(names: Sequence[str]) -> None:
    """Import the modules of barriers, each named `module:class`; what fails, `load_barriers` reports."""
    for name in names:
        with suppress(Exception):
            import_module(name.partition(":")[0])


def load_barriers(names: Sequence[str], parameter: str = "barriers") -> tuple[Barrier, ...]:
    """Return barriers by name, as nodes get them by a parameter.

    Args:
        names: each `module:class`, of a class that is made without arguments.
        parameter: what they are the value of, for errors.

    Raises:
        ConfigurationError: a module cannot be imported or has no such class, or it is not that of a barrier.
    """
    barriers = []
    for name in names:
        module, colon, attribute = name.partition(":")
        if not (colon and module and attribute.isidentifier()):
            raise ConfigurationError(parameter, name, "module:class, as in my_package.barriers:KeepIn")
        try:
            kind = getattr(import_module(module), attribute)
            # Nothing else is called: a setup may come with a bag of somebody else.
            if not (isinstance(kind, type) and issubclass(kind, Barrier)):
                raise ConfigurationError(parameter, name, "a subclass of magnetosuture_thread.Barrier")
            barriers.append(kind())
        except ConfigurationError:
            raise
        except Exception as error:  # whatever a user's module raises, its name has to be reported
            problem = f"{type(error).__name__}: {shortened(str(error))}"
            words = f"a class that can be imported and made without arguments, but {problem}"
            raise ConfigurationError(parameter, name, words) from error
    check_barriers(tuple(barriers))
    return tuple(barriers)
