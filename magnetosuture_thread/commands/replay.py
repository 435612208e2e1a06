"""The command `magnetosuture replay`: a recorded bag through the live graph, or through the same core without one."""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from magnetosuture_thread import ConfigurationError, InvalidInputError
from magnetosuture_thread.bags import packing
from magnetosuture_thread.bags.reader import RecordedMessage
from magnetosuture_thread.bags.reading import stamp_of
from magnetosuture_thread.bags.scene_message import packed_scene
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.commands import command, recorded
from magnetosuture_thread.commands.output import whole_folder
from magnetosuture_thread.estimator.thread_session import WAITING
from magnetosuture_thread.evaluation.graph_outputs import ReplaySummary
from magnetosuture_thread.evaluation.metrics import RunMetrics, SensorSilence, compare_errors, finite_or_none
from magnetosuture_thread.evaluation.tables import summary_table
from magnetosuture_thread.settings import interface
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.vision.tracker import FrameMeasurement, VisionTracker
from magnetosuture_thread.workers import Log, Progress

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from magnetosuture_thread.evaluation.plots import Photo


def add(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    command.runs(parser, run_replay)
    option = parser.add_argument
    option("bag", type=command.bag_location, metavar="BAG", help="an mcap file, or the folder of a bag, or its URL")
    option("--output", type=Path, required=True, metavar="DIR", help="folder to make")
    option("--offline", action="store_true", help="without a graph, as fast as the machine can")
    option("--rate", type=command.number_argument(0.05, 20.0), help="how much faster than recorded (default: 1)")
    option("--loop", action="store_true", help="play over and over, until Ctrl-C")
    command.add_span(parser)
    command.add_source(parser)


def run_replay(options: argparse.Namespace, terminal: command.Terminal) -> int:
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
    with terminal.progress("replay") as advance:
        given = {**command.bag_selection(options), "log": terminal.log, "progress": advance}
        if options.offline:
            summary = replay_offline(options.bag, options.output, **given)
        else:
            from magnetosuture_thread.commands.live import replay_live  # late, as it needs ROS

            summary = replay_live(options.bag, options.output, rate=options.rate or 1.0, loop=options.loop, **given)
    terminal.print(summary_table(summary))
    terminal.log(f"results: {options.output}")
    return command.DONE


def replay_offline(
    bag_path: Path,
    output: Path,
    *,
    log: Log = lambda text: None,
    progress: Progress = lambda share: None,
    **selection: Unpack[recorded.BagSelection],
) -> ReplaySummary:
    """Put a bag through tracker and model without a graph, and evaluate the predictions.

    `output` is made at the end, whole or not at all: `bag/`, `summary.json` and `summary.png`. The bag holds pose,
    what is seen of the thread, prediction, estimate and margins, each logged at its own stamp, with the numbers of
    the live graph. Two runs write it alike to the last bit: times that steps took are in the summary alone. The coil
    bridge has no part in it: what it does depends on real time.

    Args:
        bag_path: a bag.
        output: folder to make.
        log: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.
        selection: what of the bag is replayed.

    Raises:
        BagError: the bag cannot be used, nothing in it was predicted, or the output exists or cannot be written.
        ConfigurationError: the setup cannot be used.
    """
    with recorded.open_bag(bag_path, log, **selection) as given, whole_folder(output) as folder:
        things = "frames" if given.source == "camera" else "poses"
        log(f"predicting by the {'camera' if things == 'frames' else 'recorded'} {things} of {given.duration:.1f} s")
        seen = given.observations(progress)
        metrics = RunMetrics(given.setup.model.thread_length, given.recording.start)
        refused = Counter[str]()
        with BagWriter(folder / "bag", given.notes) as bag:
            made = _Output(bag, seen, given)
            steps = recorded.predictions(seen, given.setup.model, given.setup.scene, metrics.observe)
            began = time.perf_counter()  # kernels are loaded
            for step in steps:
                made.write(step)
                recorded.measure_step(step, metrics, refused)
            silence = SensorSilence.of(metrics.observed.times, given.start, given.start + given.duration)
            speed = (given.duration - silence.total) / (time.perf_counter() - began)
        log(f"{speed:.3g} times as fast as it was recorded; evaluating the outputs")
        reasons = (refused + seen.refused + given.recording.refused).most_common()
        if not len(metrics.series):
            words = "; ".join(f"{count} times {why}" for why, count in reasons) or WAITING
            found = f"{seen.found} of {seen.count} {things} had a needle"
            raise BagError(given.recording.path, f"gave no prediction: {found}; {words}")
        counts: dict[str, Any] = {"frames": seen.count, "tracked": seen.found, "commands": 0, "driven": 0}
        others = {"latency": {}, "speed": speed, "refused": dict(reasons)}
        others |= {"silence": silence, "remark": seen.thread_problem()}
        summary = replay_summary(given, metrics, **counts, **others)
        if summary.remark:
            log(summary.remark)
        write_results(folder, given, metrics, summary, log)
        return summary


class _Output:
    """Writes what the nodes would have published.

    Args:
        bag: to write to; it begins with the scene.
        seen: whose frames and records it gets as they go by.
        given: the bag that is replayed.
    """

    def __init__(self, bag: BagWriter, seen: recorded.ObservationReader, given: recorded.BagInput) -> None:
        self._bag, self._version = bag, given.setup.scene.version
        bag.add_topic(interface.SCENE.recorded, interface.SCENE.type_name)
        bag.write(interface.SCENE.recorded, given.begin, packed_scene(given.begin, given.setup.scene))
        is_observed = given.recording.counts.get(interface.THREAD_OBSERVATION.recorded)
        channels = [interface.TRACKER_STATE] if seen.source == "camera" else []
        channels += [interface.THREAD_OBSERVATION] if seen.source == "camera" or is_observed else []
        channels += [interface.NEEDLE_POSE, interface.MEASURED_THREAD]
        channels += [interface.PREDICTED_THREAD, interface.ESTIMATED_THREAD, interface.MARGINS]
        for channel in channels:
            bag.add_topic(channel.recorded, channel.type_name)
        seen.on_frame, seen.on_record = self._frame, self._record

    def write(self, step: recorded.Step) -> None:
        """Write prediction, estimate and margins of an observation."""
        result = step.result
        self._write(result.stamp, packing.prediction_outputs(result, step.settings.material))
        if result.refused is None and not result.late:  # as live: a pose that is refused gets no answer
            self._write(result.stamp, packing.estimate_outputs(result))

    def _frame(self, stamp: int, seen: FrameMeasurement) -> None:
        track = seen.track
        if seen.tracked:
            self._write(stamp, packing.pose_outputs(stamp, track.tail, track.heading, track.covariance))
            self._write(stamp, packing.thread_outputs(stamp, track.observation, seen.centreline))
        self._bag.write(interface.TRACKER_STATE.recorded, max(stamp, 0), packing.packed_tracker_state(stamp, track))

    def _write(self, stamp: int, outputs: packing.Outputs) -> None:
        for channel, data in outputs:
            self._bag.write(channel.recorded, max(stamp, 0), data)

    def _record(self, stamp: int, record: RecordedMessage) -> None:
        if record.topic == interface.SCENE.recorded:
            version = record.decode().version
            if version == self._version:
                return  # written at the beginning
            self._version = version
        self._bag.write(record.topic, max(stamp, 0), record.data)


def replay_summary(given: recorded.BagInput, metrics: RunMetrics, **others: Any) -> ReplaySummary:
    """Return the figures of a replay.

    Args:
        given: what was replayed.
        metrics: of its predictions, of which there are some.
        others: the fields of `ReplaySummary` that these do not give.
    """
    errors, compared = metrics.errors(), compare_errors(metrics.series)
    return ReplaySummary(
        bag=str(given.recording.path),
        setup=given.setup.name,
        simulated=given.recording.notes.get("simulated", ""),
        predicted=len(metrics.series),
        step_time=metrics.percentiles("step_time"),
        least_margins=list(metrics.minimum_margins.values()),
        contact_frames=metrics.contact_frames,
        stretch=metrics.maximum("strain"),
        residual=metrics.maximum("residual"),
        peak_tension=finite_or_none(metrics.maximum("tension")),
        needle_pull=finite_or_none(metrics.maximum("pull")),
        seen_share=metrics.mean("seen_share"),
        error_seen=errors["seen"],
        error_truth=errors["truth"],
        source=given.source,
        damage=str(given.recording.damage or ""),
        unverified=given.recording.salvaged_without_checksum,
        estimation=metrics.estimation,
        prediction=compared["prediction"],
        estimate=compared["estimate"],
        **others,
    )


def write_results(
    folder: Path, given: recorded.BagInput, metrics: RunMetrics, summary: ReplaySummary, log: Log
) -> None:
    """Write summary.json and summary.png.

    Args:
        folder: that gets them.
        given: what was replayed.
        metrics: of its predictions.
        summary: the figures.
        log: called with a line for a person.
    """
    text = json.dumps(summary.to_json(), indent=2, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    chosen = metrics.worst_measured
    assert chosen is not None
    from magnetosuture_thread.evaluation.plots import draw_plan, draw_summary  # late, as it imports matplotlib

    scene = given.setup.scene
    photo = find_photos(given, {chosen.stamp}).get(chosen.stamp) if given.source == "camera" else None
    if photo is None and given.source == "camera":
        log("no picture: the dish is not found in any frame")
        return
    at = (chosen.stamp - given.recording.start) * 1e-9
    shown = replace(chosen, obstacles=scene.obstacles)
    draw_summary(folder / "summary.png", photo or draw_plan(scene.dish.diameter), shown, at, summary)


def find_photos(given: recorded.BagInput, stamps: set[int]) -> dict[int, Photo]:
    """Return the camera images of some stamps, each with the view of the dish, of another frame where it has none."""
    from magnetosuture_thread.evaluation.plots import Photo  # late, as it imports matplotlib

    camera, images, views = given.recording.camera, dict[int, Any](), dict[int, Any]()
    if camera is None:
        return {}
    for record in given.recording.records([camera], start=given.start, duration=given.duration):
        if len(images) == len(stamps):
            break
        stamp = stamp_of(record)
        is_wanted = stamp in stamps and stamp not in images
        if views and not is_wanted:
            continue
        try:
            image = recorded.read_image(record)
        except (BagError, InvalidInputError):
            continue
        if is_wanted:
            images[stamp] = image
        view = VisionTracker(given.setup.vision, given.setup.scene).look(image).view
        if view is not None:
            views[stamp] = view
    spare = next(iter(views.values()), None)
    return {stamp: Photo(image, views.get(stamp, spare)) for stamp, image in images.items() if spare is not None}
