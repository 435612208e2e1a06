"""Messages of other types as those of our graph, and messages of other frames in the dish's.

Functions of messages alone. They read fields by name, so that it does not matter from which definition of a type a
message was decoded, and return messages of our own type store.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from magnetosuture_thread.bags.message_types import MESSAGES
from magnetosuture_thread.messages.markers import ADD, LINE_STRIP

if TYPE_CHECKING:
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
        from scipy.spatial.transform import Rotation

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


class TransformTree:
    """Tree of frames.

    Args:
        messages: topic and tf2_msgs/TFMessage in the order of the bag. Of static transforms the last one holds at any
            time; one that moves holds from its stamp until the next.
    """

    def __init__(self, messages: Iterable[tuple[str, Any]]) -> None:
        # By child frame, in the order of time: stamp, parent, and the transform into it from then on.
        self._edges: dict[str, list[tuple[float, str, RigidTransform]]] = {}
        static: dict[str, list[tuple[float, str, RigidTransform]]] = {}
        for topic, message in messages:
            for each in message.transforms:
                child, parent = each.child_frame_id.lstrip("/"), each.header.frame_id.lstrip("/")
                rigid = transform_from_message(each.transform)
                if rigid is None or child == parent:
                    continue
                if topic == STATIC:
                    static[child] = [(-math.inf, parent, rigid)]
                else:
                    stamp = each.header.stamp.sec * 10**9 + each.header.stamp.nanosec
                    self._edges.setdefault(child, []).append((stamp, parent, rigid))
        self._edges |= static
        for entries in self._edges.values():
            entries.sort(key=itemgetter(0))

    @property
    def frames(self) -> list[str]:
        """Names of all frames."""
        return sorted({parent for entries in self._edges.values() for _, parent, _ in entries} | set(self._edges))

    def is_connected(self, frame: str, target: str) -> bool:
        """Return whether a frame can be transformed into another at any time."""
        return self.lookup(frame, target, None) is not None

    def lookup(self, frame: str, target: str, stamp: int | None) -> RigidTransform | None:
        """Return the transform from a frame into another at a time [ns], the last if None; None where it is unknown."""
        ups, downs = self._ancestors(frame, stamp), self._ancestors(target, stamp)
        for ancestor, rigid in ups.items():
            if ancestor in downs:
                return downs[ancestor].inverse().compose(rigid)
        return None

    def _ancestors(self, frame: str, stamp: int | None) -> dict[str, RigidTransform]:
        """Return the transform of a frame into each of its ancestors, from the nearest on."""
        found, rigid = {frame: RigidTransform.identity()}, RigidTransform.identity()
        while entries := self._edges.get(frame):
            index = len(entries) if stamp is None else bisect_right(entries, stamp, key=itemgetter(0))
            if not index:
                break  # Nothing is known as early as that.
            _, frame, up = entries[index - 1]
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
    from scipy.spatial.transform import Rotation  # late, as bags of our own graph turn nothing

    quaternion = np.array([turn.x, turn.y, turn.z, turn.w], dtype=float)
    greatest = np.abs(quaternion).max()
    if not np.isfinite(greatest) or not greatest:
        return None
    return Rotation.from_quat(quaternion / greatest)  # whose length neither vanishes nor overflows


POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
PATH = "nav_msgs/msg/Path"
TWIST = "geometry_msgs/msg/TwistStamped"
UNSTAMPED_TWIST = "geometry_msgs/msg/Twist"

UPRIGHT = (0.0, 0.0, 0.0, 1.0)

Convert = Callable[[Any, int], Any]


class UnfitError(Exception):
    """A message that cannot be converted to a type of our graph; the text gives the reason."""


def pose_stamped(message: Any, time: int) -> Any:
    """Return a PoseStamped of anything that holds one pose."""
    return MESSAGES.pose_stamped(_header_of(message), _pose_in(message))


def pose_with_covariance(message: Any, time: int) -> Any:
    """Return a PoseWithCovarianceStamped of anything that holds one pose; a covariance of zeros means unknown."""
    holder = getattr(message, "pose", None)
    covariance = getattr(holder, "covariance", None)
    values = np.zeros(36) if covariance is None else np.array(covariance, dtype=float)
    return MESSAGES.pose_with_covariance(_header_of(message), _pose_in(message), values)


def path_of_marker(message: Any, time: int) -> Any:
    """Return a Path of a Marker that is a line strip."""
    if message.action != ADD or message.type != LINE_STRIP:
        raise UnfitError("a marker that is no line strip being added")
    points = np.array([[point.x, point.y, point.z] for point in message.points]).reshape(-1, 3)
    turn, place = message.pose.orientation, message.pose.position
    # RViz takes a quaternion of zeros, which a careless node sends, for no rotation.
    is_none = not np.any([turn.x, turn.y, turn.z, turn.w])
    rotation = RigidTransform.identity().rotation if is_none else rotation_from_message(turn)
    if rotation is None:
        raise UnfitError("an orientation that is none")
    moved = RigidTransform(rotation, np.array([place.x, place.y, place.z])).apply(points)
    return _path(message, [MESSAGES.pose(xyz, UPRIGHT) for xyz in moved])


_POSES = (
    POSE,
    POSE_WITH_COVARIANCE,
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
# By the type that our graph takes, by the type that a bag may have.
CONVERSIONS: dict[str, dict[str, Convert]] = {
    POSE: dict.fromkeys(_POSES, pose_stamped),
    POSE_WITH_COVARIANCE: dict.fromkeys(_POSES, pose_with_covariance),
    PATH: {
        PATH: lambda m, _: _path(m, [_pose(each.pose.position, each.pose.orientation) for each in m.poses]),
        "geometry_msgs/msg/PoseArray": lambda m, _: _path(m, [_pose(e.position, e.orientation) for e in m.poses]),
        "geometry_msgs/msg/PolygonStamped": lambda m, _: _path(m, [_pose(point) for point in m.polygon.points]),
        "visualization_msgs/msg/Marker": path_of_marker,
        "magnetosuture_msgs/msg/PredictedThread": lambda m, _: _path(m, [_pose(point) for point in m.positions]),
    },
    TWIST: {
        TWIST: lambda m, _: MESSAGES.twist_stamped(_header_of(m), _twist(m.twist)),
        # Stamped when it was recorded, in no frame.
        UNSTAMPED_TWIST: lambda m, time: MESSAGES.twist_stamped(MESSAGES.header(time, ""), _twist(m)),
    },
}


def moved(message: Any, rigid: RigidTransform, frame: str) -> Any:
    """Return a message of one of the types in `CONVERSIONS` in another frame.

    Of a twist only the directions change: it stays the velocity of the same point, seen from a frame at rest.
    A covariance C becomes M C M^T, where M turns position and rotation alike.
    """
    header = MESSAGES.header(message.header.stamp, frame)
    kind = message.__msgtype__
    if kind == POSE:
        return MESSAGES.pose_stamped(header, _moved_pose(message.pose, rigid))
    if kind == POSE_WITH_COVARIANCE:
        both = np.kron(np.eye(2), rigid.rotation.as_matrix())
        covariance = both @ np.reshape(message.pose.covariance, (6, 6)) @ both.T
        return MESSAGES.pose_with_covariance(header, _moved_pose(message.pose.pose, rigid), covariance.ravel())
    if kind == PATH:
        return MESSAGES.path(header, [_moved_pose(each.pose, rigid) for each in message.poses])
    return MESSAGES.twist_stamped(header, _twist(message.twist, rigid.rotation.apply))


def _moved_pose(pose: Any, rigid: RigidTransform) -> Any:
    place = rigid.apply(np.array([pose.position.x, pose.position.y, pose.position.z], dtype=float))
    turn, rotation = pose.orientation, rotation_from_message(pose.orientation)
    if rotation is None:
        raise UnfitError("an orientation that is none")
    # Composed by hand, so that its length stays what it was: whoever takes it judges that.
    turned = (rigid.rotation * rotation).as_quat() * math.hypot(turn.x, turn.y, turn.z, turn.w)
    return MESSAGES.pose(place, turned)


def _pose_in(message: Any) -> Any:
    """Return the pose in a message, however deep."""
    if hasattr(message, "transform"):
        if transform_from_message(message.transform) is None:
            raise UnfitError("a transform that is none")
        return _pose(message.transform.translation, message.transform.rotation)
    pose = getattr(message.pose, "pose", message.pose)
    return _pose(pose.position, pose.orientation)


def _header_of(message: Any) -> Any:
    return MESSAGES.header(message.header.stamp, message.header.frame_id)


def _path(message: Any, poses: Sequence[Any]) -> Any:
    return MESSAGES.path(_header_of(message), poses)


def _pose(position: Any, orientation: Any = None) -> Any:
    turn = UPRIGHT
    if orientation is not None:
        turn = (orientation.x, orientation.y, orientation.z, orientation.w)
    return MESSAGES.pose((position.x, position.y, position.z), turn)


def _twist(twist: Any, turned: Callable[[Any], Any] = list) -> Any:
    vectors = (MESSAGES.vector(*turned([each.x, each.y, each.z])) for each in (twist.linear, twist.angular))
    return MESSAGES.twist(*vectors)
