"""Count what one observed frame takes: from the tracker's callback to the published margins of the thread model.

Both nodes run in this process, as in the program `perception`. Counted are the files, functions and calls of this
package; comprehensions are parts of their functions, and what is compiled is not seen.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from benchmarks.report import figures_table
from magnetosuture_thread.commands.command import Terminal
from magnetosuture_thread.geometry.polyline import lay_behind_needle
from magnetosuture_thread.rig.camera import encode_jpeg
from magnetosuture_thread.rig.setups import read_setup

FRAMES = 20  # before the one that is counted, 33 ms apart
PACKAGE = str(Path(__file__).parents[1] / "magnetosuture_thread")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--list", action="store_true", help="show the functions with their calls")


def run(options: argparse.Namespace, terminal: Terminal) -> tuple[dict[str, Any], bool]:
    """Count one frame; return the figures, by folder and of all. There is no limit to pass."""
    calls = count_frame()
    figures: dict[str, Any] = {}
    for folder in (*sorted({file.partition("/")[0] for file, _ in calls}), ""):
        inside = {key: count for key, count in calls.items() if key[0].startswith(folder)}
        sums = {"files": len({file for file, _ in inside}), "functions": len(inside), "calls": sum(inside.values())}
        figures[folder or "all"] = sums
    for (file, function), count in sorted(calls.items()) if options.list else ():
        terminal.print(f"{count:6d}  {file}  {function}", soft_wrap=True)
    rows = [{"folder": folder, **sums} for folder, sums in figures.items()]
    names = ("folder", "files", "functions", "calls")
    terminal.print(figures_table("one frame", rows, {name: f"{{{name}}}" for name in names}))
    return figures, True


def count_frame() -> Counter[tuple[str, str]]:
    """Return how often each function is called for a frame, by file and name."""
    from rclpy.context import Context
    from rclpy.parameter import Parameter
    from sensor_msgs.msg import CompressedImage

    from magnetosuture_thread.nodes.parameters import init
    from magnetosuture_thread.nodes.perception import perception
    from magnetosuture_thread.nodes.processes import reserved_domain

    setup, calls = read_setup("petri_35mm_polyamide"), Counter[tuple[str, str]]()
    camera, length = setup.rig.camera(setup.scene), setup.model.thread_length

    def count(frame: FrameType, event: str, argument: object) -> None:
        file, name = frame.f_code.co_filename, frame.f_code.co_name
        if event == "call" and file.startswith(PACKAGE) and not (name.startswith("<") and name.endswith("comp>")):
            calls[file[len(PACKAGE) + 1 :], getattr(frame.f_code, "co_qualname", name)] += 1

    with reserved_domain() as domain:
        context = Context()
        init(["frame", "--ros-args", "--params-file", str(setup.path)], context, domain_id=domain)
        overrides = [Parameter("use_sim_time", value=False)]
        nodes = perception(context=context, parameter_overrides=overrides)
        for k in range(FRAMES + 1):
            tail, heading = np.array([0.002 + 1e-4 * k, 0.001]), np.array([1.0, 0.0])
            thread = lay_behind_needle(tail, heading, length, setup.scene.dish.radius)
            jpeg = encode_jpeg(camera.render(tail, 0.0, thread), 90)
            message = CompressedImage(format="jpeg", data=jpeg.tobytes())
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(10**9 + 33_000_000 * k, 10**9)
            sys.setprofile(count if k == FRAMES else None)
            nodes[0].on_image(message)
            sys.setprofile(None)
        for node in nodes:
            node.destroy_node()
        context.try_shutdown()
    return calls
