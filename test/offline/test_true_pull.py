"""The true pull upon the needle in a bag: read beside the pose of its stamp, and refused where it is none."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.bags.recording import Recording
from magnetosuture_thread.bags.writer import BagWriter
from magnetosuture_thread.interface import GROUND_TRUTH_PULL, NEEDLE_POSE
from magnetosuture_thread.messages.packing import packed_pose, packed_wrench
from magnetosuture_thread.offline.observations import ObservationReader
from magnetosuture_thread.setups import read_setup


def test_the_true_pull_comes_with_the_pose_of_its_stamp(tmp_path: Path):
    stamps = [k * 10**8 for k in range(1, 5)]
    with BagWriter(tmp_path / "bag", {}) as bag:
        for channel in (NEEDLE_POSE, GROUND_TRUTH_PULL):
            bag.add_topic(channel.recorded, channel.type_name)
        for k, stamp in enumerate(stamps):
            pose = packed_pose(stamp, np.zeros(2), np.array([1.0, 0.0]))
            bag.write(NEEDLE_POSE.recorded, stamp, pose)
            pull = packed_wrench(stamp, np.array([1e-6 * k, math.nan if k == 1 else -2e-6]), 3e-9)
            if k == 2:
                pull = pull.replace(b"dish", b"else")
            if k < 3:
                bag.write(GROUND_TRUTH_PULL.recorded, stamp, pull)
    reader = ObservationReader(
        Recording(Bag(tmp_path / "bag")), read_setup("petri_35mm_polyamide"), "poses", 0.0, None, lambda share: None
    )
    first, *others = reader
    assert first.true_pull == pytest.approx([0.0, -2e-6])
    assert [len(each.true_pull) for each in others] == [0, 0, 0]
    assert sum("thread_pull" in why for why in reader.refused) >= 1
    assert [each.stamp for each in (first, *others)] == stamps
