"""The table of a benchmark, for a terminal, and the figures that follow from it."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby

from rich.table import Table

from benchmarks.solver.measurements import SolverReport, SolverRow

SAME_RESIDUAL = 1e-7  # solvers that reach it are compared with the banded one, which reaches 1e-8
MIN_SEGMENTS = 81  # segments; below it, what a call costs by itself hides what a segment costs
STEP, SOLVE = "rod step, banded", "rod solve, banded"


def solver_table(report: SolverReport) -> Table:
    """Return the rows as a table, systems of the same size together."""
    table = Table(title="one step, one solve, one pose sample", title_justify="left", title_style="bold")
    table.add_column("system", no_wrap=True)
    for name in ("n", "d", "obst.", "median", "p99", "ratio", "residual"):
        table.add_column(name, justify="right", no_wrap=True)
    table.caption = (
        "microseconds of wall clock; obst.: obstacles of 200 triangles each;\n"
        "ratio: p99 over median of CPU time; general solvers: without writing the\n"
        "program in their form, which takes 0.5 to 1.2 ms more"
    )
    table.caption_justify = "left"
    for _, group in groupby(sorted(report.rows, key=_place), key=_place):
        for row in group:
            table.add_row(
                row.system,
                str(row.n),
                str(row.d),
                str(row.obstacles),
                _microseconds(row.median_s),
                _microseconds(row.p99_s),
                f"{_spread(row):.1f}",
                "" if row.max_residual is None else f"{row.max_residual:.1e}",
            )
        table.add_section()
    return table


def solver_lines(report: SolverReport) -> list[str]:
    """Return what follows from the rows, a line each, and a line for each baseline that is missing."""
    rows = report.rows
    return [*_speed(rows), *_linearity(rows), *_steadiness(rows), *_contacts(rows), *_simulators(rows), *report.remarks]


def _place(row: SolverRow) -> tuple[bool, int, int, int]:
    """Where a row stands: simulators last, then by scene and size."""
    return "error_percent" in row.extra, row.d, row.obstacles, row.n


def _speed(rows: Iterable[SolverRow]) -> list[str]:
    """Compare the banded solve with the fastest general solver of the same programs."""
    lines = []
    for (_, d, obstacles, n), group in groupby(sorted(rows, key=_place), key=_place):
        same = [row for row in group if row.system.startswith("rod solve") and _reaches(row)]
        others = [row for row in same if row.system != SOLVE]
        own = [row for row in same if row.system == SOLVE]
        if own and others:
            best = min(others, key=lambda row: row.median_s)
            times = best.median_s / own[0].median_s
            lines.append(
                f"n = {n}, d = {d}, {obstacles} obstacles: banded is {times:.1f} times as fast as "
                f"{best.system.split(', ')[1]}, the fastest other with a residual below {SAME_RESIDUAL:g}"
            )
    return lines


def _linearity(rows: Iterable[SolverRow]) -> list[str]:
    """Give the time per segment, which is the same at all sizes if the method is linear."""
    lines = []
    kept = [row for row in rows if row.system in (STEP, SOLVE) and row.n >= MIN_SEGMENTS]
    for (system, d, obstacles), group in groupby(sorted(kept, key=_scene), key=lambda row: _scene(row)[:3]):
        sizes = list(group)
        each = ", ".join(f"{1e6 * row.median_s / row.n:.2f} at {row.n}" for row in sizes)
        line = f"{system}, d = {d}, {obstacles} obstacles: µs per segment {each}"
        if len(sizes) > 1:
            more = 1e6 * (sizes[-1].median_s - sizes[0].median_s) / (sizes[-1].n - sizes[0].n)
            line += f"; {more:.2f} for each further one"
        lines.append(line)
    return lines


def _steadiness(rows: Iterable[SolverRow]) -> list[str]:
    """Give the greatest ratio of CPU times."""
    lines = []
    for system in (STEP, SOLVE):
        of = [row for row in rows if row.system == system]
        if of:
            worst = max(of, key=_spread)
            lines.append(
                f"{system}: CPU p99/median at most {_spread(worst):.1f}, at n = {worst.n}, d = {worst.d}, "
                f"{worst.obstacles} obstacles"
            )
    return lines


def _contacts(rows: Iterable[SolverRow]) -> list[str]:
    """Say how often the thread touched an obstacle."""
    touched = [row for row in rows if row.obstacles and "contact_steps" in row.extra]
    shares = [float(row.extra["contact_steps"]) / float(row.extra["steps"]) for row in touched]
    return [f"the thread touches an obstacle in {min(shares):.0%} of the steps or more"] if shares else []


def _simulators(rows: Iterable[SolverRow]) -> list[str]:
    """Say how far a simulator's thread is from the rod's, and what it leaves out."""
    return [
        f"{row.system}, n = {row.n}: {float(row.extra['error_percent']):.2f} % of the length from the rod; "
        f"{row.extra['physics']}"
        for row in rows
        if "error_percent" in row.extra
    ]


def _scene(row: SolverRow) -> tuple[str, int, int, int]:
    return row.system, row.d, row.obstacles, row.n


def _reaches(row: SolverRow) -> bool:
    return row.max_residual is not None and row.max_residual <= SAME_RESIDUAL


def _spread(row: SolverRow) -> float:
    median = float(row.extra["cpu_median_s"])
    return float(row.extra["cpu_p99_s"]) / median if median > 0.0 else float("nan")


def _microseconds(seconds: float) -> str:
    return f"{1e6 * seconds:.1f}"
