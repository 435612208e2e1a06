"""The commands that make bags or run the graph: replay, render, simulate, console, coils, reproduce."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from magnetosuture_thread import ConfigurationError
from magnetosuture_thread.cli.arguments import (
    DONE,
    Subparsers,
    add_source,
    bag_location,
    bag_selection,
    command,
    namespace_argument,
    number_argument,
    output_file,
    whole_number,
)
from magnetosuture_thread.cli.terminal import make_console, make_log, progress, write_json

TOKEN = "MAGNETOSUTURE_TOKEN"
COIL_ACTIONS = ("state", "arm", "disarm", "stop", "reset", "configure", "activate", "deactivate", "cleanup")


def add(subparsers: Subparsers) -> None:
    """Add the commands."""
    parser = command(subparsers, "replay", run_replay)
    option = parser.add_argument
    option("bag", type=bag_location, metavar="BAG", help="an mcap file, or the folder of a bag, or its URL")
    option("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    option("--offline", action="store_true", help="without a graph, as fast as the machine can")
    option("--rate", type=number_argument(0.05, 20.0), help="how much faster than recorded (default: 1)")
    option("--loop", action="store_true", help="play over and over, until Ctrl-C")
    option("--start", type=number_argument(0.0, 1e6), default=0.0, help="seconds into the bag to begin at")
    option("--duration", type=number_argument(1e-3, 1e6), help="[s] (default: to the bag's end)")
    add_source(parser)

    option = command(subparsers, "render", run_render).add_argument
    option("reference", type=Path, metavar="REFERENCE", help="a reference trajectory (.npz)")
    option("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    option("--setup", required=True, metavar="NAME", help="a setup's name or YAML file")
    option("--start", type=number_argument(0.0, 1e6), default=0.0, help="time in the trajectory to begin at [s]")
    option("--duration", type=number_argument(1e-3, 1e6), help="[s] (default: to the trajectory's end)")
    option("--rate", type=number_argument(1.0, 240.0), default=30.0, help="frames, or poses, a second (default: 30)")
    quality = "of the JPEG frames (default: 85)"
    option("--quality", type=int, choices=range(1, 101), default=85, metavar="1..100", help=quality)
    option("--seed", type=whole_number, default=0, help="of dust and noise (default: 0)")
    option("--poses", action="store_true", help="write poses and measured threads instead of frames")
    noise = "of these, standard deviation; of the heading, this over the needle's length (default: 0)"
    option("--noise", type=number_argument(0.0, 1e-2), default=0.0, metavar="METRES", help=noise)

    parser = command(subparsers, "simulate", run_simulate)
    option = parser.add_argument
    option("setup", metavar="SETUP", help="a setup's name or YAML file")
    option("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to make")
    duration = "end after this many seconds (default: at the end of the path or procedure)"
    option("--duration", type=number_argument(0.1, 1e5), help=duration)
    option("--procedure", default="", metavar="NAME", help="execute a procedure, by its name or YAML file")
    clock = parser.add_mutually_exclusive_group()
    rate = "run with a simulated clock, this much faster than real time (default: in real time)"
    clock.add_argument("--rate", type=number_argument(0.5, 5.0), help=rate)
    boards = "drive simulated RoboClaw boards, by the driver for real ones"
    clock.add_argument("--boards", action="store_true", help=boards)
    option("--json", type=output_file, metavar="FILE", help="write the figures to a file")

    parser = command(subparsers, "console", run_console)
    option = parser.add_argument
    option("setup", metavar="SETUP", nargs="?", default="", help="its name or YAML file (default: of a 35 mm dish)")
    graph = parser.add_mutually_exclusive_group()
    graph.add_argument("--graph", action="store_true", help="on the graph that runs on this ROS domain")
    graph.add_argument("--replay", type=Path, metavar="BAG", help="on a bag that is played through the nodes")
    option("--namespace", type=namespace_argument, default="", metavar="NAME", help="of the running graph")
    option("--address", help="network address to serve on (default: the setup's, 127.0.0.1)")
    option("--port", type=whole_number, help="of it; 0 takes a free one (default: the setup's, 8090)")
    option("--certificate", metavar="FILE", help="serve over TLS by this certificate, a PEM file")
    option("--key", metavar="FILE", help="of the certificate, where it is not in the same file")
    option("--origin", metavar="URL", help="under which browsers reach the page, as https://rig.example")
    option("--token", help=f"that commands need (default: {TOKEN} in the environment, or a new one)")
    recordings = "folder that gets a bag for each recording (default: output/recordings)"
    option("--record", type=Path, default=Path("output/recordings"), metavar="DIR", help=recordings)

    parser = command(subparsers, "coils", run_coils)
    parser.add_argument("action", choices=COIL_ACTIONS, metavar="ACTION", help=", ".join(COIL_ACTIONS))
    parser.add_argument("--namespace", type=namespace_argument, default="", metavar="NAME", help="of the bridge")

    parser = command(subparsers, "reproduce", text="Reproduce a result of the paper, simulated.")
    results = parser.add_subparsers(title="results", metavar="RESULT", required=True)
    hernia = command(results, "hernia", run_hernia)
    behavior = command(results, "thread-behavior", run_thread_behavior)
    hernia.add_argument("bag", type=Path, metavar="BAG", help="a bag with an operator's velocity commands")
    for result in (hernia, behavior):
        result.add_argument("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    default = "(default: the bag's, with the paper's 40 segments)"
    hernia.add_argument("--setup", default="", metavar="NAME", help=f"setup or YAML file {default}")
    hernia.add_argument("--formulation", choices=("rod", "paper"), default="", help="(default: the setup's)")
    hernia.add_argument("--animation", action="store_true", help="draw hernia.gif as well")


def run_replay(options: argparse.Namespace) -> int:
    """Play a recorded bag through the live graph, or offline.

    vision_tracker, thread_model and coil_bridge run as processes of their own, on a ROS domain that nobody else
    uses, with simulated time on /clock and no hardware. A bag of needle poses instead of camera frames is played
    without vision_tracker.

    While it plays, the service /replay/pause (std_srvs/SetBool) lets time stand still; the domain to call it on
    is printed at the start. --loop plays over and over: time goes back and the nodes begin anew. The first pass
    is recorded and evaluated; Ctrl-C then ends, and the results are kept.

    --offline puts the bag through the same tracker and model without a graph, as fast as the machine can: the
    same poses, predictions and margins to the last bit, and two runs write the same bag. The coil bridge has no
    part in it, as what it does depends on real time.

    DIR, which must not exist, gets
      bag/           all outputs of the graph, an mcap bag
      summary.json   the figures of the table
      summary.png    the frame with the greatest error: the dish and a close-up, with the threads
      logs/          what each node printed (live only)
    """
    for name in ("rate", "loop"):
        if options.offline and getattr(options, name):
            raise ConfigurationError(f"--{name}", getattr(options, name), "none with --offline, which knows no time")

    from magnetosuture_thread.evaluation.tables import summary_table

    console = make_console()
    log = make_log(console)
    with progress(console, "replay") as advance:
        given = {**bag_selection(options), "log": log, "progress": advance}
        if options.offline:
            from magnetosuture_thread import replay_offline

            summary = replay_offline(options.bag, options.output, **given)
        else:
            from magnetosuture_thread.jobs.replay import replay_live

            summary = replay_live(options.bag, options.output, rate=options.rate or 1.0, loop=options.loop, **given)
    console.print(summary_table(summary))
    log(f"results: {options.output}")
    return DONE


def run_render(options: argparse.Namespace) -> int:
    """Write a bag of simulated camera frames, or poses.

    A reference trajectory is rendered as the overhead camera would see it, and written as a bag: JPEG frames,
    camera_info, the needle velocity commands that the trajectory amounts to, and ground truth. With --poses, needle
    poses and measured threads take the place of frames. Everything in the bag is simulated; its notes say so, and
    `replay` repeats it.
    """
    if options.noise and not options.poses:
        raise ConfigurationError("--noise", options.noise, "none without --poses")

    from magnetosuture_thread.evaluation.reference import read_reference
    from magnetosuture_thread.jobs.render import render_bag
    from magnetosuture_thread.setups import read_setup

    console = make_console()
    setup = read_setup(options.setup)
    reference = read_reference(options.reference)
    names = ("start", "duration", "rate", "quality", "seed", "poses", "noise")
    given = {name: getattr(options, name) for name in names}
    with progress(console, "render") as advance:
        frames = render_bag(reference, setup, options.output, progress=advance, **given)
    make_log(console)(f"{frames} simulated {'poses' if options.poses else 'frames'} in {options.output}")
    return DONE


def run_simulate(options: argparse.Namespace) -> int:
    """Run the whole graph around a simulated rig.

    No robot is needed: rig_simulator stands in for coils, dish, needle, thread and camera; vision_tracker,
    thread_model and coil_bridge are the ones that run on a robot; path_follower commands needle velocities along
    the setup's path. All are processes of their own, on a ROS domain that nobody else uses. Everything is
    simulated, and the bag says so.

    With --procedure, needle_planner executes it in place of path_follower. What came of it is in summary.json in BAG,
    and a procedure that fails ends the command with the reason.

    SETUP is a setup with waypoints in its section path_follower, which a procedure needs not. BAG, which must not
    exist, records every topic, including ground truth, and the nodes' logs; `replay` takes it. Ctrl-C ends the run,
    and what was recorded stays. The first run on a machine compiles for a minute before it begins.
    """
    from magnetosuture_thread.evaluation.tables import loop_table
    from magnetosuture_thread.jobs.simulate import simulate

    console = make_console()
    log = make_log(console)
    new = not options.output.exists()
    given = {name: getattr(options, name) for name in ("duration", "rate", "boards", "procedure")}
    try:
        with progress(console, "simulate") as advance:
            summary = simulate(options.setup, options.output, log=log, progress=advance, **given)
    except KeyboardInterrupt:
        if new and options.output.exists():
            log(f"what was recorded is in {options.output}")
        raise
    console.print(loop_table(summary))
    log(f"bag: {options.output}")
    write_json(options.json, summary.to_json())
    return DONE


def run_console(options: argparse.Namespace) -> int:
    """Serve the operator's page.

    It shows the dish with needle and thread, the margins and the state of all nodes; the needle is jogged by arrow
    keys, gamepad or mouse; emergency stop, arm and disarm.

    Without an option the whole graph is started around a simulated rig, with the coils disarmed, and any setup
    can be chosen on the page. --graph serves the page on the graph that runs on this ROS domain, --replay on a
    bag that is played through the nodes over and over, which nobody can jog. Around a simulated rig vision_tracker
    and thread_model get a real-time priority, where the system allows any, so that the browser does not delay them.

    The page is served on this machine alone unless --address and a token say otherwise. Without a token each
    start makes its own, which is in the address that is printed. A token in the environment, as
    MAGNETOSUTURE_TOKEN, is not shown to others on this machine, as an option is.

    Ctrl-C ends everything that this command has started; a recording that runs is kept.
    """
    if options.namespace and not options.graph:
        raise ConfigurationError("--namespace", options.namespace, "none without --graph, as no other graph is joined")

    from magnetosuture_thread.jobs.console import console

    token = options.token or os.environ.pop(TOKEN, None) or None  # no node gets it
    served = {"address": options.address, "port": options.port, "token": token, "origin": options.origin}
    served |= {"certificate": options.certificate, "private_key": options.key}
    console(
        options.setup,
        recordings=options.record,
        running=options.graph,
        namespace=options.namespace,
        bag=options.replay,
        served={name: value for name, value in served.items() if value is not None},
        log=make_log(make_console()),
    )
    return DONE


def run_coils(options: argparse.Namespace) -> int:
    """Arm, disarm, stop or reset the running coil bridge.

    The command acts on the coil bridge that runs on this ROS domain, and shows its state.

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
    from magnetosuture_thread.nodes.clients import CoilClient

    log = make_log(make_console())
    with CoilClient(options.namespace) as client:
        if options.action != "state":
            problem = client.execute(options.action)
            if problem:
                log(f"warning: {problem}")
        state = client.state()
    width = max(len(name) for name in state)
    for name, value in state.items():
        log(f"{name:{width}}  {value}")
    return DONE


