"""Draws random mutants of the core packages, and judges each by the tests of its field that run what is mutated.

cosmic-ray makes the mutants. It does not run them, as it has one test command for all of them and draws none at random;
mutmut wraps functions in what numba cannot compile. Run it by a Python that has `cosmic-ray` installed:

    python .ci/mutants.py coils --seed 1 --count 100

All tests of the field are run once to find which of them runs which line. A mutant is then judged by those of its
statement, fast ones first, until one fails or they have taken --budget, in a fork of a process that has imported
everything (`.ci/mutant_judge.py`); one that no test runs survives. Tests in a browser are left out.

Mutants are made in a copy of the tracked files. With --compiled they are of modules with compiled functions, else of
those without. All runs as Python then (NUMBA_DISABLE_JIT=1), as each mutant would compile all kernels anew: up to a
hundred times slower, and a division by zero warns, which is no failure.
"""

from __future__ import annotations

import argparse
import ast
import itertools
import json
import math
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

ROOT = Path(__file__).resolve().parent.parent
PYTHON = ROOT / ".venv" / "bin" / "python"
# Of each field the tests that follow those of the module's own name.
TESTS = {
    "coils": ["test/coils"],
    "geometry": ["test/geometry", "test/scene"],
    "model": ["test/model", "test/forecast"],
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


def innermost_lines(text: str, line: int) -> range:
    """Return the lines of the statement at a line: of one with a body, those of its head."""
    best = range(line, line + 1)
    width = math.inf
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.stmt | ast.ExceptHandler | ast.match_case):
            body = getattr(node, "body", None)
            first = getattr(node, "lineno", None) or node.pattern.lineno  # type: ignore[union-attr]
            last = max(first, body[0].lineno - 1) if body else node.end_lineno  # type: ignore[union-attr]
            if first <= line <= last and last - first < width:
                best, width = range(first, last + 1), last - first
    return best


