"""Fit the stiffness of a thread to a recorded run, and write it as parameters of the node `thread_model`.

The bag holds simulated camera frames and the motion of a needle that draws its thread around a post.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

from magnetosuture_thread import calibrate_bags

BAG = Path(__file__).parent / "post_wrap"

with TemporaryDirectory() as folder:
    parameters = Path(folder) / "thread.yaml"
    result = calibrate_bags([BAG], parameters, parameters=["elastic_modulus"], log=print)
    print(parameters.read_text())

for estimate in result.estimates:
    print(f"{estimate.name}: {estimate.value:.3g} {estimate.unit}, {estimate.status}")
    print(f"95 % interval: {estimate.low:.3g} to {estimate.high:.3g}")
