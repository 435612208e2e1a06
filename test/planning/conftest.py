"""A planner of the hernia's scene, which several tests share."""

from __future__ import annotations

import pytest

from magnetosuture_thread.planning.planner import NeedlePlanner
from magnetosuture_thread.rig.setups import Setup, read_setup


@pytest.fixture(scope="session")
def hernia() -> Setup:
    """Return the setup of the paper's hernia repair."""
    return read_setup("hernia_ring")


@pytest.fixture(scope="session")
def planner(hernia: Setup) -> NeedlePlanner:
    """Return a planner of its scene."""
    kinematics = hernia.coils.needle().kinematics
    return NeedlePlanner(hernia.scene, kinematics, hernia.coils.keep_out, hernia.model.thread_length)
