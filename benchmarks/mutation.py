"""Do the tests notice? One operator, comparison or constant of a module is changed at a time, and its own tests run.

    python benchmarks/mutation.py                                 # every change of every module below: hours
    python benchmarks/mutation.py --sample 200 --seed 3           # 200 changes, drawn over all modules
    python benchmarks/mutation.py --module logs.mcap.chunks       # one module, all changes
    python benchmarks/mutation.py --module exports --sample 40    # a room
    python benchmarks/mutation.py --sample 200 --part 1/2         # every second module of the sample; the others: 2/2

Needs the `test` extra and a system with fork. Nothing is written to the checkout: the changed module lives in the
memory of a forked process. First a module's own tests (`TESTS` in `mutation_table`) run unchanged, and it is noted
which of them pass through which line; a change is then shown to the tests of its line, the quickest first, until one
fails. Tests are collected once a module, and functions get the changed code in a copy of that process: a fraction of a
second a change. What runs at import (constants, defaults) is imported anew: some seconds.

A *survivor* is a change that no test noticed. Either the tests miss something: write one that kills it, against a truth
that does not come from the module (a closed form, another library, the simulator), never against yesterday's output. Or
the code does nothing there: delete it. Or the change can't be seen from outside, because both forms give the same for
every input: add it to `EQUIVALENT` there, with the reason. No more than 1 in 20 may live, equivalents aside.

`<` and `<=` are drawn between measured real numbers too, which no test can make equal: such changes are listed one by
one. Where a count, an integer stamp or a number that is exact in binary meets its limit, a test shows which it is. What
is said to be converged has a test that another start ends at the same place; only then may a tolerance or a cap be
listed.

A fast path needs tests of its own that fail when it is not taken: behind it stands a slow one that gives the same.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import gc
import importlib.machinery
import importlib.util
import itertools
import math
import os
import pickle
import random
import resource
import shutil
import signal
import sys
import tempfile
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any

import pytest
from mutation_table import EQUIVALENT, FOR_C, TESTS

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGE = REPOSITORY / "fieldcal"
TESTS_FOLDER = REPOSITORY / "tests"
Place = ast.expr | ast.stmt
MEMORY_BYTES = 4 << 30
LEAST_TIMEOUT_S = 20
WHOLE_TIMEOUT_S = 24 * 3600
ALIVE_SHARE = 1 / 20

_SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
_NAMES = {"min": "max", "any": "all", "minimum": "maximum", "argmin": "argmax", "floor": "ceil", "nanmin": "nanmax"}
_NAMES |= {other: name for name, other in _NAMES.items()}
_SIGNS = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.FloorDiv: "//", ast.Mod: "%", ast.Pow: "**",
    ast.LShift: "<<", ast.RShift: ">>", ast.BitAnd: "&", ast.BitOr: "|", ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">",
    ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.Is: "is", ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in",
    ast.And: "and", ast.Or: "or", ast.Not: "not", ast.USub: "-", ast.Invert: "~",
}  # fmt: skip
PRELOADED = (
    "numpy", "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.spatial.transform", "scipy.special",
    "scipy.stats", "polars", "pyarrow.parquet", "mcap.reader", "mcap.writer", "mcap_ros2.reader", "mcap_ros2.writer",
    "pytest", "hypothesis.strategies", "duckdb", "pydantic", "yaml", "rosbags.typesys", "cyclopts", "rich.table",
)  # fmt: skip
"""What many tests import; nothing of fieldcal."""


@dataclass(frozen=True)
class Change:
    """One place of a module, and what becomes of it. `number` counts the places as they are walked; `where` names the
    function or class around it."""

    module: str
    number: int
    where: str
    line: int
    last_line: int
    at_import: bool
    what: str


@dataclass
class Baseline:
    """The unchanged module under its own tests: seconds and file of a test, and who passes through a line."""

    seconds: dict[str, float] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    through: dict[int, set[str]] = field(default_factory=dict)


@dataclass
class Score:
    """What became of a module's changes."""

    killed: int
    equivalent: int
    alive: list[Change]


