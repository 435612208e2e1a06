"""The job `magnetosuture replay`: a recorded bag through the live graph."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.errors import GraphError
from magnetosuture_thread.interface import CAMERA, CURRENTS, NEEDLE_COMMAND, NODES, TRUE_THREAD, Channel
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.jobs.simulate import SCENARIO_NOTE, SLOWER_BRIDGE
from magnetosuture_thread.setups import Setup, read_setup
from magnetosuture_thread.study.currents import CurrentSeries
from magnetosuture_thread.study.picture import draw_summary
from magnetosuture_thread.study.replayed import (
    Collector,
    Instant,
    Spread,
    Summary,
    error_figures,
    stage_latencies,
)
from magnetosuture_thread.vision.images import decode_image, unpack_image
from magnetosuture_thread.vision.tracker import VisionTracker

DEFAULT_SETUP = "petri_35mm_polyamide"
# A replayed bag never moves a needle, so its bridge may arm itself.
NOTHING_MOVES = ("-p", "coil_bridge:driver:=recording", "-p", "coil_bridge:autostart:=armed", *SLOWER_BRIDGE)
Say = Callable[[str], None]
Progress = Callable[[float], None]
Times = dict[str, dict[int, float]]


def replay(
    bag_path: Path,
    output: Path,
    *,
    setup_name: str = "",
    rate: float = 1.0,
    say: Say = lambda text: None,
    progress: Progress = lambda share: None,
) -> Summary:
    """Play a bag through the three nodes as processes of their own, and judge what they made of it.

    `output` is made at the end, whole or not at all: `bag/` with all outputs, `summary.json`,
    `summary.png` and the nodes' `logs/`. The coil bridge gets the recording driver, whatever the set-up
    says: a replayed bag never moves a needle.

    Args:
        bag_path: an mcap file, or a folder that holds one.
        output: folder to make.
        setup_name: name or path of the set-up; the one the bag names if empty.
        rate: how much faster than recorded.
        say: called with a line for a person at each stage.
        progress: called with the share played, 0 to 1.

    Raises:
        BagError: the bag cannot be used, or the output exists or cannot be written.
        ConfigurationError: the set-up cannot be used.
        GraphError: a node ended or did not come, or nothing was predicted.
    """
    say(f"checking {bag_path}")
    bag = Bag(bag_path)
    with ExitStack() as stack:
        setup = _setup_of(bag, setup_name, Path(stack.enter_context(TemporaryDirectory())), say)
        return _replay(bag, setup, output, rate, say, progress)


def _setup_of(bag: Bag, name: str, spare: Path, say: Say) -> Setup:
    """Return the set-up to replay a bag with: the one asked for, or the bag's own, or the default."""
    named, text = bag.notes.get("setup", ""), bag.notes.get(SCENARIO_NOTE, "")
    if name:
        if named and name != named:
            say(f"the bag names the set-up {named}; taking {name}")
        return read_setup(name)
    if text:  # which says more than a name: the file may have changed, or be on another machine
        path = spare / f"{named or 'scenario'}.yaml"
        path.write_text(text, encoding="utf-8")
        return read_setup(str(path))
    if not named:
        say(f"the bag names no set-up; taking {DEFAULT_SETUP}")
    return read_setup(named or DEFAULT_SETUP)


def _replay(bag: Bag, setup: Setup, output: Path, rate: float, say: Say, progress: Progress) -> Summary:
    """Check the bag, play it and judge what came out."""
    camera = CAMERA[setup.vision.image_transport]
    bag.require(camera.recorded, camera.type_name)
    if bag.counts.get(NEEDLE_COMMAND.recorded):
        bag.require(NEEDLE_COMMAND.recorded, NEEDLE_COMMAND.type_name)
    bag.check()
    if rate < 1.0:
        say("played slower than recorded: the coil bridge's watchdog, in real time, may stop between commands")
    if rate > 1.0:
        say("played faster than recorded: latencies count what waits in the queues")
    with whole_folder(output) as folder:
        published, arrived = _play(folder, bag, setup, camera, rate, say, progress)
        say("judging what came out")
        return _judge(folder, bag, setup, camera, published, arrived, say)


