"""The rig's thread, scored on a trajectory that is known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from magnetosuture_thread.evaluation.reference import score_rig
from magnetosuture_thread.settings.errors import BagError

MATERIAL = {
    "L_m": 0.02,
    "EI_Nm2": 1e-9,
    "EA_N": 5.0,
    "zeta_perp_Pa_s": 1.0,
    "zeta_par_Pa_s": 0.5,
    "diameter_m": 6e-5,
    "kind": "polyamide",
}
SPEED = 3e-3


def save(path: Path, *, aside: float = 0.0, **changes: object) -> Path:
    """Save a straight thread that is pulled lengthwise, the truth moved aside after the start [m]."""
    times = np.arange(67) / 66.0
    poses = np.column_stack([SPEED * times, 0.0 * times, 0.0 * times])
    threads = np.zeros((67, 101, 2))
    threads[:, :, 0] = poses[:, :1] - np.linspace(0.0, 0.02, 101)
    threads[1:, :, 1] = aside
    given = {"name": "pulled", "material": MATERIAL, "boundary": "pinned", "obstacle": None, **changes}
    np.savez(path, t=times, pose=poses, X=threads, meta=json.dumps(given))
    return path


def test_a_pulled_thread_follows_exactly(tmp_path: Path):
    told: list[float] = []
    kept: list[str] = []
    evaluation = score_rig(
        [save(tmp_path / "a.npz")], 20, told.append, lambda course: kept.append(course.reference.name)
    )
    case = evaluation.cases[0]
    assert (evaluation.formulation, case.name, kept) == ("rig", "pulled", ["pulled"])
    assert case.max_error_percent < 1e-3
    assert case.fallbacks == 0
    # Pulled by its own drag, half a segment less at the tail.
    assert case.max_stretch == pytest.approx(0.5 * 0.0195 * SPEED / 5.0, rel=1e-3)
    assert case.max_residual < 1e-6
    assert told[-1] < 1.0


@pytest.mark.parametrize(
    "changes", [{"boundary": "loose"}, {"material": {}}, {"material": {**MATERIAL, "EA_N": 0.0}}, {"material": None}]
)
def test_metadata_without_a_thread_are_refused(tmp_path: Path, changes: dict):
    with pytest.raises(BagError, match=r"a\.npz: has"):
        score_rig([save(tmp_path / "a.npz", **changes)])