def places(tree: ast.Module) -> Iterator[tuple[Place, bool, str, Callable[[], None]]]:
    """Every node that is changed, whether it runs at import, the change in words, and a function that makes it."""
    skipped: set[int] = set()
    inside: set[int] = set()
    for node in ast.walk(tree):
        hidden: list[ast.AST | None] = []
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            body = node.body if isinstance(node, ast.FunctionDef) else [node.body]
            inside.update(id(n) for part in body for n in ast.walk(part))
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            hidden += node.decorator_list
        if isinstance(node, ast.FunctionDef):
            hidden.append(node.returns)
        if isinstance(node, ast.arg | ast.AnnAssign):
            hidden.append(node.annotation)
        if isinstance(node, ast.keyword) and node.arg == "strict":
            hidden.append(node.value)
        skipped.update(id(n) for part in hidden if part is not None for n in ast.walk(part))
    for node in ast.walk(tree):
        at_import = id(node) not in inside
        union_of_types = at_import and isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr)
        if id(node) not in skipped and not union_of_types:
            for what, make in _changes(node):
                assert isinstance(node, Place)
                yield node, at_import, what, make


def _changes(node: ast.AST) -> Iterator[tuple[str, Callable[[], None]]]:
    match node:
        case ast.BinOp() | ast.AugAssign() | ast.BoolOp():
            if new := _SWAPS.get(type(node.op)):
                yield f"{_SIGNS[type(node.op)]} → {_SIGNS[new]}", partial(setattr, node, "op", new())
        case ast.Compare():
            for i, old in enumerate(node.ops):
                ops = [*node.ops[:i], _SWAPS[type(old)](), *node.ops[i + 1 :]]
                yield f"{_SIGNS[type(old)]} → {_SIGNS[type(ops[i])]}", partial(setattr, node, "ops", ops)
        case ast.UnaryOp():
            twice = ast.UnaryOp(type(node.op)(), node.operand)
            yield f"without {_SIGNS[type(node.op)]}", partial(setattr, node, "operand", twice)
        case ast.Constant(value=bool() | int() | float() as value):
            other = _other(value)
            yield f"{value!r} → {other!r}", partial(setattr, node, "value", other)
        case ast.Name(id=name) if name in _NAMES:
            yield f"{name} → {_NAMES[name]}", partial(setattr, node, "id", _NAMES[name])
        case ast.Attribute(attr=name) if name in _NAMES:
            yield f"{name} → {_NAMES[name]}", partial(setattr, node, "attr", _NAMES[name])


def _other(value: float) -> float:
    """A tenth more, or one more where that is less than one."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + max(1, value // 10)
    return 1.1 * value if value else 1.0


def source_of(module: str) -> Path:
    """The module's file; its name is given below fieldcal."""
    path = PACKAGE.joinpath(*module.split("."))
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def names_around(node: ast.AST, where: str = "") -> Iterator[tuple[int, str]]:
    """Identity of every node below `node`, and the dotted name of the function or class that it stands in."""
    for child in ast.iter_child_nodes(node):
        own = f"{where}.{child.name}".lstrip(".") if isinstance(child, ast.FunctionDef | ast.ClassDef) else where
        yield id(child), own
        yield from names_around(child, own)


def changes_of(module: str) -> list[Change]:
    """Every change of a module. The second place of a line at which the same is changed is marked `#2`, and so on."""
    found: list[Change] = []
    alike: defaultdict[tuple[int, str], list[tuple[int, int]]] = defaultdict(list)
    tree = ast.parse(source_of(module).read_text())
    around = dict(names_around(tree))
    for number, (node, at_import, what, _) in enumerate(places(tree)):
        end = node.end_lineno or node.lineno
        found.append(Change(module, number, around[id(node)], node.lineno, end, at_import, what))
        alike[node.lineno, what].append((node.col_offset, len(found) - 1))
    for places_on_line in alike.values():
        for n, (_, i) in enumerate(sorted(places_on_line)[1:], 2):
            found[i] = replace(found[i], what=f"{found[i].what} #{n}")
    return sorted(found, key=lambda change: change.line)


