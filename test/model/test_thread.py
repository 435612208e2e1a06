"""Materials and what follows from them."""

from __future__ import annotations

import pytest

from magnetosuture_thread.model.thread import MATERIALS, Attachment, Thread


@pytest.mark.parametrize(
    ("name", "length", "stiffness", "drag"),
    [
        # As the metadata of the reference trajectories has them.
        ("polyamide_7_0", 0.019, 1.2723450247038664e-09, 0.9739867229019283),
        ("silk_6_0", 0.15, 2.562392187699933e-10, 0.7691605593214224),
    ],
)
def test_stiffness_and_drag_are_those_of_the_reference_set(name: str, length: float, stiffness: float, drag: float):
    thread = Thread.of(MATERIALS[name], length=length, segments=25, attachment=Attachment.PINNED)
    assert thread.bending_stiffness == pytest.approx(stiffness, rel=1e-12)
    assert thread.medium.drag_across == pytest.approx(drag, rel=1e-12)
    assert thread.medium.drag_along == pytest.approx(0.5 * drag, rel=1e-12)
    assert thread.segment_length == pytest.approx(length / 25)
