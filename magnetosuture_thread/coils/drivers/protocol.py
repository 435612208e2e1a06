"""What a coil driver must do."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray


class CoilDriver(Protocol):
    """The interface to the coils' power stage."""

    def open(self) -> None:
        """Connect, with all currents at zero."""
        ...

    def apply(self, currents: NDArray[np.float64]) -> None:
        """Set the current of each coil, shape (m,) [A]."""
        ...

    def close(self) -> None:
        """Set all currents to zero and disconnect."""
        ...
