"""What a function reaches, on a package made for it: an edit changes the digests of those it concerns, no others."""

from __future__ import annotations

import importlib.machinery
import re
import textwrap
from pathlib import Path

import pytest

from fieldcal.provenance.reached_code import reach, reach_digest
from fieldcal.provenance.source_tree import SourceTree

FILES = {
    "__init__.py": '"""The package."""\n',
    "stages.py": '''
        """Stages."""
        from __future__ import annotations
        from typing import TYPE_CHECKING
        from toy import alpha, registry, tools
        from toy.alpha import double as twofold
        from toy.beta import LIMIT
        import toy.gamma
        if TYPE_CHECKING:
            from toy.report import Page

        SHARED = 3

        def helper(x: int) -> int:
            """Adds."""
            return x + SHARED  # the constant

        def first(x):
            return alpha.double(helper(x))

        def alias(x):
            return twofold(x)

        def late(x):
            from toy.delta import late
            return late(x) + LIMIT

        def dotted(x):
            return toy.gamma.f(x)

        def plain(x: Page) -> Page:
            """Nothing of the package, though its local names sound so."""
            helper = [alpha for alpha in x]
            deep = lambda LIMIT: LIMIT
            return helper, deep

        def shadow(twofold):
            return [twofold for twofold in LIMIT(x)]

        def base(x):
            return tools.Child().value

        def decorated(x):
            return tools.traced(x)

        def default(x):
            return tools.offset(x)

        def field(x):
            return tools.Record

        def passed(x):
            return x(alpha)

        def computed(x):
            return getattr(alpha, x)

        def starred(x):
            from toy.everything import shown
            return shown(x)

        def named(x):
            from toy.names import by_name
            return by_name(x)

        def dispatched(x):
            return registry.HANDLERS[x]

        def counted(x):
            from toy.state import current
            return current()

        def reading(x):
            from toy.data.read import table
            return table()

        def loading(x):
            from toy.plugins import load
            return load(x)

        def compiled(x):
            from toy.fast import kernel
            return kernel(x)

        def optional(x):
            from toy.choice import solve
            return solve(x)

        def packaged(x):
            from toy.inner import thing
            return thing
    ''',
    "alpha.py": """
        from toy import deep
        UNUSED = 5
        def double(x):
            return deep.twice(x)
        def other(x):
            return UNUSED
    """,
    "deep.py": "def twice(x):\n    return 2 * x\ndef thrice(x):\n    return 3 * x\n",
    "beta.py": "LIMIT = 4\n",
    "gamma.py": "from . import deep\ndef f(x):\n    return x\ndef g(x):\n    return deep.thrice(x)\n",
    "delta.py": "def late(x):\n    return x\n",
    "inner/__init__.py": "from .leaf import thing\n",
    "inner/leaf.py": "thing = 1\nother = 2\n",
    "report.py": "class Page:\n    title = ''\n",
    "tools.py": """
        from __future__ import annotations
        from dataclasses import dataclass
        from toy.trace import trace
        START = 1
        class Parent:
            value = 1
        class Child(Parent):
            def method(self):
                return 2
        @trace
        def traced(x):
            return x
        def offset(x, by=START):
            return x + by
        class Unit:
            pass
        @dataclass
        class Record:
            size: Unit
    """,
    "trace.py": "def trace(f):\n    return f\n",
    "everything.py": "from toy.shown import *\n",
    "shown.py": "def shown(x):\n    return x\ndef hidden(x):\n    return x\n",
    "names.py": "def by_name(x):\n    return globals()[x]\ndef one(x):\n    return 1\n",
    "registry.py": """
        HANDLERS = {}
        def handler(name):
            def keep(f):
                HANDLERS[name] = f
                return f
            return keep
        @handler("a")
        def handle_a(x):
            return 10
        def unregistered(x):
            return 11
    """,
    "state.py": """
        def _set():
            global LEVEL
            LEVEL = 7
        def current():
            return LEVEL
        _set()
    """,
    "data/__init__.py": "",
    "data/read.py": """
        from pathlib import Path
        HERE = Path(__file__).parent
        def table():
            return (HERE / "table.csv").read_text()
    """,
    "data/table.csv": "1,2\n",
    "plugins.py": "import importlib\ndef load(x):\n    return importlib.import_module(x)\n",
    "choice.py": """
        try:
            from toy.missing import solve
        except ImportError:
            def solve(x):
                return 20
    """,
    "aside.txt": "not read by anyone",
}
KERNEL = f"fast/kernel{importlib.machinery.EXTENSION_SUFFIXES[0]}"
STAGES = [name for name in re.findall(r"^        def (\w+)", FILES["stages.py"], re.MULTILINE) if name != "helper"]
EVERYTHING = {"loading"}
"""Stages that can reach all of the package."""