def _play(
    folder: Path, bag: Bag, setup: Setup, camera: Channel, rate: float, say: Say, progress: Progress
) -> tuple[Times, Times]:
    """Play the bag into the graph and record its outputs to `folder`/bag."""
    # Only here, where it is needed: without ROS the other commands still work.
    from magnetosuture_thread.nodes import topics
    from magnetosuture_thread.nodes.processes import (
        NodeProcesses,
        environment_of,
        graph_environment,
        reserved_domain,
    )
    from magnetosuture_thread.nodes.replay import DEPTH, LiveReplay

    qos = folder / "lossless.yaml"
    qos.write_text(yaml.safe_dump(topics.lossless(DEPTH)), encoding="utf-8")
    files = [argument for path in (setup.path, qos) for argument in ("--params-file", str(path.resolve()))]
    arguments = [*files, "-p", "use_sim_time:=true", *NOTHING_MOVES]
    notes = {**bag.notes, "setup": setup.name, "replayed": str(bag.path)}
    inputs = {topic.channel.recorded for topic in topics.INPUTS}
    played = (inputs & {name for name, count in bag.counts.items() if count}) - {c.recorded for c in CAMERA.values()}
    played.add(camera.recorded)
    with reserved_domain() as domain:
        environment = graph_environment(domain)
        say(f"starting {', '.join(NODES)} (ROS domain {domain}, this machine only)")
        with (
            environment_of(environment),
            NodeProcesses(NODES, arguments, environment, folder / "logs") as nodes,
            BagWriter(folder / "bag", notes) as outputs,
        ):
            for topic in topics.OUTPUTS:
                outputs.add_topic(topic.channel.recorded, topic.channel.type_name)
            live = LiveReplay(domain, bag.start, rate, outputs.write, nodes.check)
            try:
                live.wait_for_graph(played)
                say(f"playing {bag.duration:.1f} s" + (f" at {rate:g} times the speed" if rate != 1.0 else ""))
                live.play(bag.records(played), lambda time: progress(time / max(bag.duration, 1e-9)))
            finally:
                live.close()
    qos.unlink()
    return live.published, live.arrived


def _judge(
    folder: Path, bag: Bag, setup: Setup, camera: Channel, published: Times, arrived: Times, say: Say
) -> Summary:
    """Put the outputs side by side; write summary.json and summary.png."""
    collector, recorded, replayed = Collector(setup.model.length), CurrentSeries(), CurrentSeries()
    for record in bag.records({TRUE_THREAD.recorded, CURRENTS.recorded} & set(bag.topics)):
        message = record.decode()
        collector.take(record.topic, message) if record.topic == TRUE_THREAD.recorded else recorded.take(message)
    for record in Bag(folder / "bag").records():
        message = record.decode()
        collector.take(record.topic, message)
        if record.topic == CURRENTS.recorded:
            replayed.take(message)
    instants = collector.instants()
    if not instants:
        said = "; ".join(f"{name}: {text}" for name, text in sorted(collector.health.items()))
        raise GraphError(
            f"none of {bag.counts[camera.recorded]} frames gave a prediction, {collector.poses} had a needle; {said}"
        )
    commands = published.get(NEEDLE_COMMAND.name, {})
    summary = Summary(
        bag=str(bag.path),
        setup=setup.name,
        simulated=bag.notes.get("simulated", ""),
        frames=bag.counts[camera.recorded],
        tracked=collector.poses,
        predicted=len(instants),
        commands=len(commands),
        driven=len(collector.driven & set(commands)),
        latency=stage_latencies(published, arrived, collector.driven),
        step_time=Spread.of([instant.step_time for instant in instants]),
        least_margins=collector.least_margins(bag.start),
        contact_frames=collector.contact_frames,
        stretch=max(instant.stretch for instant in instants),
        residual=max(instant.residual for instant in instants),
        seen_share=float(np.mean([instant.seen_share for instant in instants])),
        error_seen=error_figures([instant.error_seen for instant in instants]),
        error_truth=error_figures([instant.error_truth for instant in instants]),
        currents=replayed.against(recorded),
    )
    (folder / "summary.json").write_text(json.dumps(summary.to_json(), indent=2) + "\n", encoding="utf-8")
    if not _draw(folder / "summary.png", bag, setup, camera, instants, summary):
        say("no picture: the dish is not found in any frame")
    return summary


def _draw(path: Path, bag: Bag, setup: Setup, camera: Channel, instants: list[Instant], summary: Summary) -> bool:
    """Draw the summary around the frame with the greatest prediction error, if the dish can be found."""
    errors = [instant.error_seen if np.isfinite(instant.error_seen) else -1.0 for instant in instants]
    chosen = instants[int(np.argmax(errors))]
    view, frame = None, None
    for record in bag.records({camera.recorded}):
        message = record.decode()
        is_chosen = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == chosen.stamp
        if view is not None and not is_chosen:
            continue
        if setup.vision.image_transport == "compressed":
            image = decode_image(message.data)
        else:
            image = unpack_image(message.data, message.height, message.width, message.step, message.encoding)
        view = view or VisionTracker(setup.vision).look(image).view
        if is_chosen:
            frame = image
        if view is not None and frame is not None:
            draw_summary(path, frame, view, chosen, instants, setup.model.obstacles(), bag.start, summary)
            return True
    return False
