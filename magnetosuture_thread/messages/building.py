"""Builds the messages of the graph, of rclpy's classes or of those of a bag's type store alike."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magnetosuture_thread.geometry.camera import DishView
from magnetosuture_thread.geometry.obstacles import Disc, triangulate
from magnetosuture_thread.geometry.orientation import heading_angle, yaw_quaternion
from magnetosuture_thread.geometry.polyline import Points
from magnetosuture_thread.interface import (
    BRIDGE_STATE,
    CAMERA_FRAME,
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    CURRENTS,
    DISH_FRAME,
    FILTER_STATE,
    GROUND_TRUTH_PULL,
    IMAGE,
    MEASURED_THREAD,
    NEEDLE_COMMAND,
    NEEDLE_POSE,
    SCENE,
    SCENE_MARKERS,
    THREAD_OBSERVATION,
    TIP_SETPOINT,
    TRACKER_STATE,
)
from magnetosuture_thread.messages.scene import scene_fields
from magnetosuture_thread.scene import Scene, SceneShape
from magnetosuture_thread.thread_observation import ThreadObservation

if TYPE_CHECKING:
    from magnetosuture_thread.coils.bridge import BridgeOutput
    from magnetosuture_thread.coils.coil_system import CoilSystem
    from magnetosuture_thread.coils.drivers import DriverState
    from magnetosuture_thread.vision.look import Track

Make = Callable[..., Any]
Vector = NDArray[np.float64]

IN_PLANE = (0, 1, 5)  # x, y and the turn about z among ROS's six coordinates of a pose
STATES = {"SEARCHING": 0, "TRACKED": 1, "LOST": 2}  # as in TrackerState.msg
UNCONFIGURED, CONDITIONS = 0, {"INACTIVE": 1, "ACTIVE": 2, "FAULT": 3}  # as in CoilBridgeState.msg
LINE_STRIP, TRIANGLE_LIST, CYLINDER, TEXT = 4, 11, 3, 9  # as in Marker.msg
ADD, DELETE_ALL = 0, 3

COLOURS = {"tissue": (0.85, 0.65, 0.6), "instrument": (0.55, 0.6, 0.66), "wall": (0.45, 0.42, 0.38)}
RIM = (0.45, 0.5, 0.55)
INK = (0.13, 0.19, 0.24)
THICKNESS = 1e-3  # m; of a disc's cylinder
RIM_POINTS = 180
NAME_SIZE = 0.025  # of the dish's diameter


class MessageBuilder:
    """Builds messages.

    Stamps are nanoseconds, or time messages of any library.

    Args:
        make: called with the name of a type, for example `nav_msgs/msg/Path`, and fields by name; returns the
            message, with zeros, or nothing, in fields that are not named.
        numbers: makes a sequence of numbers of a kind, for example "d" or "B", as `make` wants one.
    """

    def __init__(self, make: Make, numbers: Callable[[str, Any], Any]) -> None:
        self.make = make
        self.numbers = numbers

    @cached_property
    def _time_type(self) -> type:
        return type(self.make("builtin_interfaces/msg/Time"))

    def time(self, stamp: Any) -> Any:
        """Return a time."""
        if isinstance(stamp, self._time_type):
            return stamp
        whole, rest = divmod(stamp, 10**9) if isinstance(stamp, int) else (stamp.sec, stamp.nanosec)
        return self.make("builtin_interfaces/msg/Time", sec=whole, nanosec=rest)

    def header(self, stamp: Any, frame: str = DISH_FRAME) -> Any:
        """Return a header."""
        return self.make("std_msgs/msg/Header", stamp=self.time(stamp), frame_id=frame)

    def point(self, x: float, y: float, z: float = 0.0) -> Any:
        """Return a point [m]."""
        return self.make("geometry_msgs/msg/Point", x=float(x), y=float(y), z=float(z))

    def points(self, vertices: Points) -> list[Any]:
        """Return points of shape (m, 2) [m]."""
        return [self.point(x, y) for x, y in vertices.tolist()]

    def vector(self, x: float, y: float, z: float = 0.0) -> Any:
        """Return a vector."""
        return self.make("geometry_msgs/msg/Vector3", x=float(x), y=float(y), z=float(z))

    def pose(self, position: Sequence[float] | Vector, orientation: Sequence[float] | Vector) -> Any:
        """Return a pose of a position in the plane or in space [m] and a quaternion x, y, z, w."""
        x, y, z, w = map(float, orientation)
        turn = self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        return self.make("geometry_msgs/msg/Pose", position=self.point(*position), orientation=turn)

    def flat_pose(self, point: Vector, angle: float) -> Any:
        """Return a pose in the dish plane: a point of shape (2,) [m] and an angle from the x axis on [rad]."""
        return self.pose(point, (0.0, 0.0, *yaw_quaternion(angle)))

    def pose_stamped(self, header: Any, pose: Any) -> Any:
        """Return a PoseStamped."""
        return self.make(TIP_SETPOINT.type_name, header=header, pose=pose)

    def placed(self, stamp: Any, point: Vector, angle: float) -> Any:
        """Return a PoseStamped in the dish plane."""
        return self.pose_stamped(self.header(stamp), self.flat_pose(point, angle))

    def pose_with_covariance(self, header: Any, pose: Any, covariance: Vector) -> Any:
        """Return a PoseWithCovarianceStamped; the covariance of shape (36,)."""
        held = self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
        return self.make(NEEDLE_POSE.type_name, header=header, pose=held)

    def pose_message(self, stamp: Any, tail: Vector, heading: Vector, covariance: Vector | None = None) -> Any:
        """Return the needle's pose: position of the tail, x axis along the needle there.

        Args:
            stamp: of the frame that it was measured in.
            tail: shape (2,) [m].
            heading: unit vector, shape (2,).
            covariance: of x, y [m] and the angle of the heading [rad], shape (3, 3); zeros, which say in ROS
                that it is not known, if None.
        """
        whole = np.zeros((6, 6))
        if covariance is not None:
            whole[np.ix_(IN_PLANE, IN_PLANE)] = covariance
        return self.pose_with_covariance(
            self.header(stamp), self.flat_pose(tail, heading_angle(heading)), whole.ravel()
        )

    def path(self, header: Any, poses: Sequence[Any]) -> Any:
        """Return a Path of poses."""
        return self.make(MEASURED_THREAD.type_name, header=header, poses=[self.pose_stamped(header, p) for p in poses])

    def path_message(self, stamp: Any, points: Points) -> Any:
        """Return a polyline of shape (m, 2) [m] as a Path."""
        return self.path(self.header(stamp), [self.flat_pose(point, 0.0) for point in points])

    def observation_message(self, stamp: Any, observation: ThreadObservation) -> Any:
        """Return what a frame shows of the thread as a ThreadObservation."""
        pieces = [
            self.make(
                "magnetosuture_msgs/msg/ThreadPiece",
                points=self.points(piece.points),
                deviation=self.numbers("d", piece.deviation),
                first_end=int(piece.first_end),
                last_end=int(piece.last_end),
                arc_length_min=float(piece.arc_length[0]),
                arc_length_max=float(piece.arc_length[1]),
                direction_known=bool(piece.direction_known),
                confidence=float(piece.confidence),
            )
            for piece in observation.pieces
        ]
        hidden = [
            self.make("magnetosuture_msgs/msg/Outline", corners=self.points(outline)) for outline in observation.hidden
        ]
        return self.make(
            THREAD_OBSERVATION.type_name,
            header=self.header(stamp),
            pieces=pieces,
            complete=observation.complete,
            hidden=hidden,
        )

    def twist(self, linear: Any, angular: Any) -> Any:
        """Return a Twist of two vectors."""
        return self.make("geometry_msgs/msg/Twist", linear=linear, angular=angular)

    def twist_stamped(self, header: Any, twist: Any) -> Any:
        """Return a TwistStamped."""
        return self.make(NEEDLE_COMMAND.type_name, header=header, twist=twist)

    def twist_message(self, stamp: Any, velocity: Vector) -> Any:
        """Return a velocity of shape (2,) [m/s] as a TwistStamped."""
        return self.twist_stamped(self.header(stamp), self.twist(self.vector(*velocity), self.vector(0.0, 0.0)))

    def wrench_message(self, stamp: Any, force: Vector, moment: float) -> Any:
        """Return a WrenchStamped of a force in the dish plane, shape (2,) [N], and a counter-clockwise moment [N m]."""
        wrench = self.make("geometry_msgs/msg/Wrench", force=self.vector(*force), torque=self.vector(0.0, 0.0, moment))
        return self.make(GROUND_TRUTH_PULL.type_name, header=self.header(stamp), wrench=wrench)

    def tracker_state(self, stamp: Any, track: Track, processing_time: float = 0.0) -> Any:
        """Return what the tracker makes of a frame.

        Args:
            stamp: of the frame.
            track: of the frame.
            processing_time: wall-clock time it took [s]; offline it is no property of a frame, and 0.
        """
        fields: dict[str, Any] = {}
        if (view := track.view) is not None:
            fields["dish_centre"] = self.numbers("d", view.centre_px)
            fields["metres_per_pixel"], fields["camera_rotation"] = float(view.metres_per_pixel), float(view.rotation)
        if track.state.name == "TRACKED":
            fields["confidence"], fields["curvature"] = float(track.confidence), float(track.curvature)
        return self.make(
            TRACKER_STATE.type_name,
            header=self.header(stamp),
            state=STATES[track.state.name],
            reason=track.reason,
            processing_time=processing_time,
            **fields,
        )

    def compressed_image(self, stamp: Any, data: NDArray[np.uint8]) -> Any:
        """Return a JPEG file's bytes, shape (bytes,)."""
        return self.make(
            COMPRESSED_IMAGE.type_name,
            header=self.header(stamp, CAMERA_FRAME),
            format="bgr8; jpeg compressed bgr8",
            data=self.numbers("B", data),
        )

    def image(self, stamp: Any, pixels: NDArray[np.uint8]) -> Any:
        """Return a BGR image of shape (height, width, 3)."""
        height, width = pixels.shape[:2]
        return self.make(
            IMAGE.type_name,
            header=self.header(stamp, CAMERA_FRAME),
            height=height,
            width=width,
            encoding="bgr8",
            step=3 * width,
            data=self.numbers("B", pixels.ravel()),
        )

    def camera_info(self, stamp: Any, size: tuple[int, int], view: DishView, distance: float) -> Any:
        """Return the intrinsics of a camera that looks straight down from a distance [m]; size is width and height."""
        matrix = view.intrinsics(distance)
        return self.make(
            CAMERA_INFO.type_name,
            header=self.header(stamp, CAMERA_FRAME),
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            d=self.numbers("d", np.zeros(5)),
            k=matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack([matrix, np.zeros(3)]).ravel(),
        )

    def currents_message(self, stamp: Any, command: Any, output: BridgeOutput) -> Any:
        """Return coil currents with the stamp of the command that they follow, or why they are zero."""
        return self.make(
            CURRENTS.type_name,
            header=self.header(stamp),
            coil=list(output.coils),
            current=self.numbers("d", output.allocation.currents),
            command=self.time(command or 0),
            stop="; ".join(output.reasons),
            saturated=output.allocation.saturated,
        )

    def filter_message(self, stamp: Any, output: BridgeOutput) -> Any:
        """Return what became of the command; `stamp` is the command's, or the time now where there is none."""
        return self.make(
            FILTER_STATE.type_name,
            header=self.header(stamp),
            source=output.source,
            **self._velocities(output),
            slowdown=output.slowdown,
            active=list(output.active),
            overridden=output.overridden,
            reason=output.reason,
        )

    def state_message(self, stamp: Any, system: CoilSystem, driver: DriverState, refused: int) -> Any:
        """Return what the bridge does and why.

        Args:
            stamp: of the message.
            system: bridge, driver and latch.
            driver: what its driver knows.
            refused: messages so far.
        """
        latch, output = system.latch, system.output
        if output is not None:
            current, saturated, reasons = output.allocation.currents, output.allocation.saturated, output.reasons
            fields = {**self._velocities(output), "current": self.numbers("d", current), "saturated": saturated}
            fields["drift"] = output.drift
        else:
            reasons, fields = system.closed_reasons, {}
        if driver.currents is not None:
            fields["measured_current"] = self.numbers("d", driver.currents)
        return self.make(
            BRIDGE_STATE.type_name,
            header=self.header(stamp),
            state=UNCONFIGURED if output is None and not latch.latched_reason else CONDITIONS[latch.state.name],
            armed=latch.armed,
            emergency_stopped=latch.emergency,
            scene_version="" if system.bridge is None else system.bridge.scene_version,
            reasons=list(reasons),
            driver=system.driver_name,
            driver_ready=driver.ready,
            driver_warnings=list(driver.warnings),
            supply_voltage=self.numbers("d", driver.voltages),
            refused=refused,
            **fields,
        )

    def _velocities(self, output: BridgeOutput) -> dict[str, Any]:
        return {name: self.vector(*getattr(output, name)) for name in ("commanded", "filtered", "applied")}

    def scene_message(self, stamp: Any, scene: Scene) -> Any:
        """Return a scene."""
        fields = scene_fields(scene)
        shapes = [self._scene_shape(shape) for shape in fields["shapes"]]
        return self.make(SCENE.type_name, header=self.header(stamp), **{**fields, "shapes": shapes})

    def _scene_shape(self, fields: dict[str, Any]) -> Any:
        def outline(ring: dict[str, Any]) -> Any:
            corners = [self.point(**corner) for corner in ring["corners"]]
            return self.make("magnetosuture_msgs/msg/Outline", corners=corners)

        discs = [self.make("magnetosuture_msgs/msg/Disc", **disc) for disc in fields["disc"]]
        polygons = [
            self.make(
                "magnetosuture_msgs/msg/Polygon",
                outline=outline(polygon["outline"]),
                holes=[outline(hole) for hole in polygon["holes"]],
            )
            for polygon in fields["polygon"]
        ]
        return self.make("magnetosuture_msgs/msg/SceneShape", **{**fields, "disc": discs, "polygon": polygons})

    def scene_markers(self, stamp: Any, scene: Scene) -> Any:
        """Return a scene in place of the one before: the dish's rim, each shape in its kind's colour, and its name.

        A disc is a flat cylinder, a polygon the triangles that it is cut into. A MarkerArray.
        """
        header, diameter = self.header(stamp), scene.dish.diameter
        angles = np.linspace(0.0, 2.0 * math.pi, RIM_POINTS + 1)
        rim = scene.dish.radius * np.column_stack([np.cos(angles), np.sin(angles)])
        markers = [
            self.make("visualization_msgs/msg/Marker", header=header, action=DELETE_ALL),
            self._marker(header, "dish", 0, LINE_STRIP, colour=RIM, scale=(0.005 * diameter, 0.0, 0.0), points=rim),
        ]
        for index, shape in enumerate(scene.shapes):
            markers += [self._shape_marker(header, index, shape), self._name(header, index, shape, diameter)]
        return self.make(SCENE_MARKERS.type_name, markers=markers)

    def _shape_marker(self, header: Any, index: int, shape: SceneShape) -> Any:
        geometry, colour = shape.geometry, COLOURS[shape.kind]
        if isinstance(geometry, Disc):
            scale = (2.0 * geometry.radius, 2.0 * geometry.radius, THICKNESS)
            return self._marker(header, "shapes", index, CYLINDER, colour=colour, scale=scale, at=geometry.centre)
        cut = triangulate(geometry)
        points = cut.vertices[cut.triangles].reshape(-1, 2)
        return self._marker(header, "shapes", index, TRIANGLE_LIST, colour=colour, scale=(1.0, 1.0, 1.0), points=points)

    def _name(self, header: Any, index: int, shape: SceneShape, diameter: float) -> Any:
        at, scale = (*shape.label_point, THICKNESS), (0.0, 0.0, NAME_SIZE * diameter)
        return self._marker(header, "names", index, TEXT, colour=INK, opacity=1.0, scale=scale, at=at, text=shape.name)

    def _marker(
        self,
        header: Any,
        namespace: str,
        index: int,
        kind: int,
        *,
        colour: tuple[float, float, float],
        opacity: float = 0.8,
        scale: tuple[float, float, float] = (0.0, 0.0, 0.0),
        at: Sequence[float] = (0.0, 0.0),
        points: Points | None = None,
        text: str = "",
    ) -> Any:
        red, green, blue = colour
        return self.make(
            "visualization_msgs/msg/Marker",
            header=header,
            ns=namespace,
            id=index,
            type=kind,
            action=ADD,
            pose=self.pose(at, (0.0, 0.0, 0.0, 1.0)),
            scale=self.vector(*scale),
            color=self.make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=opacity),
            points=self.points(points) if points is not None else [],
            text=text,
        )