@pytest.fixture
def toy(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        path = tmp_path / "toy" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(textwrap.dedent(text))
    (tmp_path / "toy" / "fast").mkdir()
    (tmp_path / "toy" / "fast" / "__init__.py").write_text("")
    (tmp_path / "toy" / KERNEL).write_bytes(b"machine code")
    return tmp_path / "toy"


def digests(toy: Path) -> dict[str, str]:
    tree = SourceTree("toy", toy)
    return {stage: reach_digest(tree, [f"toy.stages.{stage}"]) for stage in STAGES}


def edit(toy: Path, name: str, old: str, new: str) -> set[str]:
    """Stages whose digest changes with this edit."""
    before, path = digests(toy), toy / name
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    return {stage for stage, digest in digests(toy).items() if digest != before[stage]}


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("stages.py", "# the constant", "# SHARED = 4"),
        ("stages.py", '"""Adds."""', '"""Subtracts."""'),
        ("stages.py", '"""Adds."""', ""),
        ("stages.py", '"""Stages."""', '"""The stages."""'),
        ("stages.py", "x + SHARED", "(\n        x\n        + SHARED)"),
        ("stages.py", "def helper(x: int) -> int:", "def helper(x: float):"),
        ("stages.py", "SHARED = 3", 'SHARED: int = 3\n"""What is added."""'),
        ("stages.py", "SHARED = 3", "SHARED = 0x3"),
        ("tools.py", "class Unit:\n    pass", "class Unit:\n    '''A unit.'''"),
    ],
)
def test_what_is_meant_for_the_reader_alone_changes_nothing(toy: Path, name: str, old: str, new: str) -> None:
    assert edit(toy, name, old, new) == set()


@pytest.mark.parametrize(
    ("name", "old", "new", "changed"),
    [
        ("stages.py", "SHARED = 3", "SHARED = 4", {"first"}),
        ("stages.py", "SHARED = 3", "SHARED = 3.0", {"first"}),
        ("stages.py", "x + SHARED", "x - SHARED", {"first"}),
        ("alpha.py", "deep.twice(x)", "deep.twice(-x)", {"first", "alias", "passed", "computed"}),
        ("alpha.py", "UNUSED = 5", "UNUSED = 6", {"passed", "computed"}),
        ("deep.py", "2 * x", "4 * x", {"first", "alias", "passed", "computed"}),
        ("deep.py", "3 * x", "4 * x", {"passed", "computed"}),
        ("beta.py", "4", "5", {"late", "shadow"}),
        ("delta.py", "return x", "return -x", {"late"}),
        ("gamma.py", "return x", "return -x", {"dotted"}),
        ("inner/leaf.py", "thing = 1", "thing = 2", {"packaged"}),
        ("inner/leaf.py", "other = 2", "other = 3", set()),
        ("report.py", "''", "'x'", set()),
        ("tools.py", "value = 1", "value = 2", {"base"}),
        ("tools.py", "return 2", "return 3", {"base"}),
        ("tools.py", "START = 1", "START = 2", {"default"}),
        ("tools.py", "size: Unit", "size: int", {"field"}),
        ("tools.py", "class Unit:\n    pass", "class Unit:\n    symbol = 'm'", {"field"}),
        ("shown.py", "def hidden(x):\n    return x", "def hidden(x):\n    return -x", {"starred"}),
        ("names.py", "return 1", "return 2", {"named"}),
        ("state.py", "LEVEL = 7", "LEVEL = 8", {"counted"}),
        ("data/table.csv", "1,2", "1,3", {"reading"}),
        ("choice.py", "return 20", "return 21", {"optional"}),
        ("aside.txt", "not", "never", set()),
    ],
)
def test_an_edit_concerns_those_that_reach_it(toy: Path, name: str, old: str, new: str, changed: set[str]) -> None:
    assert edit(toy, name, old, new) == changed | (EVERYTHING if name != "aside.txt" else set())


def test_what_runs_at_import_concerns_whoever_comes(toy: Path) -> None:
    """A handler kept by its decorator is reached by nobody's name, and by all that import its module."""
    assert edit(toy, "registry.py", "return 10", "return 12") == set(STAGES)
    assert edit(toy, "trace.py", "return f", "return lambda x: f(x)") == set(STAGES)
    assert edit(toy, "registry.py", "return 11", "return 12") == EVERYTHING
    assert edit(toy, "beta.py", "LIMIT = 4", "LIMIT = 4\nprint(LIMIT)") == set(STAGES)
    assert edit(toy, "delta.py", "def late", "print()\ndef late") == {"late"} | EVERYTHING
    assert edit(toy, "inner/__init__.py", "from", "print()\nfrom") == {"packaged"} | EVERYTHING


def test_compiled_code_counts_by_its_bytes(toy: Path) -> None:
    before = digests(toy)
    (toy / KERNEL).write_bytes(b"other machine code")
    assert {stage for stage, digest in digests(toy).items() if digest != before[stage]} == {"compiled"} | EVERYTHING


def test_an_import_by_a_computed_name_reaches_the_whole_package(toy: Path) -> None:
    tree = SourceTree("toy", toy)
    reached = reach(tree, ["toy.stages.loading"])
    assert reached.modules == set(tree.modules())
    assert ("toy.deep", "thrice") in reached.definitions


def test_a_name_that_is_not_there_is_told(toy: Path) -> None:
    with pytest.raises(LookupError, match=r"toy\.stages\.nobody is no definition"):
        reach(SourceTree("toy", toy), ["toy.stages.nobody"])


def test_where_the_package_lies_does_not_matter(toy: Path, tmp_path: Path) -> None:
    before = digests(toy)
    (toy / "alpha.py").touch()
    moved = toy.rename(tmp_path / "elsewhere")
    assert digests(moved) == before
