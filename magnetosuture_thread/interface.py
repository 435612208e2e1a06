"""Names of the graph's interface: nodes, frame, topics with their types, services.

Nothing of ROS is needed here: bags are read and written by the same names on machines without it.

Names follow the Collaborative Robotics Toolkit (CRTK) where it has one: `measured_cp` is a measured
Cartesian position, `servo_cv` a velocity to follow now, `setpoint_cv` the velocity that is really asked
of the actuators.
"""

from __future__ import annotations

from dataclasses import dataclass

NODES = ("vision_tracker", "thread_model", "coil_bridge")
SCENE_SERVER = "scene_server"  # besides, where the scene changes while the others run
# As they run here: tracker and model in one process, so that a prediction waits for no message; the bridge alone.
PROCESSES = ("perception", "coil_bridge")
RIG_NODES = ("rig_simulator", "path_follower")  # besides, where the robot is simulated
PLANNER = "needle_planner"  # besides, where procedures are executed
ALL_NODES = (*NODES, SCENE_SERVER, PLANNER, *RIG_NODES)
DISH_FRAME = "dish"
CAMERA_FRAME = "camera"
STORAGE_SUFFIXES = (".mcap", ".db3")  # of files of messages, which make a folder a bag


@dataclass(frozen=True)
class Channel:
    """A topic: its name and type.

    Attributes:
        name: without a leading slash, so that a namespace can come before it.
        type_name: for example `nav_msgs/msg/Path`.
    """

    name: str
    type_name: str

    @property
    def recorded(self) -> str:
        """Return the name as bags have it: with a leading slash."""
        return f"/{self.name}"


IMAGE = Channel("camera/image_raw", "sensor_msgs/msg/Image")
COMPRESSED_IMAGE = Channel("camera/image_raw/compressed", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = Channel("camera/camera_info", "sensor_msgs/msg/CameraInfo")
NEEDLE_POSE = Channel("needle/measured_cp", "geometry_msgs/msg/PoseWithCovarianceStamped")
TRACKER_STATE = Channel("needle/tracker_state", "magnetosuture_msgs/msg/TrackerState")
TIP_SETPOINT = Channel("needle/setpoint_cp", "geometry_msgs/msg/PoseStamped")
OPERATOR_COMMAND = Channel("operator/servo_cv", "geometry_msgs/msg/TwistStamped")  # above NEEDLE_COMMAND
FILTER_STATE = Channel("needle/filter_state", "magnetosuture_msgs/msg/FilterState")
NEEDLE_COMMAND = Channel("needle/servo_cv", "geometry_msgs/msg/TwistStamped")
NEEDLE_SETPOINT = Channel("needle/setpoint_cv", "geometry_msgs/msg/TwistStamped")
MEASURED_THREAD = Channel("thread/measured", "nav_msgs/msg/Path")
THREAD_OBSERVATION = Channel("thread/observation", "magnetosuture_msgs/msg/ThreadObservation")
PREDICTED_THREAD = Channel("thread/predicted", "magnetosuture_msgs/msg/PredictedThread")
ESTIMATED_THREAD = Channel("thread/estimated", "magnetosuture_msgs/msg/EstimatedThread")
FORECAST = Channel("thread/forecast", "magnetosuture_msgs/msg/ThreadForecast")
MARGINS = Channel("thread/margins", "magnetosuture_msgs/msg/SafetyMargins")
THREAD_MARKERS = Channel("thread/markers", "visualization_msgs/msg/MarkerArray")
SCENE = Channel("scene", "magnetosuture_msgs/msg/Scene")  # dish and shapes from now on
SCENE_MARKERS = Channel("scene/markers", "visualization_msgs/msg/MarkerArray")
MATERIAL = Channel("thread/material", "magnetosuture_msgs/msg/ThreadMaterial")
CURRENTS = Channel("coils/currents", "magnetosuture_msgs/msg/CoilCurrents")
BRIDGE_STATE = Channel("coils/state", "magnetosuture_msgs/msg/CoilBridgeState")
PROCEDURE_STATE = Channel("procedure/state", "magnetosuture_msgs/msg/ProcedureState")
PROCEDURE_PLAN = Channel("procedure/plan", "nav_msgs/msg/Path")
PROCEDURE_HOLD = Channel("procedure/hold", "std_msgs/msg/Header")  # while a person holds the page
DIAGNOSTICS = Channel("diagnostics", "diagnostic_msgs/msg/DiagnosticArray")

# Services of the coil bridge, of std_srvs: SetBool, Trigger and Trigger.
ARM, EMERGENCY_STOP, RESET = "coils/arm", "coils/emergency_stop", "coils/reset"

FORECAST_PATH = "thread/forecast_path"  # of the thread model, where it forecasts: ForecastPath of magnetosuture_msgs

# Services of the scene server, of magnetosuture_msgs: LoadScene, EditShape, EditShape and RemoveShape.
LOAD_SCENE, ADD_SHAPE, REPLACE_SHAPE, REMOVE_SHAPE = "scene/load", "scene/add", "scene/replace", "scene/remove"

# Of the needle planner: its action, ExecuteProcedure of magnetosuture_msgs, and services, PlanProcedure and Triggers.
EXECUTE_PROCEDURE = "execute_procedure"
PLAN_PROCEDURE = "procedure/make_plan"
PAUSE_PROCEDURE, RESUME_PROCEDURE, ABORT_PROCEDURE = "procedure/pause", "procedure/resume", "procedure/abort"

# Services of std_srvs/SetBool that let time stand still: of a replayed bag, of the simulated rig.
PAUSE_REPLAY, PAUSE_RIG = "replay/pause", "rig/pause"

# What only a simulation knows; never an input of the graph.
GROUND_TRUTH_NEEDLE = Channel("ground_truth/needle", "geometry_msgs/msg/PoseStamped")
GROUND_TRUTH_THREAD = Channel("ground_truth/thread", "nav_msgs/msg/Path")

CAMERA = {"raw": IMAGE, "compressed": COMPRESSED_IMAGE}  # by image transport

RIG_CURRENTS = Channel("rig/currents", "magnetosuture_msgs/msg/CoilCurrents")  # the wires to the simulated coils
FAULT_REQUEST = Channel("rig/fault", "std_msgs/msg/String")  # KIND DURATION, in force from now on
CLOCK = Channel("clock", "rosgraph_msgs/msg/Clock")
