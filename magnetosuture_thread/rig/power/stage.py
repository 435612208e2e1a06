"""The whole power stage: boards on their lines, and the currents they give."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.rig.power.board import RoboClawBoard
from magnetosuture_thread.rig.power.line import Line
from magnetosuture_thread.rig.power.packets import ADDRESSES


def board_addresses(boards: int) -> list[int]:
    """Return the addresses of so many boards: different ones, as far as there are that many."""
    return [ADDRESSES[index % len(ADDRESSES)] for index in range(boards)]


class PowerStage:
    """Boards with two coils each, in the order of their ports.

    Args:
        ports: the path at which each board is to be found; boards with the same path share a line. Their addresses
            are `board_addresses`.
        supply: of each board [V].
        resistance: of each coil [ohm].
        inductance: of each coil [H].

    Attributes:
        boards: in the order of their ports.
        lines: in the order of their first boards.
    """

    def __init__(self, ports: Sequence[str], supply: float, resistance: float, inductance: float) -> None:
        by_path: dict[str, list[RoboClawBoard]] = defaultdict(list)
        self.boards = []
        for path, address in zip(ports, board_addresses(len(ports)), strict=True):
            board = RoboClawBoard(address, supply, resistance, inductance)
            by_path[path].append(board)
            self.boards.append(board)
        self.lines = [Line(path, boards) for path, boards in by_path.items()]

    def open(self) -> None:
        """Let the boards be found.

        Raises:
            ConfigurationError: a path cannot be used.
        """
        try:
            for line in self.lines:
                line.plug()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Remove the lines."""
        for line in self.lines:
            line.unplug()

    def currents(self) -> NDArray[np.float64]:
        """Return the coils' currents now, shape (2 boards,) [A]."""
        for line in self.lines:
            line.advance()
        return np.array([current for board in self.boards for current in board.currents])
