"""When boards were driven, and how hard."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from magnetosuture_thread.rig.power import PowerStage


class DriveWatch:
    """Keeps when the coils of a power stage, all together, were driven and when not.

    A board forgets what is long past: look again before it has changed its duties some thousand times.

    Args:
        stage: the boards.

    Attributes:
        turns: when the coils were driven from then on, or not any more: (time [s], driven).
        largest: greatest duty of any coil since `forget`.
    """

    def __init__(self, stage: PowerStage) -> None:
        self._stage = stage
        self._on = [False] * len(stage.boards)
        self._seen = [-math.inf] * len(stage.boards)
        self.turns: list[tuple[float, bool]] = []
        self.largest = 0

    @property
    def driven(self) -> bool:
        """Whether any coil was driven when we last looked."""
        return bool(self.turns) and self.turns[-1][1]

    def look(self) -> None:
        """Take what has happened since we last looked."""
        changes = []
        for line in self._stage.lines:
            line.advance()
        for index, board in enumerate(self._stage.boards):
            with next(line for line in self._stage.lines if board in line.boards).lock:
                timeline = list(board.timeline)
            changes += [(at, index, duties) for at, duties in timeline if at > self._seen[index]]
            self._seen[index] = timeline[-1][0] if timeline else self._seen[index]
        for at, index, duties in sorted(changes):
            self.largest = max(self.largest, *(abs(duty) for duty in duties))
            self._on[index] = any(duties)
            if any(self._on) != self.driven:
                self.turns.append((at, any(self._on)))

    def forget(self) -> None:
        """Begin anew with the greatest duty."""
        self.look()
        self.largest = 0

    def to_zero(self, times: Sequence[float]) -> list[float]:
        """Return, for each time that found the coils driven, how long it took until they were not [s].

        Args:
            times: [s]; those after which the coils have not been at zero yet are left out.
        """
        turned = np.array([at for at, _ in self.turns])
        after = np.searchsorted(turned, times, side="right")
        return [
            self.turns[index][0] - time
            for time, index in zip(times, after.tolist(), strict=True)
            if 0 < index < len(self.turns) and self.turns[index - 1][1]
        ]
