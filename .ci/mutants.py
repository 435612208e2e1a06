"""Draws random mutants of the core packages, and judges each by the tests of its field.

cosmic-ray makes the mutants. It does not run them, as it has one test command for all of them and draws none at random;
mutmut wraps functions in what numba cannot compile. Run it by a Python that has `cosmic-ray` installed:

    python .ci/mutants.py --seed 1 --minutes 25 coils safety

A mutant is made in a copy of the tracked files. With --compiled it is of a module with compiled functions, else of one
without. All runs as Python then (NUMBA_DISABLE_JIT=1), as each mutant would compile all kernels anew: up to a hundred
times slower, and a division by zero warns, which is no failure.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parent.parent
PYTHON = ROOT / ".venv" / "bin" / "python"
# Of each field the tests that follow those of the module's own name.
TESTS = {
    "coils": ["test/coils"],
    "geometry": ["test/geometry", "test/scene"],
    "safety": ["test/safety"],
    "console": ["test/console", "test/nodes/test_console.py"],
    "guidance": ["test/guidance"],
    "scene": ["test/scene"],
    "vision": ["test/vision"],
}
# Operators whose mutants are of the type that was there: the others end in a TypeError, which any test sees.
KINDS = re.compile(
    r"core/(ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|Mul_Add)|ReplaceComparisonOperator_(?!Is)\w+_(?!Is)\w+"
    r"|ReplaceUnaryOperator_(Delete_USub|Delete_Not)|AddNot|ReplaceTrueWithFalse|ReplaceFalseWithTrue|ReplaceAndWithOr"
    r"|ReplaceOrWithAnd|ReplaceBreakWithContinue|ReplaceContinueWithBreak|NumberReplacer|ZeroIterationForLoop)"
)
WITHOUT_EDITABLE = """import sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "ScikitBuildRedirecting" not in type(finder).__name__]
"""
TIMEOUT = 600.0  # s; a mutant that runs for longer is caught


def sites(path: Path) -> dict[tuple[int, int], list[tuple[str, int]]]:
    """Return by its place what can be mutated in a file: operators, and the number of their occurrence."""
    nodes = list(ast_nodes(get_ast(path.read_text())))
    found: dict[tuple[int, int], list[tuple[str, int]]] = {}
    for name in filter(KINDS.fullmatch, operator_names()):
        operator = get_operator(name)()
        places = [start for node in nodes for start, _ in operator.mutation_positions(node)]
        for occurrence, start in enumerate(places):
            found.setdefault(start, []).append((name, occurrence))
    return found


def meaning(code: str) -> str:
    """Return what a module does, as text: without docstrings and annotations."""
    tree = ast.parse(code)
    for node in ast.walk(tree):
        if isinstance(node, ast.arg | ast.AnnAssign):
            node.annotation = ast.Constant(None)
        if isinstance(node, ast.FunctionDef):
            node.returns = None
    return ast.dump(tree)


def tests_of(module: Path, field: str) -> list[list[str]]:
    """Return the tests of a module: first those of its own name, then all of its field."""
    own = [str(path.relative_to(ROOT)) for path in (ROOT / "test" / field).rglob(f"test_{module.stem}.py")]
    return [part for part in (own, [name for name in TESTS[field] if (ROOT / name).exists()]) if part]


def survives(tree: Path, environment: dict[str, str], tests: list[str]) -> bool:
    """Return whether tests pass in a tree."""
    options = ["-q", "-x", "-p", "no:cacheprovider", "-W", "ignore::RuntimeWarning", "-k", "not page and not firefox"]
    command = [str(PYTHON), "-m", "pytest", *options, *tests]
    try:
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, timeout=TIMEOUT, check=False)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def main() -> int:
    """Draw mutants until the time is over; print each, and how many were caught."""
    parser = argparse.ArgumentParser(description="Draws random mutants and judges them by the tests of their field.")
    parser.add_argument("fields", nargs="+", choices=sorted(TESTS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=25.0)
    parser.add_argument("--compiled", action="store_true")
    options = parser.parse_args()
    generator = random.Random(options.seed)
    modules = [path for field in options.fields for path in (ROOT / "magnetosuture_thread" / field).rglob("*.py")]
    modules = [path for path in modules if ("magnetosuture_thread.compiled" in path.read_text()) == options.compiled]
    drawn = [(path, place) for path in sorted(modules) for place in sorted(sites(path))]
    generator.shuffle(drawn)
    caught = survived = 0
    end = time.monotonic() + 60.0 * options.minutes
    with tempfile.TemporaryDirectory() as name:
        tree, site = Path(name) / "tree", Path(name) / "site"
        listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
        for file in filter(None, listed.stdout.split("\0")):
            (tree / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / file, tree / file, follow_symlinks=False)
        site.mkdir()
        (site / "sitecustomize.py").write_text(WITHOUT_EDITABLE)
        environment = {**os.environ, "PYTHONPATH": f"{site}:{tree}", "NUMBA_DISABLE_JIT": str(int(options.compiled))}
        for path, place in drawn:
            if time.monotonic() > end:
                break
            operator, occurrence = generator.choice(sites(path)[place])
            code, relative = path.read_text(), path.relative_to(ROOT)
            mutated = mutate_code(code, get_operator(operator)(), occurrence)
            if mutated is None or meaning(mutated) == meaning(code):
                continue
            (tree / relative).write_text(mutated)
            field = relative.parts[1]
            alive = all(survives(tree, environment, tests) for tests in tests_of(path, field))
            (tree / relative).write_text(code)
            caught, survived = caught + (not alive), survived + alive
            line = mutated.splitlines()[place[0] - 1].strip()
            print(f"{'SURVIVED' if alive else 'caught  '} {relative}:{place[0]} {operator[5:]}: {line}", flush=True)
    print(f"{caught} of {caught + survived} mutants caught (seed {options.seed})")
    return 0


if __name__ == "__main__":
    sys.exit(main())
