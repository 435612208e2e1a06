"""The command `magnetosuture evaluate`."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path

from magnetosuture_thread.cli.arguments import add_source, number_argument, output_file, segments, whole_number
from magnetosuture_thread.cli.command import DONE, Subparsers, command
from magnetosuture_thread.cli.terminal import make_console, make_log, progress, write_json

DESCRIPTION = """\
Score the thread model: on bags, or on reference trajectories; not on both in one call.

Bags: each is predicted without a graph, as fast as the machine can, and held against the seen centreline and, where
the bag holds it, the truth. PATH is an mcap or db3 file, the folder of a bag, or a folder of bags, which may be up to
two folders below. DIR, which must not exist, gets
  NAME.html    a page for each bag, which needs no network: plots to zoom, frames at the worst moments
  table.csv    a row for each bag, SI units and %
  table.json   the same, with mean and worst
A bag that cannot be evaluated has its row too, with the problem in it; the exit code is 1 then.

Reference trajectories: files DIR/*.npz with the needle's poses and the thread that followed (arrays t, pose, X and
meta, as for `render`). The model starts from the first thread, is driven by the poses and nothing else, with each
file's own thread and parameters, and is compared at every sample.

Errors are mean distances of the nodes in % of the thread's length.
"""

FAILED = 1
OF_BAGS: dict[str, object] = {
    "output": None,
    "setup": "",
    "against": "auto",
    "source": "auto",
    "remap": [],
    "frame": "dish",
    "start": 0.0,
    "duration": None,
    "workers": 1,
}
OF_REFERENCES = {"solver": None, "segments": None, "rig": False, "json": None, "pictures": None}


def add(subparsers: Subparsers) -> None:
    """Add the command."""
    parser = command(subparsers, "evaluate", "score the model on bags, or on reference trajectories", DESCRIPTION, run)
    parser.add_argument("paths", type=Path, nargs="+", metavar="PATH", help="bags, or trajectories; see above")
    # The model's own words, written out: asking the model for them would be slow.
    parser.add_argument(
        "--formulation", choices=("rod", "paper"), help="how a step is written (default: a bag's set-up's; rod)"
    )
    bags = parser.add_argument_group("bags")
    bags.add_argument("--output", type=Path, metavar="DIR", help="folder to make; required")
    bags.add_argument(
        "--setup", default="", metavar="NAME", help="a set-up's name or YAML file (default: the one each bag names)"
    )
    bags.add_argument(
        "--against",
        choices=("auto", "truth", "seen"),
        default="auto",
        help="what predictions are held against (default: both where present, the worst moments by the truth)",
    )
    add_source(bags)
    bags.add_argument(
        "--start", type=number_argument(0.0, 1e9), default=0.0, metavar="S", help="seconds into each bag to begin at"
    )
    bags.add_argument(
        "--duration", type=number_argument(0.0, 1e9), metavar="S", help="seconds (default: to each bag's end)"
    )
    bags.add_argument("--workers", type=_workers, default=1, metavar="N", help="processes (default: 1)")
    references = parser.add_argument_group("reference trajectories")
    references.add_argument("--solver", choices=("banded", "osqp"), help="what solves a step (default: banded)")
    references.add_argument(
        "--segments", type=segments, metavar="N", help="number of segments (default: the paper's, as each file says)"
    )
    references.add_argument(
        "--rig", action="store_true", help="score the simulated rig's thread instead of the model (default: N = 100)"
    )
    references.add_argument("--json", type=output_file, metavar="FILE", help="write the figures to a file")
    references.add_argument("--pictures", type=Path, metavar="FOLDER", help="draw each case into a folder")


def _workers(text: str) -> int:
    count = whole_number(text)
    if not 1 <= count <= 256:
        raise argparse.ArgumentTypeError(f"{text!r} is no number of processes from 1 to 256")
    return count


def run(options: argparse.Namespace) -> int:
    """Score the model on bags, or the model or the simulated rig on reference trajectories."""
    from magnetosuture_thread.jobs.evaluate import kind_of

    if kind_of(options.paths) == "bags":
        _refuse(options, OF_REFERENCES, "only for reference trajectories; PATH is none")
        return _evaluate_bags(options)
    _refuse(options, OF_BAGS, "only for bags; PATH is a reference trajectory")
    return _score_references(options)


def _refuse(options: argparse.Namespace, unset: Mapping[str, object], why: str) -> None:
    from magnetosuture_thread.errors import ConfigurationError

    for name, value in unset.items():
        given = getattr(options, name)
        if given != value:
            raise ConfigurationError(f"--{name}", str(given), f"nothing: it is {why}")


def _evaluate_bags(options: argparse.Namespace) -> int:
    from magnetosuture_thread.errors import ConfigurationError
    from magnetosuture_thread.evaluation.tables import bags_table
    from magnetosuture_thread.jobs.evaluate import evaluate_bags
    from magnetosuture_thread.jobs.evaluate_bag import Options

    if options.output is None:
        raise ConfigurationError("--output", None, "a folder to make, as PATH is a bag")
    given = Options(
        setup=options.setup,
        against=options.against,
        source=options.source,
        remap=tuple(options.remap),
        frame=options.frame,
        formulation=options.formulation or "",
        start=options.start,
        duration=options.duration,
    )
    console = make_console()
    log = make_log(console)
    with progress(console, "evaluate") as advance:
        rows = evaluate_bags(options.paths, options.output, given, workers=options.workers, log=log, progress=advance)
    console.print(bags_table(rows))
    log(f"results: {options.output}")
    return FAILED if any(row["problem"] for row in rows) else DONE


def _score_references(options: argparse.Namespace) -> int:
    from magnetosuture_thread.evaluation.plots import draw_case
    from magnetosuture_thread.evaluation.reference_scores import CaseResult, find_references, score
    from magnetosuture_thread.evaluation.tables import evaluation_table
    from magnetosuture_thread.jobs.rig import score_rig

    console = make_console()
    paths = [path for folder in options.paths for path in find_references(folder)]
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)

    formulation = options.formulation or "rod"
    name = "rig" if options.rig else formulation

    def keep(case: CaseResult) -> None:
        if options.pictures:
            draw_case(options.pictures / f"{case.score.name}.png", case, name)

    with progress(console, "evaluate") as advance:
        if options.rig:
            evaluation = score_rig(paths, options.segments, advance, keep)
        else:
            evaluation = score(
                paths,
                formulation=formulation,
                solver=options.solver or "banded",
                segments=options.segments,
                progress=advance,
                keep=keep,
            )
    console.print(evaluation_table(evaluation))
    write_json(options.json, evaluation.to_mapping())
    return DONE
