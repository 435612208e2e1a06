"""The command `magnetosuture coils`. It needs ROS."""

from __future__ import annotations

import argparse

from magnetosuture_thread.commands.command import Terminal, namespace_argument
from magnetosuture_thread.nodes.clients import ACTIONS, CoilClient


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    actions = ("state", *ACTIONS, "configure", "activate", "deactivate", "cleanup")
    parser.add_argument("action", choices=actions, metavar="ACTION", help=", ".join(actions))
    parser.add_argument("--namespace", type=namespace_argument, default="", metavar="NAME", help="of the bridge")


def run_coils(options: argparse.Namespace, terminal: Terminal) -> None:
    """Arm, disarm, stop or reset the running coil bridge.

    The command acts on the coil bridge that runs on this ROS domain, and shows its state.

      state        show it
      arm, disarm  let velocity commands pass from now on, or none
      stop         emergency stop, latched; finding the bridge takes this command seconds: a button calls
                   the service coils/emergency_stop
      reset        forget an emergency stop or a fault, once the driver is ready; the bridge stays disarmed
      configure, activate, deactivate, cleanup
                   the lifecycle's transitions

    Arm and reset give up where no bridge is found within 3 s, and count for 1 s from then on.

    The same by any ROS 2 tool: services coils/arm (std_srvs/SetBool), coils/emergency_stop and coils/reset
    (std_srvs/Trigger).
    """
    with CoilClient(options.namespace) as client:
        problem = "" if options.action == "state" else client.execute(options.action)
        if problem:
            terminal.log(f"warning: {problem}")
        state = client.state()
    width = max(len(name) for name in state)
    for name, value in state.items():
        terminal.log(f"{name:{width}}  {value}")
