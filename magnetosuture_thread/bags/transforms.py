"""Transforms between frames, from /tf and /tf_static."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

STATIC = "/tf_static"
TOPICS = ("/tf", STATIC)
TF_MESSAGE = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class RigidTransform:
    """Rigid transform between two frames: p' = R p + t.

    Attributes:
        rotation: R.
        translation: t, shape (3,) [m].
    """

    rotation: Rotation
    translation: np.ndarray

    @staticmethod
    def identity() -> RigidTransform:
        """Return the identity."""
        return RigidTransform(Rotation.identity(), np.zeros(3))

    def compose(self, first: RigidTransform) -> RigidTransform:
        """Return the transform that applies `first` and then this one."""
        return RigidTransform(self.rotation * first.rotation, self.apply(first.translation))

    def inverse(self) -> RigidTransform:
        """Return the inverse transform."""
        back = self.rotation.inv()
        return RigidTransform(back, -back.apply(self.translation))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return points, shape (3,) or (n, 3) [m], in the other frame."""
        return np.asarray(self.rotation.apply(points) + self.translation)


@dataclass
class _Edge:
    """Transforms of a frame into its parents, over time, or one static transform."""

    is_static: bool
    stamps: list[int] = field(default_factory=list)
    parents: list[str] = field(default_factory=list)
    values: list[RigidTransform] = field(default_factory=list)

    def lookup(self, stamp: int | None) -> tuple[str, RigidTransform] | None:
        """Return parent and transform, the latest that is not later than a stamp; the last of all if None."""
        if self.is_static or stamp is None:
            return self.parents[-1], self.values[-1]
        index = bisect_right(self.stamps, stamp) - 1
        return (self.parents[index], self.values[index]) if index >= 0 else None


class TransformTree:
    """Tree of frames.

    Args:
        messages: topic and tf2_msgs/TFMessage in the order of the bag. Of static transforms the last one holds at any
            time; one that moves holds from its stamp until the next.
    """

    def __init__(self, messages: Iterable[tuple[str, Any]]) -> None:
        self._edges: dict[str, _Edge] = {}
        moving: dict[str, list[tuple[int, str, RigidTransform]]] = {}
        for topic, message in messages:
            for each in message.transforms:
                child, parent = each.child_frame_id.lstrip("/"), each.header.frame_id.lstrip("/")
                rigid = transform_from_message(each.transform)
                if rigid is None or child == parent:
                    continue
                if topic == STATIC:
                    self._edges[child] = _Edge(True, [0], [parent], [rigid])
                else:
                    stamp = each.header.stamp.sec * 10**9 + each.header.stamp.nanosec
                    moving.setdefault(child, []).append((stamp, parent, rigid))
        for child, entries in moving.items():
            if child not in self._edges:
                entries.sort(key=lambda entry: entry[0])
                stamps, parents, values = zip(*entries, strict=True)
                self._edges[child] = _Edge(False, list(stamps), list(parents), list(values))

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        parents = {parent for edge in self._edges.values() for parent in edge.parents}
        return sorted(parents | set(self._edges))

    def is_connected(self, frame: str, target: str) -> bool:
        """Return whether a frame can be transformed into another at any time."""
        return self._lookup(frame, target, None) is not None

    def lookup(self, frame: str, target: str, stamp: int) -> RigidTransform | None:
        """Return the transform from a frame into another at a time [ns]; None where it is unknown."""
        return self._lookup(frame, target, stamp)

    def _lookup(self, frame: str, target: str, stamp: int | None) -> RigidTransform | None:
        ups, downs = self._ancestors(frame, stamp), self._ancestors(target, stamp)
        for ancestor, rigid in ups.items():
            if ancestor in downs:
                return downs[ancestor].inverse().compose(rigid)
        return None

    def _ancestors(self, frame: str, stamp: int | None) -> dict[str, RigidTransform]:
        """Return the transform of a frame into each of its ancestors, from the nearest on."""
        found, rigid = {frame: RigidTransform.identity()}, RigidTransform.identity()
        while (edge := self._edges.get(frame)) is not None and (step := edge.lookup(stamp)) is not None:
            frame, up = step
            if frame in found:
                break  # A cycle of frames.
            rigid = up.compose(rigid)
            found[frame] = rigid
        return found


def transform_from_message(transform: Any) -> RigidTransform | None:
    """Return the transform of a geometry_msgs/Transform; None if it is not finite or its quaternion has length 0."""
    move, rotation = transform.translation, rotation_from_message(transform.rotation)
    translation = np.array([move.x, move.y, move.z], dtype=float)
    if rotation is None or not np.isfinite(translation).all():
        return None
    return RigidTransform(rotation, translation)


def rotation_from_message(turn: Any) -> Rotation | None:
    """Return the rotation of a geometry_msgs/Quaternion; None if it is not finite or of length 0."""
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=float)
    greatest = np.abs(quaternion).max()
    if not np.isfinite(greatest) or not greatest:
        return None
    return Rotation.from_quat(quaternion / greatest)  # whose length neither vanishes nor overflows
