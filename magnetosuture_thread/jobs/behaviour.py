"""The job `magnetosuture behaviour`: the thread-behaviour tests, by material, with a table and a picture."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from magnetosuture_thread.bags.reader import Bag
from magnetosuture_thread.errors import BagError
from magnetosuture_thread.interface import COMPRESSED_IMAGE
from magnetosuture_thread.jobs.output import whole_folder
from magnetosuture_thread.jobs.simulate import judge, simulate
from magnetosuture_thread.setups import Setup, read_setup
from magnetosuture_thread.study.behaviour_picture import Run, chosen_instants, draw_behaviour
from magnetosuture_thread.vision.images import decode_image

TESTS = ("petri_35mm_polyamide", "petri_150mm_silk")

Say = Callable[[str], None]
Progress = Callable[[float], None]


def behaviour(
    output: Path,
    scenarios: Sequence[str] = TESTS,
    *,
    say: Say = lambda text: None,
    progress: Progress = lambda share: None,
) -> list[Run]:
    """Run each scenario in a closed loop and put prediction, what was seen, and truth side by side.

    `output` is made at the end, whole or not at all: a bag for each scenario, `behaviour.json` and
    `behaviour.png`.

    Args:
        output: folder to make.
        scenarios: names or paths of set-ups with a path for the needle.
        say: called with a line for a person at each stage.
        progress: called with the share done, 0 to 1.

    Raises:
        BagError: the output exists or cannot be written, or a run holds no prediction.
        ConfigurationError: a scenario cannot be used.
        GraphError: a node ended or did not come.
    """
    setups = [read_setup(scenario) for scenario in scenarios]
    with whole_folder(output) as folder:
        runs = []
        for index, setup in enumerate(setups):
            say(setup.name)
            simulate(
                str(setup.path),
                folder / setup.name,
                say=say,
                progress=_part(progress, index, len(setups)),
            )
            runs.append(_judged(folder / setup.name, setup))
        figures = [run.summary.to_json() for run in runs]
        (folder / "behaviour.json").write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        draw_behaviour(folder / "behaviour.png", runs)
    return runs


def _part(progress: Progress, index: int, count: int) -> Progress:
    """Return what reports the progress of one of several parts."""
    return lambda share: progress((index + share) / count)


def _judged(path: Path, setup: Setup) -> Run:
    """Return a run's figures and the frames to show."""
    bag = Bag(path)
    collector = judge(bag, setup)
    summary = collector.summary(setup.name)
    if not collector.instants:
        raise BagError(path, "holds no predicted thread")
    wanted = {instant.stamp for instant in chosen_instants(collector.instants)}
    frames = {}
    for record in bag.records({COMPRESSED_IMAGE.recorded}):
        message = record.decode()
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        if stamp in wanted:
            frames[stamp] = decode_image(message.data)
    model = setup.model
    material = model.material.replace("_", " ", 1).replace("_", "-")
    return Run(
        name=f"{material}, {1e3 * model.thread_length:g} mm, {model.segments} segments, "
        f"{model.attachment} to the needle, dish of {1e3 * setup.scene.dish.diameter:g} mm",
        summary=summary,
        instants=collector.instants,
        frames=frames,
        view=setup.rig.view(setup.scene),
        dish_diameter=setup.scene.dish.diameter,
        obstacles=setup.scene.obstacles,
    )
