"""The command `magnetosuture coils`."""

from __future__ import annotations

import argparse

from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log

ACTIONS = ("state", "arm", "disarm", "stop", "reset", "configure", "activate", "deactivate", "cleanup")

DESCRIPTION = """\
Press a switch of the coil bridge that runs on this ROS domain, and show its state.

  state        show it
  arm, disarm  let velocity commands pass from now on, or none
  stop         emergency stop, latched; finding the bridge takes this command seconds: a button calls
               the service coils/emergency_stop
  reset        forget an emergency stop or a fault, once the driver is ready; the bridge stays disarmed
  configure, activate, deactivate, cleanup
               the lifecycle's transitions

The same by any ROS 2 tool: services coils/arm (std_srvs/SetBool), coils/emergency_stop and coils/reset
(std_srvs/Trigger).
"""


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "coils", "arm, disarm, stop or reset the running coil bridge", DESCRIPTION, run)
    parser.add_argument("action", choices=ACTIONS, metavar="ACTION", help=", ".join(ACTIONS))


def run(options: argparse.Namespace) -> int:
    """Press a switch of the running coil bridge."""
    from magnetosuture_thread.nodes.coil_client import CoilClient

    log = make_log(make_console())
    with CoilClient() as client:
        if options.action != "state":
            client.execute(options.action)
        state = client.state()
    width = max(len(name) for name in state)
    for name, value in state.items():
        log(f"{name:{width}}  {value}")
    return DONE