def tests_of(lines: dict[str, Any], mutant: dict[str, Any], budget: float) -> tuple[list[str], bool]:
    """Return the tests that run the statement of a mutant, fast ones first, and whether it runs on import.

    Where it runs on import, as a constant, these are the tests that run anything of its module.
    """
    ran = lines["lines"].get(mutant["path"], {})
    contexts = {test for line in innermost_lines(mutant["code"], mutant["line"]) for test in ran.get(str(line), ())}
    imported = "import" in contexts
    if imported:
        contexts = {test for tests in ran.values() for test in tests}
    order = {test: place for place, test in enumerate(lines["cost"])}
    cost = lines["cost"]
    tests = sorted(contexts - {"import"}, key=lambda test: (math.log2(max(cost[test], 0.02)) // 1, order[test]))
    total = list(itertools.accumulate(cost[test] for test in tests))
    return [test for test, until in zip(tests, total, strict=True) if until - cost[test] < budget], imported


def draw(fields: list[str], compiled: bool, seed: int) -> Iterator[dict[str, Any]]:
    """Draw mutants of the modules of fields, in an order that the seed gives."""
    generator = random.Random(seed)
    modules = [path for field in fields for path in (ROOT / "magnetosuture_thread" / field).rglob("*.py")]
    modules = [path for path in modules if ("magnetosuture_thread.compiled" in path.read_text()) == compiled]
    found = {path: sites(path) for path in sorted(modules)}
    drawn = [(path, place) for path in found for place in sorted(found[path])]
    generator.shuffle(drawn)
    for number, (path, place) in enumerate(drawn):
        operator, occurrence = generator.choice(found[path][place])
        code = path.read_text()
        mutated = mutate_code(code, get_operator(operator)(), occurrence)
        if mutated is None or meaning(mutated) == meaning(code):
            continue
        relative = str(path.relative_to(ROOT))
        text = f"{relative}:{place[0]} {operator[5:]}: {mutated.splitlines()[place[0] - 1].strip()}"
        yield {"number": number, "path": relative, "line": place[0], "code": code, "mutated": mutated, "text": text}


def copy_tree(tree: Path) -> None:
    """Copy all files that git knows, and the kernels that are compiled."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True)
    kernels = (ROOT / "magnetosuture_thread").rglob("__pycache__/*.nb[ic]")
    stamp = ROOT / "magnetosuture_thread" / "__pycache__" / "kernels.stamp"
    files = [ROOT / file for file in filter(None, listed.stdout.split("\0"))] + [*kernels, stamp]
    for file in files:
        copy = tree / file.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(file, copy, follow_symlinks=False)


def main() -> int:
    """Draw mutants, judge them, print each and how many were caught."""
    parser = argparse.ArgumentParser(description="Draws random mutants and judges them by the tests of their field.")
    parser.add_argument("fields", nargs="+", choices=sorted(TESTS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--only", type=int, nargs="*", help="numbers, in the draw, of those to judge; all by default")
    parser.add_argument("--limit", type=float, default=60.0, help="s; tests that take longer are left out")
    parser.add_argument("--budget", type=float, default=120.0, help="s of tests for a mutant")
    parser.add_argument("--compiled", action="store_true")
    parser.add_argument("--output", type=Path, default=Path("output/mutants.jsonl"), help="verdicts, one a line")
    parser.add_argument("--lines", type=Path, help="where it is kept which test runs which line; made if it is missing")
    parser.add_argument("--verbose", action="store_true", help="show what pytest says")
    options = parser.parse_args()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory() as name:
        tree, site = Path(name) / "tree", Path(name) / "site"
        copy_tree(tree)
        site.mkdir()
        (site / "sitecustomize.py").write_text(WITHOUT_EDITABLE)
        shutil.copy2(Path(__file__).parent / "mutant_judge.py", site)
        environment = {
            **os.environ,
            "PYTHONPATH": f"{site}:{tree}",
            "NUMBA_DISABLE_JIT": str(int(options.compiled)),
            "MUTANT_TREE": str(tree),
            "MUTANT_LINES": str((options.lines or Path(name) / "lines.json").resolve()),
            "MUTANT_LIMIT": str(options.limit),
            "MUTANT_VERDICTS": str(options.output.resolve()),
        }
        pytest = ["-q", "-p", "no:cacheprovider", "--ignore-glob=*/test_page*.py", f"--basetemp={name}/temporary"]
        pytest += ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # libraries are imported before it starts
        pytest += ["-W", "ignore::RuntimeWarning"] * options.compiled
        tests = [test for field in options.fields for test in TESTS[field] if (ROOT / test).exists()]

        def run(command: list[str], **more: str) -> None:
            output = None if options.verbose else subprocess.DEVNULL
            subprocess.run([str(PYTHON), *command], cwd=tree, env={**environment, **more}, stdout=output, check=False)

        begin = time.monotonic()
        kept = Path(environment["MUTANT_LINES"])
        if not kept.exists():
            run(["-m", "pytest", "-p", "mutant_judge", *pytest, *tests])
        lines = json.loads(kept.read_text())
        print(f"{len(lines['cost'])} tests in {time.monotonic() - begin:.0f} s; without {lines['failed']}", flush=True)
        drawn: list[dict[str, Any]] = []
        for mutant in itertools.islice(draw(options.fields, options.compiled, options.seed), options.count):
            if options.only is not None and mutant["number"] not in options.only:
                continue
            mutant["tests"], mutant["anew"] = tests_of(lines, mutant, options.budget)
            mutant["timeout"] = 30.0 + 4.0 * sum(lines["cost"][test] for test in mutant["tests"])
            drawn.append(mutant)
        left = [mutant for mutant in drawn if mutant["tests"]]
        for anew, command in [
            (False, ["-m", "pytest", "-p", "mutant_judge", *pytest, *tests]),
            (True, [str(site / "mutant_judge.py"), *pytest]),
        ]:
            now = [mutant for mutant in left if anew or not mutant["anew"]]
            (Path(name) / "mutants.json").write_text(json.dumps(now))
            run(command, MUTANTS=f"{name}/mutants.json", PYTHONDONTWRITEBYTECODE="1")
            judged = {verdict["number"] for verdict in verdicts(options.output)}
            left = [mutant for mutant in left if mutant["number"] not in judged]
    by = {verdict["number"]: verdict for verdict in verdicts(options.output)}
    caught = sum(bool(by[number]["caught"]) for number in by)
    for mutant in drawn:
        verdict = by.get(mutant["number"], {"caught": None, "by": "no test runs it"})
        print(f"{'caught  ' if verdict['caught'] else 'SURVIVED'} {mutant['text']}  [{verdict['by']}]")
    if left:
        print(f"{len(left)} were not judged: {[mutant['text'] for mutant in left]}")
    print(f"{caught} of {len(drawn) - len(left)} mutants caught (seed {options.seed})")
    return 0


def verdicts(path: Path) -> list[dict[str, Any]]:
    """Return the verdicts in a file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


if __name__ == "__main__":
    sys.exit(main())
