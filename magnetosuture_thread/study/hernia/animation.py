"""The simulated hernia repair as an animation."""

from __future__ import annotations

import math
from pathlib import Path

from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure

from magnetosuture_thread.evaluation.plots import FAINT
from magnetosuture_thread.study.hernia.run import HerniaRun
from magnetosuture_thread.study.hernia.scene import INK, caption, draw_dish, draw_thread

FASTER = 6  # than it happened
PICTURES = 8  # a second


def draw_animation(path: Path, run: HerniaRun) -> None:
    """Draw the run, faster than it happened, and write it as GIF.

    Args:
        path: of the file.
        run: what to draw.
    """
    figure = Figure(figsize=(4.6, 5.0), dpi=96, facecolor="white")
    count = math.floor(run.instants[-1].time / FASTER * PICTURES) + 1
    writer = PillowWriter(fps=PICTURES)
    with writer.saving(figure, str(path), 96):
        for k in range(count):
            instant = run.nearest(k * FASTER / PICTURES)
            figure.clear()
            axes = figure.add_axes((0.0, 0.0, 1.0, 0.9))
            draw_dish(axes, run.scene)
            draw_thread(axes, instant)
            figure.text(0.03, 0.955, caption(instant), fontsize=10.5, color=INK)
            words = f"{instant.time:.0f} s, shown {FASTER} times as fast; simulated, the thread model alone"
            figure.text(0.03, 0.915, words, fontsize=8, color=FAINT)
            writer.grab_frame()
