"""Starts every node as it is installed, from colcon's folder as `ros2 run` would, and ends it.

Each gets a scene by its name, which is installed too, and the kernels of this tree. A node passes when it says on
/diagnostics that it is there, and ends with exit code 0 when interrupted.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from kernels import copy_kernels

NODES = {  # by program, what it says it is
    "scene_server": "scene_server",
    "vision_tracker": "vision_tracker",
    "thread_model": "thread_model",
    "perception": "thread_model",
    "coil_bridge": "coil_bridge",
    "rig_simulator": "rig_simulator",
    "path_follower": "path_follower",
    "needle_planner": "needle_planner",
    "console": "console",
}
TIMEOUT = 300.0  # s; two environments are tested at a time

LISTEN = """
import sys, time, rclpy
from diagnostic_msgs.msg import DiagnosticArray
rclpy.init()
node = rclpy.create_node("listener")
names = []
node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: names.append(m.status[0].name), 10)
heard = lambda: any(name.startswith(sys.argv[1] + ":") for name in names)
deadline = time.monotonic() + float(sys.argv[2])
while time.monotonic() < deadline and not heard():
    rclpy.spin_once(node, timeout_sec=0.1)
sys.exit(0 if heard() else 1)
"""


def check_nodes(programs: dict[str, str], python: Path, state: Path, domain: int) -> int:
    """Start every node, listen to it, and end it.

    Args:
        programs: how a shell starts each, by name.
        python: of an environment with rclpy.
        state: folder for what the nodes remember.
        domain: that no other nodes are on.

    Returns:
        0 if all of them work.
    """
    environment = {
        **os.environ,
        "XDG_STATE_HOME": str(state),
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "PATH": f"{python.parent}:{os.environ['PATH']}",
    }
    for name, program in programs.items():
        shell = ["sh", "-c", f"{program} --ros-args -p scene:=dish_35mm"]
        process = subprocess.Popen(shell, env=environment, cwd="/")
        try:
            heard = subprocess.run([python, "-c", LISTEN, NODES[name], str(TIMEOUT)], env=environment, check=False)
            process.send_signal(signal.SIGINT)
            code = process.wait(TIMEOUT)
        finally:
            process.kill()
        if heard.returncode or code:
            print(f"{program}: heard {heard.returncode == 0}, exit code {code}", file=sys.stderr)
            return 1
        print(f"{name}: runs and ends")
        time.sleep(0.2)
    return 0


def main(install: Path, names: list[str]) -> int:
    """Start nodes, all of them where none is named, from colcon's install folder; return 0 if all of them work."""
    (program,) = install.glob("**/lib/magnetosuture_thread/scene_server")  # in either layout of the folder
    sourced = f'. "{install}/setup.sh" && exec '
    where = "import os, magnetosuture_thread as package; print(os.path.dirname(package.__file__))"
    found = subprocess.run(["sh", "-c", f"{sourced}{sys.executable} -c '{where}'"], check=True, capture_output=True)
    copy_kernels(Path(found.stdout.decode().strip()))
    programs = {name: f'{sourced}"{program.parent}/{name}"' for name in names or NODES}
    return check_nodes(programs, Path(sys.executable), install / "state", 101)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]).resolve(), sys.argv[2:]))
