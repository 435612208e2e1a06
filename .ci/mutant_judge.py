"""A pytest plugin that judges mutants in forks of one process, by the tests that run what is mutated.

`.ci/mutants.py` starts it in three ways. Without MUTANTS it runs all tests once, and writes which of them runs which
line and how long it takes. With MUTANTS all tests are collected, and for each mutant a fork replaces the code of the
mutated function and runs the tests of its lines. As a program it starts pytest anew for each mutant, in a fork that has
imported all libraries but not the package: for what runs while a module is imported, as constants and defaults do.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import shutil
import signal
import sys
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import pytest

IMPORTED = "import"
SURVIVED, CAUGHT, NOT_REPLACED, NOT_JUDGED = 0, 1, 3, 4  # how a fork ends
LIMIT = float(os.environ.get("MUTANT_LIMIT", "60"))  # s; a test that takes longer judges no mutant
TREE = Path(os.environ["MUTANT_TREE"])


class OverTime(BaseException):
    """A test took longer than LIMIT; no Exception, which hypothesis would try to shrink."""


class LineMap:
    """Which test runs which line of the package, directly or by a fixture that it shares with others."""

    def __init__(self) -> None:
        import coverage

        package = str(TREE / "magnetosuture_thread")
        self.coverage = coverage.Coverage(data_file=None, config_file=False, source=[package])
        self.coverage.start()
        self.coverage.switch_context(IMPORTED)
        self.seconds: dict[str, float] = {}
        self.shared: dict[str, float] = {}
        self.uses: dict[str, list[str]] = {}
        self.failed: set[str] = set()
        self.skipped: set[str] = set()
        self.modules: list[str] = []
        self.contexts: list[str] = []

    def pytest_collection_finish(self) -> None:
        """Keep which libraries are loaded; lines that run from now on are not those of imports."""
        # Of libraries alone: what is in the tree imports the package.
        loaded = [(name, getattr(module, "__file__", None) or "") for name, module in list(sys.modules.items())]
        self.modules = [name for name, file in loaded if file and not Path(file).is_relative_to(TREE)]
        self.coverage.switch_context("")

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Run a test under its name."""
        self.contexts = [item.nodeid]
        self.coverage.switch_context(item.nodeid)
        begin = time.monotonic()
        yield
        self.seconds[item.nodeid] = time.monotonic() - begin
        self.coverage.switch_context("")
        definitions = item._fixtureinfo.name2fixturedefs.values()  # type: ignore[attr-defined]
        self.uses[item.nodeid] = [name for [*_, one] in definitions if (name := fixture_name(one)) in self.shared]

    @pytest.hookimpl(hookwrapper=True)
    def pytest_runtest_call(self) -> Iterator[None]:
        """Let a test run for LIMIT at most."""

        def end(*_: object) -> None:
            raise OverTime

        signal.signal(signal.SIGALRM, end)
        signal.setitimer(signal.ITIMER_REAL, LIMIT)
        outcome = yield
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        if isinstance(outcome.exception, OverTime):
            # Without its traceback: one that a signal made may have a place without a line, which ends pytest.
            outcome.force_exception(pytest.fail.Exception("over time", pytrace=False))

    @pytest.hookimpl(hookwrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """Set up a fixture; under its own name where tests share it."""
        if fixturedef.scope == "function":
            yield
            return
        name, begin = fixture_name(fixturedef), time.monotonic()
        self.contexts.append(name)
        self.coverage.switch_context(name)
        yield
        self.contexts.pop()
        self.coverage.switch_context(self.contexts[-1])
        self.shared[name] = time.monotonic() - begin

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep which tests fail or are skipped without any mutant: they judge none."""
        if report.failed:
            self.failed.add(report.nodeid)
        if report.skipped:
            self.skipped.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        """Write tests with their cost, the lines that each runs, and what failed without any mutant."""
        self.coverage.stop()
        data = self.coverage.get_data()
        users = defaultdict(list)
        for test, names in self.uses.items():
            for name in names:
                users[name].append(test)
        usable = set(self.seconds) - self.failed - self.skipped
        lines: dict[str, dict[int, list[str]]] = {}
        for file in data.measured_files():
            here = lines[str(Path(file).relative_to(TREE))] = {}
            for line, contexts in data.contexts_by_lineno(file).items():
                tests = {test for context in contexts for test in [context, *users[context]]}
                here[line] = sorted(tests & usable) + [IMPORTED] * (IMPORTED in contexts)
        cost = {test: self.seconds[test] + sum(map(self.shared.get, self.uses[test])) for test in usable}
        found = {"cost": cost, "lines": lines, "modules": self.modules, "failed": sorted(self.failed)}
        Path(os.environ["MUTANT_LINES"]).write_text(json.dumps(found))


def fixture_name(definition: Any) -> str:
    """Return the name of a fixture as a context."""
    return f"fixture {definition.baseid}::{definition.argname}"


def functions_of(code: CodeType) -> Iterator[CodeType]:
    """Return the code of all functions in a code, nested ones too."""
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from functions_of(constant)


def replace_code(path: Path, mutated: str) -> bool:
    """Give all functions of an imported module their code in a mutated text; return whether that was possible."""
    codes: dict[tuple[str, int], list[CodeType]] = defaultdict(list)
    for code in functions_of(compile(mutated, str(path), "exec", dont_inherit=True)):
        codes[code.co_name, code.co_firstlineno].append(code)
    replaced = False
    for function in [thing for thing in gc.get_objects() if isinstance(thing, FunctionType)]:
        old = function.__code__
        if old.co_filename != str(path):
            continue
        new = codes[old.co_name, old.co_firstlineno]
        if len(new) != 1 or new[0].co_freevars != old.co_freevars:
            return False
        if new[0] != old:
            function.__code__ = new[0]
            replaced = True
    return replaced


def in_fork(run: Callable[[int], int], timeout: float) -> tuple[int, str]:
    """Run a function in a fork, in a process group of its own; return how it ended and what it wrote to its pipe."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.setsid()
        os.close(reader)
        status = NOT_JUDGED  # where the judge itself fails, which is no test that does
        try:
            status = run(writer)
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(writer)
    end, status = time.monotonic() + timeout, None
    while status is None and time.monotonic() < end:
        ended, how = os.waitpid(child, os.WNOHANG)
        status = how if ended else None
        time.sleep(0.005)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # with all that the tests have started
    if status is None:
        os.waitpid(child, 0)
    with os.fdopen(reader, "rb") as stream:  # at its end now, as nobody is left who could write
        said = stream.read().decode()
    return (CAUGHT, "timeout") if status is None else (os.waitstatus_to_exitcode(status), said)


@contextlib.contextmanager
def written(path: Path, text: str) -> Iterator[None]:
    """Have a text in a file for a time: for processes that tests start."""
    kept = path.with_suffix(".kept")
    shutil.copy2(path, kept)
    path.write_text(text)
    try:
        yield
    finally:
        kept.replace(path)


class Judge:
    """Judges mutants of functions, in forks of the process that has collected all tests."""

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Keep the tests by their names."""
        self.items = {item.nodeid: item for item in items}

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Judge all mutants in place of running the tests."""
        judge_all(lambda mutant, writer: self.run(session, mutant, writer))
        return True

    def run(self, session: pytest.Session, mutant: dict[str, Any], writer: int) -> int:
        """Replace the code of a mutated function and run the tests of its lines; return how the fork ends."""
        items = [self.items[name] for name in mutant["tests"]]  # a name of a test that is no more: not judged
        if not replace_code(TREE / mutant["path"], mutant["mutated"]):
            return NOT_REPLACED
        for item, following in zip(items, [*items[1:], None], strict=True):
            session.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if session.testsfailed:
                os.write(writer, item.nodeid.encode())
                return CAUGHT
        return SURVIVED


def judge_all(run: Callable[[dict[str, Any], int], int]) -> None:
    """Judge each mutant by a function in a fork; write its verdict as a line of JSON."""
    mutants = json.loads(Path(os.environ["MUTANTS"]).read_text())
    with Path(os.environ["MUTANT_VERDICTS"]).open("a") as verdicts:
        for mutant in mutants:
            begin = time.monotonic()
            with written(TREE / mutant["path"], mutant["mutated"]):
                status, by = in_fork(partial(run, mutant), mutant["timeout"])
            if status == NOT_REPLACED:
                continue  # pytest has to start anew for it
            caught, by = status not in (SURVIVED, NOT_JUDGED), "not judged" if status == NOT_JUDGED else by
            verdict = {"number": mutant["number"], "text": mutant["text"], "caught": caught, "by": by}
            verdicts.write(json.dumps({**verdict, "seconds": round(time.monotonic() - begin, 2)}) + "\n")
            verdicts.flush()


class FirstFailure:
    """Writes the name of a test that fails to a pipe."""

    def __init__(self, writer: int) -> None:
        self.writer = writer

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Write the name of a test that failed."""
        if report.failed:
            os.write(self.writer, report.nodeid.encode())


def run_pytest(mutant: dict[str, Any], writer: int) -> int:
    """Run the tests of a mutant by a pytest that imports the package anew."""
    options = sys.argv[1:]
    done = pytest.main([*options, "-x", *mutant["tests"]], plugins=[FirstFailure(writer)])
    return SURVIVED if done == pytest.ExitCode.OK else CAUGHT


if __name__ != "__main__":
    # Made before the tests' modules are imported, which runs lines of the package.
    _plugin = Judge() if "MUTANTS" in os.environ else LineMap()


def pytest_configure(config: pytest.Config) -> None:
    """Register what is to be done."""
    config.pluginmanager.register(_plugin)


if __name__ == "__main__":
    for name in json.loads(Path(os.environ["MUTANT_LINES"]).read_text())["modules"]:
        with contextlib.suppress(Exception):
            importlib.import_module(name)
    assert not any(name.startswith("magnetosuture_thread") for name in sys.modules)
    judge_all(run_pytest)