def run_hernia(options: argparse.Namespace) -> int:
    """Replay a recorded steering around a hernia.

    The paper's simulated hernia repair: a needle steered by hand draws a thread through a penetration path and
    around a ring. BAG holds the commanded velocities of the needle, on /operator/servo_cv; friction slows it and
    barriers keep it off the obstacles, as they do live. In the thread model alone, where the needle is a point;
    `magnetosuture console hernia_ring` is the same with a whole rig.
    DIR, which must not exist, gets hernia.json and hernia.png: six instants, and the barriers over time.
    """
    from magnetosuture_thread.reproduce.hernia import hernia_lines, hernia_table, replay_hernia

    console = make_console()
    log = make_log(console)
    given = {"setup_name": options.setup, "formulation": options.formulation, "animation": options.animation}
    with progress(console, "hernia") as advance:
        summary = replay_hernia(options.bag, options.output, log=log, progress=advance, **given)
    console.print(hernia_table(summary))
    for line in (*hernia_lines(summary), f"results: {options.output}"):
        log(line)
    return DONE


def run_thread_behavior(options: argparse.Namespace) -> int:
    """Compare prediction and ground truth in closed loop, by material.

    The paper's two thread-behavior tests in a closed loop around the simulated rig, a polyamide thread of 19 mm and
    a silk thread of 150 mm in a larger dish: the predicted thread against ground truth and against what the camera
    measures. DIR, which must not exist, gets a bag of each, behaviour.json and behaviour.png. Everything is
    simulated. Takes two minutes.
    """
    from magnetosuture_thread.reproduce.thread_behavior import behavior_table, thread_behavior

    console = make_console()
    log = make_log(console)
    with progress(console, "thread-behavior") as advance:
        runs = thread_behavior(options.output, log=log, progress=advance)
    console.print(behavior_table(runs))
    log(f"results: {options.output}")
    return DONE
