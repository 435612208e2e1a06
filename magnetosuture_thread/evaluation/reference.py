"""Reads reference trajectories: needle poses and the thread that an independent simulator found."""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.errors import BagError
from magnetosuture_thread.files import read_regular
from magnetosuture_thread.geometry.obstacles import Disc
from magnetosuture_thread.untrusted import MAX_FILE_BYTES

# What numpy and json raise on files that are something else.
NOT_ONE = (
    *(OSError, ValueError, TypeError, AttributeError, LookupError, EOFError, MemoryError, RecursionError),
    *(zipfile.BadZipFile, zlib.error),
)


@dataclass(frozen=True)
class ReferenceTrajectory:
    """One reference trajectory; simulated, not recorded from a robot.

    Attributes:
        name: of the case.
        times: shape (T,) [s].
        tails: the needle's tail, shape (T, 2) [m].
        headings: unwrapped, shape (T,) [rad].
        threads: centreline of equally spaced points from the tail on, shape (T, m, 2) [m].
        discs: round obstacles.
        metadata: everything else that the file says.
    """

    name: str
    times: NDArray[np.float64]
    tails: NDArray[np.float64]
    headings: NDArray[np.float64]
    threads: NDArray[np.float64]
    discs: tuple[Disc, ...]
    metadata: dict[str, Any]

    def at(self, time: float) -> tuple[NDArray[np.float64], float, NDArray[np.float64]]:
        """Return tail, heading and thread at a time, linear between the samples."""
        last = len(self.times) - 1
        index = int(np.clip(np.searchsorted(self.times, time) - 1, 0, last - 1))
        part = (time - self.times[index]) / (self.times[index + 1] - self.times[index])

        def between(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(values[index] + part * (values[index + 1] - values[index]))

        return between(self.tails), float(between(self.headings)), between(self.threads)


def _load(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], dict[str, Any]]:
    packed = BytesIO(read_regular(path, MAX_FILE_BYTES))
    with zipfile.ZipFile(packed) as archive:
        if (size := sum(entry.file_size for entry in archive.infolist())) > MAX_FILE_BYTES:
            raise ValueError(f"it unpacks to {size} bytes, more than {MAX_FILE_BYTES}")
    packed.seek(0)
    with np.load(packed, allow_pickle=False) as data:
        times, poses, threads = (np.asarray(data[key], dtype=np.float64) for key in ("t", "pose", "X"))
        return times, poses, threads, json.loads(str(data["meta"]))


def read_reference(path: Path) -> ReferenceTrajectory:
    """Read a trajectory from an .npz file with the keys t, pose, X and meta.

    Raises:
        BagError: the file is missing, damaged, or not of this format.
    """
    try:
        times, poses, threads, metadata = _load(path)
        obstacle = metadata.get("obstacle")
        discs = (Disc((float(obstacle["cx"]), float(obstacle["cy"])), float(obstacle["R"])),) if obstacle else ()
    except FileNotFoundError:
        raise BagError(path, "does not exist; expected a reference trajectory (.npz)") from None
    except NOT_ONE as error:
        problem = " ".join(str(error).split())
        raise BagError(path, f"is no reference trajectory with the keys t, pose, X, meta: {problem}") from None
    count = len(times)
    if (
        times.ndim != 1
        or count < 2
        or poses.shape != (count, 3)
        or threads.ndim != 3
        or threads.shape[::2] != (count, 2)
    ):
        shapes = f"t {times.shape}, pose {poses.shape}, X {threads.shape}"
        raise BagError(path, f"has shapes {shapes}; expected t (T,), pose (T, 3), X (T, m, 2)")
    finite = all(np.all(np.isfinite(values)) for values in (times, poses, threads))
    if not (finite and np.all(np.diff(times) > 0.0)):
        raise BagError(path, "has times that do not increase, or values that are not finite")
    return ReferenceTrajectory(
        str(metadata.get("name", path.stem)), times, poses[:, :2], poses[:, 2], threads, discs, metadata
    )
