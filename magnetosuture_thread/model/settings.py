"""Settings of the thread model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from magnetosuture_thread.configuration import Configuration, quantity
from magnetosuture_thread.errors import ConfigurationError
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.model.thread import MATERIALS, Attachment, Thread


@dataclass(frozen=True)
class ThreadModelSettings(Configuration):
    """What the thread model must know of the thread, the liquid and the obstacles."""

    GROUP: ClassVar[str] = "thread_model"

    material: str = quantity("polyamide_7_0", "the thread's material", choices=tuple(MATERIALS))
    length: float = quantity(0.019, "rest length of the thread", unit="m", minimum=0.001, maximum=2.0)
    segments: int = quantity(25, "number of segments, n", minimum=3, maximum=2000)
    attachment: str = quantity(
        Attachment.PINNED.value,
        "how the thread is fixed to the needle: pinned turns freely, glued leaves along the needle's axis",
        choices=tuple(kind.value for kind in Attachment),
    )
    viscosity: float = quantity(
        1.0,
        "dynamic viscosity of the liquid; glycerin at room temperature is about 1",
        unit="Pa s",
        minimum=1e-4,
        maximum=1e2,
    )
    wetted_fraction: float = quantity(
        0.5, "part of the thread's surface in the liquid; half for a floating thread", minimum=0.05, maximum=1.0
    )
    initial_shape: str = quantity(
        "seen",
        "where the thread starts: as the camera first sees it, or straight behind the needle",
        choices=("seen", "straight"),
    )
    longest_step: float = quantity(
        1.0 / 66.0,
        "intervals between poses are divided into steps of at most this",
        unit="s",
        minimum=1e-4,
        maximum=0.1,
    )
    disc_obstacles: tuple[float, ...] = quantity(
        (),
        "round obstacles in the dish frame: x, y, radius of each in turn",
        unit="m",
        minimum=-1.0,
        maximum=1.0,
        multiple=3,
    )
    contact_tolerance: float = quantity(
        2e-6, "a node this close to an obstacle touches it", unit="m", minimum=0.0, maximum=1e-3
    )
    residual_tolerance: float = quantity(
        1e-5, "largest scaled residual with which a solution is accepted", minimum=1e-12, maximum=1e-2
    )

    def check(self) -> None:
        """Refuse a thread thicker than a segment is long, and obstacles too small for the segments.

        A segment could lie across such an obstacle with both of its nodes outside.
        """
        for disc in self.discs():
            least = 0.5 * self.length / self.segments
            if disc.radius < least:
                name, words = f"{self.GROUP}.disc_obstacles", "as every third number a radius of at least"
                raise ConfigurationError(name, disc.radius, f"{words} {least:g} m, half of a segment")
        diameter = MATERIALS[self.material].diameter
        if self.length / self.segments <= diameter:
            most = math.ceil(self.length / diameter) - 1
            raise ConfigurationError(
                f"{self.GROUP}.segments", self.segments, f"at most {most}, so that a segment is longer than thick"
            )

    def discs(self) -> tuple[Disc, ...]:
        """Return the round obstacles."""
        values = self.disc_obstacles
        return tuple(Disc(values[k : k + 2], values[k + 2]) for k in range(0, len(values), 3))

    def thread(self) -> Thread:
        """Return the thread."""
        return Thread.of(
            MATERIALS[self.material],
            length=self.length,
            segments=self.segments,
            attachment=Attachment(self.attachment),
            viscosity=self.viscosity,
            wetted_fraction=self.wetted_fraction,
        )