def changed(change: Change) -> ast.Module:
    """The module's syntax tree with the change made."""
    tree = ast.parse(source_of(change.module).read_text())
    *_, make = next(itertools.islice(places(tree), change.number, None))
    make()
    return ast.fix_missing_locations(tree)


def modules_of(names: Sequence[str]) -> list[str]:
    """Modules below the names in `TESTS` that begin with one of `names`; all without names."""
    found = set()
    for room in TESTS:
        path = PACKAGE.joinpath(*room.split("."))
        files = path.rglob("*.py") if path.is_dir() else [path.with_suffix(".py")]
        found |= {".".join(f.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__") for f in files}
    return sorted(m for m in found if not names or any(f"{m}.".startswith(f"{name}.") for name in names))


def tests_of(module: str) -> list[Path]:
    """The module's own test files."""
    room = max((room for room in TESTS if f"{module}.".startswith(f"{room}.")), key=len)
    return sorted({path for pattern in TESTS[room] for path in TESTS_FOLDER.glob(pattern)})


class _Loader(importlib.machinery.SourceFileLoader):
    """Gives one module the code of a changed syntax tree."""

    def __init__(self, change: Change) -> None:
        super().__init__(f"fieldcal.{change.module}", str(source_of(change.module)))
        self.tree = changed(change)

    def find_spec(self, fullname: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        return (
            importlib.util.spec_from_file_location(fullname, self.path, loader=self) if fullname == self.name else None
        )

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.tree, self.path, "exec")


class _Watch:
    """Plugin of pytest: how long each test takes, and which lines of one file it passes."""

    def __init__(self, file: Path) -> None:
        self.file = str(file)
        self.lines: set[int] = set()
        self.baseline = Baseline()

    def __call__(self, frame: FrameType, event: str, arg: object) -> Any:
        if frame.f_code.co_filename != self.file:
            return None
        return self._line(frame, event, arg)

    def _line(self, frame: FrameType, event: str, arg: object) -> Any:
        self.lines.add(frame.f_lineno)
        return self._line

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> Iterator[None]:
        yield from self._phase(f"{item.path}")  # what fixtures pass through stands behind every test of the file

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Iterator[None]:
        yield from self._phase(item.nodeid)

    def _phase(self, owner: str) -> Iterator[None]:
        self.lines.clear()
        sys.settrace(self)
        threading.settrace(self)
        try:
            yield
        finally:
            sys.settrace(None)
            for line in self.lines:
                self.baseline.through.setdefault(line, set()).add(owner)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.baseline.seconds[report.nodeid] = self.baseline.seconds.get(report.nodeid, 0.0) + report.duration


def prepare() -> None:
    """Load what many tests import, so that a forked process need not; one thread, as none lives on in it."""
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "POLARS_MAX_THREADS": "1"}
    sys.dont_write_bytecode = True
    sys.path.insert(0, str(REPOSITORY))
    for name in PRELOADED:
        importlib.import_module(name)


def in_child(work: Callable[[Path], int | None], timeout_s: float) -> int:
    """Run `work` in a forked process with a folder of its own: what it returns, negative when a signal ended it."""
    folder = Path(tempfile.mkdtemp(prefix="mutation-"))
    child = os.fork()
    if not child:
        code = 1
        try:
            os.setsid()
            silent = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(silent, stream)
            resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
            signal.alarm(math.ceil(timeout_s))
            code = int(work(folder) or 0)
        finally:
            os._exit(code)
    try:
        _, status = os.waitpid(child, 0)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # processes that a test left behind
        shutil.rmtree(folder, ignore_errors=True)
    return os.waitstatus_to_exitcode(status)


class _Loop:
    """Plugin of pytest: gives the collected tests to `work` instead of running them."""

    def __init__(self, work: Callable[[pytest.Session], None]) -> None:
        self.work = work

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self.work(session)
        return True


def collected(files: Sequence[str], folder: Path, work: Callable[[pytest.Session], None]) -> int:
    """Let pytest collect tests in this process, without traces in the checkout, and call `work` with them."""
    quiet = ["-q", "-p", "no:cacheprovider", "-W", "ignore", f"--rootdir={REPOSITORY}", f"--basetemp={folder / 'tmp'}"]
    return int(pytest.main([*quiet, "-o", "tmp_path_retention_policy=none", *files], plugins=[_Loop(work)]))


def run(session: pytest.Session, tests: Sequence[str]) -> bool:
    """Run these tests of a session in this order up to the first that fails: whether all pass."""
    order = {test: i for i, test in enumerate(tests)}
    items = sorted((item for item in session.items if item.nodeid in order), key=lambda item: order[item.nodeid])
    for item, following in itertools.zip_longest(items, items[1:]):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if session.testsfailed:
            return False
    return True


def replace_functions(change: Change) -> None:
    """Give the functions of a module that is loaded the code of the changed one."""
    file = str(source_of(change.module))
    codes: dict[tuple[str, int], CodeType] = {}
    left = [compile(changed(change), file, "exec", dont_inherit=True)]
    while left:
        code = left.pop()
        codes[code.co_qualname, code.co_firstlineno] = code
        left += [part for part in code.co_consts if isinstance(part, CodeType)]
    for function in gc.get_objects():
        if isinstance(function, FunctionType) and function.__code__.co_filename == file:
            function.__code__ = codes[function.__code__.co_qualname, function.__code__.co_firstlineno]


def tests_through(change: Change, baseline: Baseline, patience_s: float) -> list[str]:
    """Tests that pass through the changed line, all when it runs at import; the quickest first."""
    owners = set(baseline.seconds)
    if not change.at_import:
        lines = range(change.line, change.last_line + 1)
        through = set().union(*(baseline.through.get(line, ()) for line in lines))
        owners = {test for test in owners if test in through or baseline.files[test] in through}
    return sorted((t for t in owners if baseline.seconds[t] <= patience_s), key=baseline.seconds.__getitem__)


def survivors(module: str, changes: Sequence[Change], patience_s: float) -> list[Change]:
    """The changes of a module that no test notices. Raises SystemExit when a test fails without any change."""
    files = [str(path) for path in tests_of(module)]
    os.environ["FIELDCAL_KERNEL"] = "" if module in FOR_C else "numpy"
    with tempfile.NamedTemporaryFile() as result:

        def watched(session: pytest.Session) -> None:
            watch = _Watch(source_of(module))
            session.config.pluginmanager.register(watch)
            watch.baseline.files = {item.nodeid: str(item.path) for item in session.items}
            if run(session, list(watch.baseline.files)):
                Path(result.name).write_bytes(pickle.dumps(watch.baseline))

        def in_functions(session: pytest.Session) -> None:
            """All changes inside functions: each gets a copy of this process, in which the tests are loaded."""
            in_child(lambda _: watched(session), WHOLE_TIMEOUT_S)
            if not (written := Path(result.name).read_bytes()):
                return
            baseline: Baseline = pickle.loads(written)
            alive = []
            for change in changes:
                tests = tests_through(change, baseline, patience_s)

                def changed_code(_: Path, change: Change = change, tests: Sequence[str] = tests) -> bool:
                    replace_functions(change)
                    return not run(session, tests)

                if not change.at_import and in_child(changed_code, timeout_of(tests, baseline)) == 0:
                    alive.append(change)
            Path(result.name).write_bytes(pickle.dumps((baseline, alive)))

        if not files or in_child(lambda folder: collected(files, folder, in_functions), WHOLE_TIMEOUT_S):
            raise SystemExit(f"{module}: its own tests cannot be collected; run them by pytest.")
        if not (written := Path(result.name).read_bytes()):
            raise SystemExit(f"{module}: its own tests fail without any change; run them by pytest.")
        baseline, alive = pickle.loads(written)
    for change in changes:
        if change.at_import:
            tests = tests_through(change, baseline, patience_s)

            def changed_module(folder: Path, change: Change = change, tests: Sequence[str] = tests) -> bool:
                sys.meta_path.insert(0, _Loader(change))
                passed: list[bool] = []
                code = collected(files, folder, lambda session: passed.append(run(session, tests)))
                return bool(code) or passed != [True]

            if in_child(changed_module, timeout_of(tests, baseline)) == 0:
                alive.append(change)
    return alive


def timeout_of(tests: Sequence[str], baseline: Baseline) -> float:
    """Seconds after which a change is taken to hang."""
    return LEAST_TIMEOUT_S + 4 * sum(baseline.seconds[test] for test in tests)


def line_of(change: Change) -> str:
    """The changed line as it stands, without its indentation."""
    return source_of(change.module).read_text().splitlines()[change.line - 1].strip()


def key_of(change: Change) -> tuple[str, str, str, str]:
    """What names the change in `EQUIVALENT`."""
    return change.module, change.where, line_of(change), change.what


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--module", action="append", default=[], help="a module or a room below fieldcal; repeatable")
    parser.add_argument("--without", action="append", default=[], help="a module or a room to leave out; repeatable")
    parser.add_argument("--line", type=int, help="only changes of this line of the module")
    parser.add_argument("--sample", type=int, help="as many changes, drawn evenly from all; all without it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", default="1/1", help="k/n: the k-th of n parts, one for each processor")
    parser.add_argument("--patience", type=float, default=20.0, help="tests that take longer are left out, s (20)")
    arguments = parser.parse_args()

    prepare()
    left_out = set(modules_of(arguments.without)) if arguments.without else set()
    names = [name for name in modules_of(arguments.module) if name not in left_out]
    drawn = [c for name in names for c in changes_of(name) if arguments.line in (None, c.line)]
    if arguments.line is None and (gone := {key for key in EQUIVALENT if key[0] in names} - {*map(key_of, drawn)}):
        raise SystemExit("EQUIVALENT names changes that are no more:\n" + "\n".join(map(str, sorted(gone))))
    if arguments.sample is not None and arguments.sample < len(drawn):
        drawn = sorted(
            random.Random(arguments.seed).sample(drawn, arguments.sample), key=lambda c: (c.module, c.number)
        )
    if not drawn:
        raise SystemExit(f"Nothing to change in {arguments.module}; the modules are those of TESTS.")
    part, parts = map(int, arguments.part.split("/"))
    own = set(sorted({change.module for change in drawn})[part - 1 :: parts])
    drawn = [change for change in drawn if change.module in own]
    scores: dict[str, Score] = {}
    for module, changes in itertools.groupby(drawn, key=lambda c: c.module):
        known: list[Change] = []
        unknown: list[Change] = []
        for change in changes:
            (known if key_of(change) in EQUIVALENT else unknown).append(change)
        alive = survivors(module, unknown, arguments.patience)
        score = scores[module] = Score(len(unknown) - len(alive), len(known), alive)
        for change in sorted(alive, key=lambda c: c.line):
            where = source_of(module).relative_to(REPOSITORY)
            print(f"ALIVE {where}:{change.line}: {change.what}    {line_of(change)}")
        print(f"{module}: {score.killed} killed, {len(score.alive)} alive, {score.equivalent} equivalent", flush=True)

    print(f"\n{'module':44}{'changes':>9}{'killed':>9}{'alive':>9}{'equivalent':>12}")
    for module, score in scores.items():
        total = score.killed + len(score.alive) + score.equivalent
        print(f"{module:44}{total:>9}{score.killed:>9}{len(score.alive):>9}{score.equivalent:>12}")
    n_killed, n_alive = sum(s.killed for s in scores.values()), sum(len(s.alive) for s in scores.values())
    share = n_alive / max(n_killed + n_alive, 1)
    print(f"\n{n_alive} of {n_killed + n_alive} live: {share:.1%}; no more than {ALIVE_SHARE:.0%} may.")
    raise SystemExit(share > ALIVE_SHARE)


if __name__ == "__main__":
    main()
