"""Predict the thread of a recorded run without a graph, and compare it with what the camera measured.

The bag holds simulated camera frames and the motion of a needle that draws its thread around a post.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from magnetosuture_thread import replay_offline

BAG = Path(__file__).parent / "post_wrap"

with TemporaryDirectory() as folder:
    # Writes a bag with poses, predictions and margins, their figures as JSON and a plot.
    summary = replay_offline(BAG, Path(folder) / "results", duration=4.0, log=print)
    print("written:", ", ".join(sorted(path.name for path in (Path(folder) / "results").iterdir())))

print(f"needle found in {summary.tracked} of {summary.frames} frames")
print(f"prediction error: {summary.error_seen['mean']:.2f} % of the length on average")
for margin in summary.least_margins:
    print(f"{margin.kind}: minimum {1e6 * margin.clearance:.1f} µm at node {margin.node}, {margin.time:.2f} s")
