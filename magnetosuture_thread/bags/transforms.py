"""Where frames are in one another, as /tf and /tf_static tell."""

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
class Rigid:
    """p' = R p + t: a point of one frame in another.

    Attributes:
        rotation: R.
        translation: t, shape (3,) [m].
    """

    rotation: Rotation
    translation: np.ndarray

    @staticmethod
    def none() -> Rigid:
        """Return the transform that leaves all as it is."""
        return Rigid(Rotation.identity(), np.zeros(3))

    def after(self, first: Rigid) -> Rigid:
        """Return the transform that does `first` and then this one."""
        return Rigid(self.rotation * first.rotation, self.points(first.translation))

    def inverse(self) -> Rigid:
        """Return the transform back."""
        back = self.rotation.inv()
        return Rigid(back, -back.apply(self.translation))

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return points, shape (3,) or (n, 3) [m], in the other frame."""
        return np.asarray(self.rotation.apply(points) + self.translation)


@dataclass
class _Edge:
    """Where a frame is in its parents, over time; once and for all if it is static."""

    is_static: bool
    stamps: list[int] = field(default_factory=list)
    parents: list[str] = field(default_factory=list)
    values: list[Rigid] = field(default_factory=list)

    def at(self, stamp: int | None) -> tuple[str, Rigid] | None:
        """Return parent and transform, the latest that is not later than a stamp; the last of all if None."""
        if self.is_static or stamp is None:
            return self.parents[-1], self.values[-1]
        index = bisect_right(self.stamps, stamp) - 1
        return (self.parents[index], self.values[index]) if index >= 0 else None


class Transforms:
    """A tree of frames.

    Args:
        messages: topic and tf2_msgs/TFMessage, as they were said. A static transform holds at any time, the last one
            that was told; one that moves holds from its stamp until the next.
    """

    def __init__(self, messages: Iterable[tuple[str, Any]]) -> None:
        self._edges: dict[str, _Edge] = {}
        told: dict[str, list[tuple[int, str, Rigid]]] = {}
        for topic, message in messages:
            for each in message.transforms:
                child, parent = each.child_frame_id.lstrip("/"), each.header.frame_id.lstrip("/")
                rigid = rigid_of(each.transform)
                if rigid is None or child == parent:
                    continue
                if topic == STATIC:
                    self._edges[child] = _Edge(True, [0], [parent], [rigid])
                else:
                    stamp = each.header.stamp.sec * 10**9 + each.header.stamp.nanosec
                    told.setdefault(child, []).append((stamp, parent, rigid))
        for child, entries in told.items():
            if child not in self._edges:
                entries.sort(key=lambda entry: entry[0])
                stamps, parents, values = zip(*entries, strict=True)
                self._edges[child] = _Edge(False, list(stamps), list(parents), list(values))

    @property
    def frames(self) -> list[str]:
        """Return all frames that are told of."""
        parents = {parent for edge in self._edges.values() for parent in edge.parents}
        return sorted(parents | set(self._edges))

    def lead(self, frame: str, target: str) -> bool:
        """Return whether there is a way from a frame to another at any time."""
        return self._between(frame, target, None) is not None

    def between(self, frame: str, target: str, stamp: int) -> Rigid | None:
        """Return where the points of a frame are in another, at a time [ns]; None where nothing tells."""
        return self._between(frame, target, stamp)

    def _between(self, frame: str, target: str, stamp: int | None) -> Rigid | None:
        ups, downs = self._upwards(frame, stamp), self._upwards(target, stamp)
        for ancestor, rigid in ups.items():
            if ancestor in downs:
                return downs[ancestor].inverse().after(rigid)
        return None

    def _upwards(self, frame: str, stamp: int | None) -> dict[str, Rigid]:
        """Return where a frame is in each frame above it, from the nearest on."""
        found, rigid = {frame: Rigid.none()}, Rigid.none()
        while (edge := self._edges.get(frame)) is not None and (step := edge.at(stamp)) is not None:
            frame, up = step
            if frame in found:
                break  # Frames that go round in a circle lead nowhere.
            rigid = up.after(rigid)
            found[frame] = rigid
        return found


def rigid_of(transform: Any) -> Rigid | None:
    """Return a geometry_msgs/Transform; None if it is none: not finite, or a quaternion of length 0."""
    move, rotation = transform.translation, rotation_of(transform.rotation)
    translation = np.array([move.x, move.y, move.z], dtype=float)
    if rotation is None or not np.isfinite(translation).all():
        return None
    return Rigid(rotation, translation)


def rotation_of(turn: Any) -> Rotation | None:
    """Return a geometry_msgs/Quaternion of any length but 0; None if it is not finite or of length 0."""
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=float)
    greatest = np.abs(quaternion).max()
    if not np.isfinite(greatest) or not greatest:
        return None
    return Rotation.from_quat(quaternion / greatest)  # whose length neither vanishes nor overflows
