"""Names of the graph's interface: nodes, frame, topics with their types, services.

Nothing of ROS is needed here: bags are read and written by the same names on machines without it.

Names follow the Collaborative Robotics Toolkit (CRTK) where it has one: `measured_cp` is a measured
Cartesian position, `servo_cv` a velocity to follow now, `setpoint_cv` the velocity that is really asked
of the actuators. Of their types that of `needle/measured_cp` is not CRTK's: it has a covariance.

Comments that begin with `#:` say what a topic's messages are, and what a service does, for the reference.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from enum import Enum

NODES = ("vision_tracker", "thread_model", "coil_bridge")
SCENE_SERVER = "scene_server"  # besides, where the scene changes while the others run
# As they run here: tracker and model in one process, so that a prediction waits for no message; the bridge alone.
PROCESSES = ("perception", "coil_bridge")
RIG_NODES = ("rig_simulator", "path_follower")  # besides, where the robot is simulated
PLANNER = "needle_planner"  # besides, where procedures are executed
STANDBY_NODES = ("vision_tracker", "thread_model", SCENE_SERVER, PLANNER, "path_follower")  # lifecycle, without boards
ALL_NODES = (*NODES, SCENE_SERVER, PLANNER, *RIG_NODES)
# Before the frames of this process's rig, for example "left/"; all that the process packs and reads has it.
FRAME_PREFIX_VARIABLE = "MAGNETOSUTURE_FRAME_PREFIX"
FRAME_PREFIX = os.environ.get(FRAME_PREFIX_VARIABLE, "").lstrip("/")  # tf2 takes no frame that begins with one
DISH_FRAME = f"{FRAME_PREFIX}dish"
CAMERA_FRAME = f"{FRAME_PREFIX}camera"
NEEDLE_FRAME = f"{FRAME_PREFIX}needle"  # its origin is the middle of the chord, x to the tip, y to the left; not in tf
STORAGE_SUFFIXES = (".mcap", ".db3")  # of files of messages, which make a folder a bag


class Quality(Enum):
    """How messages of a topic are delivered; see `nodes/topics.py` for the profiles."""

    RELIABLE = "reliable, the newest ten"
    SENSOR = "best effort, the newest five"
    # Of frames that wait only the newest two: a tracker that was held up would otherwise be late for many more, and
    # coils rest while poses are old.
    FRAMES = "best effort, the newest two"
    NEWEST = "best effort, the newest"
    LATCHED = "reliable, the last one also for who comes later"


@dataclass(frozen=True)
class Channel:
    """A topic.

    Attributes:
        name: without a leading slash, so that a namespace can come before it.
        type_name: for example `nav_msgs/msg/Path`.
        quality: of service.
        absolute: whether no namespace comes before it.
    """

    name: str
    type_name: str
    quality: Quality = Quality.RELIABLE
    absolute: bool = False

    @property
    def recorded(self) -> str:
        """Return the name as bags have it: with a leading slash."""
        return f"/{self.name}"


#: camera frames, instead of compressed ones
IMAGE = Channel("camera/image_raw", "sensor_msgs/msg/Image", Quality.FRAMES)
#: camera frames
COMPRESSED_IMAGE = Channel("camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage", Quality.FRAMES)
#: the lens, whose distortion is undone
CAMERA_INFO = Channel("camera/camera_info", "sensor_msgs/msg/CameraInfo", Quality.SENSOR)
#: the needle's tail, x axis along the needle; a heading with a deviation above 1 rad is unknown: the axis alone is
NEEDLE_POSE = Channel("needle/measured_cp", "geometry_msgs/msg/PoseWithCovarianceStamped", Quality.SENSOR)
#: a point near the needle's tip, by a person, for a needle of which nothing else tells the direction
NEEDLE_TIP = Channel("needle/tip", "geometry_msgs/msg/PointStamped")
#: searching, tracked or lost, why, confidence, curvature; where the dish is in the image
TRACKER_STATE = Channel("needle/tracker_state", "magnetosuture_msgs/msg/TrackerState")
#: where the path wants the tip
TIP_SETPOINT = Channel("needle/setpoint_cp", "geometry_msgs/msg/PoseStamped")
#: velocity of the tip commanded by an operator's page or joystick; has priority, pauses a procedure
OPERATOR_COMMAND = Channel("operator/servo_cv", "geometry_msgs/msg/TwistStamped")
#: commanded, filtered and applied velocity, active constraints, why the needle rests
FILTER_STATE = Channel("needle/filter_state", "magnetosuture_msgs/msg/FilterState")
#: motion in the frame `needle`, or velocity of the tip in `dish`, while no operator commands; of one node at a time
NEEDLE_COMMAND = Channel("needle/servo_cv", "geometry_msgs/msg/TwistStamped")
#: velocity that the currents give
NEEDLE_SETPOINT = Channel("needle/setpoint_cv", "geometry_msgs/msg/TwistStamped")
#: the measured centreline from the tail on, for viewers, and where there is no thread/observation
MEASURED_THREAD = Channel("thread/measured", "nav_msgs/msg/Path")
#: the pieces of the thread that a frame shows, whether they are all of it, and what may hide the rest
THREAD_OBSERVATION = Channel("thread/observation", "magnetosuture_msgs/msg/ThreadObservation")
#: the thread by the model alone
PREDICTED_THREAD = Channel("thread/predicted", "magnetosuture_msgs/msg/PredictedThread")
#: the thread by model and camera, with covariances and unknown forces; again where an observation is late
ESTIMATED_THREAD = Channel("thread/estimated", "magnetosuture_msgs/msg/EstimatedThread")
#: where needle and thread will be by the plan or the command held, where forecast_horizon is above 0
FORECAST = Channel("thread/forecast", "magnetosuture_msgs/msg/ThreadForecast")
#: every barrier, its minimum and 99 % bound, contact, friction; of the estimated thread if there is one
MARGINS = Channel("thread/margins", "magnetosuture_msgs/msg/SafetyMargins")
#: thread, margins and forecast, for RViz and Foxglove
THREAD_MARKERS = Channel("thread/markers", "visualization_msgs/msg/MarkerArray")
#: the dish and the named shapes in it, from now on
SCENE = Channel("scene", "magnetosuture_msgs/msg/Scene", Quality.LATCHED)
#: the scene, for RViz and Foxglove
SCENE_MARKERS = Channel("scene/markers", "visualization_msgs/msg/MarkerArray", Quality.LATCHED)
#: material, liquid and attachment of the thread from now on; by you, or a calibration
MATERIAL = Channel("thread/material", "magnetosuture_msgs/msg/ThreadMaterial", Quality.LATCHED)
#: currents commanded to the driver, why they are zero
CURRENTS = Channel("coils/currents", "magnetosuture_msgs/msg/CoilCurrents")
#: state, armed, reasons, driver
BRIDGE_STATE = Channel("coils/state", "magnetosuture_msgs/msg/CoilBridgeState", Quality.LATCHED)
#: state, goals met, progress, why it is paused or has failed
PROCEDURE_STATE = Channel("procedure/state", "magnetosuture_msgs/msg/ProcedureState", Quality.LATCHED)
#: poses of the needle's chord, at its middle, as planned
PROCEDURE_PLAN = Channel("procedure/plan", "nav_msgs/msg/Path", Quality.LATCHED)
#: a person holds the page's button
PROCEDURE_HOLD = Channel("procedure/hold", "std_msgs/msg/Header", Quality.NEWEST)
#: what every node reports of itself
DIAGNOSTICS = Channel("diagnostics", "diagnostic_msgs/msg/DiagnosticArray", absolute=True)
#: the wires to the simulated coils
RIG_CURRENTS = Channel("rig/currents", "magnetosuture_msgs/msg/CoilCurrents")
#: kind and duration of a fault, from now on; by you
FAULT_REQUEST = Channel("rig/fault", "std_msgs/msg/String")
#: simulated time, of rig or replay
CLOCK = Channel("clock", "rosgraph_msgs/msg/Clock", Quality.SENSOR, absolute=True)

# What only a simulation knows; never an input of the graph.
#: the simulated needle
GROUND_TRUTH_NEEDLE = Channel("ground_truth/needle", "geometry_msgs/msg/PoseStamped")
#: the simulated thread
GROUND_TRUTH_THREAD = Channel("ground_truth/thread", "nav_msgs/msg/Path")
#: what the simulated thread exerts on the needle at its tail, in the frame of the dish
GROUND_TRUTH_PULL = Channel("ground_truth/thread_pull", "geometry_msgs/msg/WrenchStamped")

# What a person presses that may let the needle move, and that must not come late.
STARTS = ("arm", "reset", "resume", "commission")
PRESS_TIMEOUT = 1.0  # s for which it counts: then the person has looked again

EXECUTE_PROCEDURE = "execute_procedure"  # the needle planner's action, ExecuteProcedure of magnetosuture_msgs


class Service(str, Enum):
    """Services: the name of each, its type, and the node that offers it."""

    type_name: str
    node: str

    __str__ = str.__str__

    def __new__(cls, name: str, type_name: str, node: str) -> Service:
        """Return a service, which is its name as a text."""
        service = str.__new__(cls, name)
        service._value_, service.type_name, service.node = name, type_name, node
        return service

    #: arm, unless the request comes late, or disarm
    ARM = "coils/arm", "std_srvs/srv/SetBool", "coil_bridge"
    #: zero currents at once, latched
    EMERGENCY_STOP = "coils/emergency_stop", "std_srvs/srv/Trigger", "coil_bridge"
    #: clear a stop or a fault, unless the request comes late; it stays disarmed
    RESET = "coils/reset", "std_srvs/srv/Trigger", "coil_bridge"
    #: give coils currents for at most 0.5 s, where coil_bridge.commissioning is on, unless the request comes late
    PULSE = "coils/pulse", "magnetosuture_msgs/srv/GivePulse", "coil_bridge"
    #: take another scene
    LOAD_SCENE = "scene/load", "magnetosuture_msgs/srv/LoadScene", SCENE_SERVER
    #: add a shape to the scene
    ADD_SHAPE = "scene/add", "magnetosuture_msgs/srv/EditShape", SCENE_SERVER
    #: replace the shape of a name
    REPLACE_SHAPE = "scene/replace", "magnetosuture_msgs/srv/EditShape", SCENE_SERVER
    #: remove a shape
    REMOVE_SHAPE = "scene/remove", "magnetosuture_msgs/srv/RemoveShape", SCENE_SERVER
    #: forecast of a path of the tip, where forecast_horizon is above 0; nothing moves
    FORECAST_PATH = "thread/forecast_path", "magnetosuture_msgs/srv/ForecastPath", "thread_model"
    #: check a procedure, plan it
    PLAN_PROCEDURE = "procedure/make_plan", "magnetosuture_msgs/srv/PlanProcedure", PLANNER
    #: pause the procedure
    PAUSE_PROCEDURE = "procedure/pause", "std_srvs/srv/Trigger", PLANNER
    #: begin what is planned, or go on, unless the request comes late
    RESUME_PROCEDURE = "procedure/resume", "std_srvs/srv/Trigger", PLANNER
    #: give the procedure up
    ABORT_PROCEDURE = "procedure/abort", "std_srvs/srv/Trigger", PLANNER
    #: let the time of a replayed bag stand still
    PAUSE_REPLAY = "replay/pause", "std_srvs/srv/SetBool", "replay"
    #: let the rig's time stand still
    PAUSE_RIG = "rig/pause", "std_srvs/srv/SetBool", "rig_simulator"


SERVICES = {service.value: service for service in Service}  # by name

CAMERA = {"raw": IMAGE, "compressed": COMPRESSED_IMAGE}  # by image transport

INPUTS = (IMAGE, COMPRESSED_IMAGE, CAMERA_INFO, NEEDLE_TIP, NEEDLE_COMMAND, OPERATOR_COMMAND)
OUTPUTS = (
    *(NEEDLE_POSE, TRACKER_STATE, MEASURED_THREAD, THREAD_OBSERVATION),
    *(PREDICTED_THREAD, ESTIMATED_THREAD, FORECAST, MARGINS, THREAD_MARKERS),
    *(FILTER_STATE, NEEDLE_SETPOINT, CURRENTS, BRIDGE_STATE, DIAGNOSTICS),
)
SETTINGS = (SCENE, SCENE_MARKERS, MATERIAL)  # what may be told at any time, or never
SIMULATED = (GROUND_TRUTH_NEEDLE, GROUND_TRUTH_THREAD, GROUND_TRUTH_PULL, TIP_SETPOINT, FAULT_REQUEST)
PROCEDURES = (PROCEDURE_STATE, PROCEDURE_PLAN, PROCEDURE_HOLD)  # of the needle planner, where there is one


def is_rectified(topic: str) -> bool:
    """Return whether a camera's topic is named as one of frames without distortion, as image_proc's image_rect."""
    camera = "/".join(topic.split("/")[-2:])  # as camera/image_rect, or image_rect/compressed
    return re.search("(?:^|[/_])rect(?:ified)?(?:[/_]|$)", camera) is not None
