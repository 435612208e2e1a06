"""Replaying bags through the live graph: nodes in processes of their own, outputs recorded."""

from __future__ import annotations

import json
import signal
import time
from contextlib import closing
from pathlib import Path

import pytest
from std_srvs.srv import SetBool

from benchmarks.page import running
from magnetosuture_thread import replay_offline
from magnetosuture_thread.bags.message_types import typestore
from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.reading import nanoseconds
from magnetosuture_thread.commands.live import replay_live
from magnetosuture_thread.commands.render import render_bag
from magnetosuture_thread.evaluation.reference import ReferenceTrajectory
from magnetosuture_thread.nodes import topics
from magnetosuture_thread.rig.setups import read_setup
from magnetosuture_thread.settings.errors import BagError
from magnetosuture_thread.settings.interface import (
    ESTIMATED_THREAD,
    MARGINS,
    MEASURED_THREAD,
    NEEDLE_POSE,
    PREDICTED_THREAD,
    THREAD_OBSERVATION,
    Channel,
)
from test.nodes.conftest import Graph, own_context
from test.shared import known

pytestmark = pytest.mark.whole_graph


@pytest.fixture(scope="module")
def pose_bag(tmp_path_factory: pytest.TempPathFactory, straight_pull: ReferenceTrajectory) -> Path:
    """Return a bag of poses of two seconds."""
    path = tmp_path_factory.mktemp("poses") / "pull"
    render_bag(straight_pull, read_setup("petri_35mm_polyamide"), path, pose_noise=1e-5)
    return path


def test_a_bag_is_replayed_judged_and_recorded_as_offline(short_bag: Path, tmp_path: Path):
    shares: list[float] = []
    summary = replay_live(short_bag, tmp_path / "out", progress=shares.append)
    assert "straight_pull" in summary.simulated
    assert (summary.frames, summary.tracked, summary.predicted) == (30, 28, 28)  # the first in the third frame
    assert summary.commands == 30
    assert summary.driven > 0  # all of them, unless the machine is so loaded that the watchdog bites
    assert known(summary.error_truth)["maximum"] < 1.0
    assert {margin.kind for margin in summary.least_margins} == {"connectivity", "compression", "wall"}
    assert summary.residual < 1e-5
    assert all(spread is not None and spread.median > 0.0 for spread in summary.latency.values())
    assert set(summary.dropped.values()) == {0}
    assert shares[-1] == pytest.approx(1.0, abs=0.05)
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["tracked"] == 28
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["bag", "logs", "summary.json", "summary.png"]
    recorded = Bag(tmp_path / "out" / "bag")
    assert recorded.damage is None
    assert recorded.counts["/coils/currents"] >= 30
    # It was played in real time, not all at once, from the bag's beginning on.
    times = [record.time for record in recorded.records({"/thread/predicted"})]
    assert (times[-1] - times[0]) * 1e-9 > 0.5
    assert min(record.time for record in recorded.records(set(recorded.topics))) >= Bag(short_bag).start
    replay_offline(short_bag, tmp_path / "offline")
    agree(tmp_path / "out", tmp_path / "offline", predictions=28)


COMPARED = (NEEDLE_POSE, MEASURED_THREAD, THREAD_OBSERVATION, PREDICTED_THREAD, ESTIMATED_THREAD, MARGINS)


def agree(live: Path, offline: Path, predictions: int) -> None:
    """Check that both replays made the same of a bag, to the last bit; but for the times that steps took."""
    made = [content(live), content(offline)]
    for channel in COMPARED:
        ours, theirs = ({key: what for key, what in each.items() if key[0] == channel} for each in made)
        assert ours == theirs
    assert sum(key[0] == PREDICTED_THREAD for key in made[0]) == predictions
    assert sum(key[0] == ESTIMATED_THREAD for key in made[0]) >= predictions


def content(output: Path) -> dict[tuple[Channel, int], bytes]:
    """Return what a replay said of each stamp, without times and without what waited for the thread to be seen."""
    bag, store = Bag(output / "bag"), typestore()
    found = {}
    for channel in COMPARED:
        for each in bag.records({channel.recorded}):
            message = each.decode()
            if channel == PREDICTED_THREAD:
                message.step_time = 0.0
            if channel != MARGINS or message.valid:
                stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                found[channel, stamp] = bytes(store.serialize_cdr(message, channel.type_name))
    return found


def test_time_stands_still_when_asked_and_goes_round_until_interrupted(pose_bag: Path, tmp_path: Path):
    with running("replay", pose_bag, "--output", "out", "--loop", cwd=tmp_path) as command:
        domain = int(command.find(r"to pause.*ROS_DOMAIN_ID=(\d+)"))
        service = command.find(r"to pause.* ros2 service call (\S+) ")
        with own_context(domain) as context, closing(Graph(context, domain)) as graph:
            clocks, predicted = graph.listen(topics.CLOCK), graph.listen(topics.PREDICTED_THREAD)
            client = graph.probe.create_client(SetBool, service)
            graph.wait(lambda: client.service_is_ready() and bool(clocks), "the replay")

            def pause(still: bool) -> int:
                future = client.call_async(SetBool.Request(data=still))
                graph.wait(future.done, "an answer")
                time.sleep(0.2)  # what was said before the answer
                return nanoseconds(clocks[-1].clock)

            def went_back() -> bool:
                stamps = [nanoseconds(message.header.stamp) for message in list(predicted)]
                return len(stamps) > 1 and stamps[-1] < max(stamps)

            stood = pause(True)
            time.sleep(0.5)
            assert nanoseconds(clocks[-1].clock) == stood
            pause(False)
            graph.wait(lambda: nanoseconds(clocks[-1].clock) > stood, "time to go on")
            command.find("(playing on until Ctrl-C)")
            assert not (tmp_path / "out").exists()
            graph.wait(went_back, "the second pass", 90.0)
        assert (command.end(), command.errors.read_text()) == (0, "")
        assert "results: out" in command.output.read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["predicted"] == 60
    assert not (tmp_path / "out" / "logs" / "vision_tracker.log").exists()  # poses need no tracker
    replay_offline(pose_bag, tmp_path / "offline")
    agree(tmp_path / "out", tmp_path / "offline", predictions=60)


def test_a_bag_that_is_too_short_for_a_loop_is_refused_before_anything_is_written(short_bag: Path, tmp_path: Path):
    with pytest.raises(BagError, match=r"gives 0\.97 s to play over and over; expected 1\.5 s or more"):
        replay_live(short_bag, tmp_path / "out", loop=True)
    assert not (tmp_path / "out").exists()


def test_a_replay_that_is_terminated_ends_its_nodes_and_leaves_nothing(tmp_path: Path):
    example = Path(__file__).parents[2] / "examples" / "post_wrap"
    with running("replay", example, "--output", "out", cwd=tmp_path) as command:
        command.find("(^playing)")
        pid = command.process.pid
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        assert len(children) == 2  # tracker and model are in one
        assert command.end(signal.SIGTERM) == 1
        errors = command.errors.read_text()
    assert "interrupted" in errors
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []
    assert not any(Path(f"/proc/{child}").exists() for child in children)
