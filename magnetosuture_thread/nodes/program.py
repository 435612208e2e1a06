"""Runs a node as a program, by its name: `ros2 run`, or `python -m magnetosuture_thread.nodes.program NAME`.

It is not loaded by other modules that need ROS: one that is asked to end while it loads ends at once, without a word.
"""

from __future__ import annotations

import os
import signal
import sys
from importlib import import_module
from pathlib import Path
from types import FrameType

from magnetosuture_thread.settings.errors import missing_module

STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)

MAKERS = {
    "vision_tracker": "VisionTrackerNode",
    "thread_model": "ThreadModelNode",
    "perception": "perception",
    "coil_bridge": "CoilBridgeNode",
    "scene_server": "SceneServerNode",
    "needle_planner": "NeedlePlannerNode",
    "path_follower": "PathFollowerNode",
    "rig_simulator": "RigSimulatorNode",
}
"""What each program makes and runs, by its name, in the module of that name; the console runs itself."""


def main() -> int:
    """Run the node that has the name of this program.

    To import it takes seconds. It has no currents and is in no graph meanwhile, and leaves without a traceback. When it
    has ended, further signals are ignored: Python gives their default actions back before it is gone, and a terminal's
    Ctrl-C reaches each node twice, from the terminal and from launch.

    Returns:
        The node's exit code; 1 with one line on standard error where ROS, or another package, is not installed.
    """
    name = Path(sys.argv[0]).name
    for which in STOPS:
        if signal.getsignal(which) is not signal.SIG_IGN:
            signal.signal(which, _leave)
    try:
        try:
            module = import_module(f"magnetosuture_thread.nodes.{name}")
            run = import_module("magnetosuture_thread.nodes.run").run
        except ModuleNotFoundError as error:
            print(f"error: {missing_module(error)}", file=sys.stderr)
            return 1
        return int(run(getattr(module, MAKERS[name])) if name in MAKERS else module.main())
    finally:
        for which in STOPS:
            signal.signal(which, signal.SIG_IGN)


def _leave(number: int, frame: FrameType | None) -> None:
    os._exit(0)


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in (*MAKERS, "console"):
        sys.exit(f"error: expected one of {', '.join((*MAKERS, 'console'))}")
    sys.argv = sys.argv[1:]
    sys.exit(main())
