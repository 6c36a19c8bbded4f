"""What the stages reach, against what they are seen to run and to name: it counts, and nothing else does."""

from __future__ import annotations

import ast
import builtins
import dis
import functools
import importlib
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import CodeType, FrameType, FunctionType, ModuleType
from typing import Any

import pytest
import what_reruns
from drift_history import publish_fleet
from outside_ci import outside_ci

import fieldcal
from fieldcal.config.configuration import load
from fieldcal.config.parameters import PROFILES
from fieldcal.config.stage_settings import taken_from
from fieldcal.logs import find_logs, ingest
from fieldcal.provenance.module_source import ModuleSource, parse_module
from fieldcal.provenance.reached_code import reach, reach_digest
from fieldcal.provenance.run_key import dotted_name
from fieldcal.provenance.source_tree import SourceTree, installed
from fieldcal.simulation.archive import settings, signals, write_flights
from fieldcal.simulation.experiment import Experiment, simulate
from fieldcal.stages.pipeline import PIPELINE
from fieldcal.stages.stage import refused_beforehand
from fieldcal.trends.drift_table import update_drift

PACKAGE = Path(str(fieldcal.__file__)).parent
INGEST = ingest.tidy_log
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "ingest": INGEST,
    "trends": update_drift,
    **{stage.name: stage.function for stage in PIPELINE},
}
ROTATION = "fieldcal.geometry.rotation"


# --- what is seen to run is reached


@contextmanager
def seen_code() -> Iterator[set[CodeType]]:
    """The code of all functions of the package that are called."""
    found: set[CodeType] = set()

    def note(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            found.add(frame.f_code)

    sys.setprofile(note)
    try:
        yield found
    finally:
        sys.setprofile(None)


def definitions_of(seen: set[CodeType]) -> set[tuple[str, str]]:
    """(module, name) of the definitions that code belongs to, and of those it names as the interpreter has them."""
    found: set[tuple[str, str]] = set()
    for code in seen:
        path = Path(code.co_filename)
        if PACKAGE not in path.parents or code.co_name == "<module>":
            continue
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        module = ".".join(["fieldcal", *(parts[:-1] if parts[-1] == "__init__" else parts)])
        known = vars(sys.modules[module])
        found.add((module, code.co_qualname.split(".")[0]))
        for instruction in dis.get_instructions(code):
            name = str(instruction.argval)
            if instruction.opname != "LOAD_GLOBAL" or name in vars(builtins) or name not in known:
                continue
            home = getattr(known[name], "__module__", None)
            if home is not None and home.startswith("fieldcal") and hasattr(known[name], "__qualname__"):
                found.add((home, known[name].__qualname__))
            elif name in defined(module):
                found.add((module, name))
    return found


def defined(module: str) -> set[str]:
    source = installed("fieldcal").module(module)
    assert source is not None
    return set(source.definitions)


def reached_by(name: str) -> set[tuple[str, str]]:
    roots = [dotted_name(FUNCTIONS[name])]
    return reach(installed("fieldcal"), roots).definitions


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"method": "joint", "use_vps": True},
        PROFILES["paper"],
        {"lever_arm_m": [0.05, 0.0, 0.0], "ellipsoid": "tls"},
    ],
    ids=["serial", "joint", "paper", "lever arm"],
)
def test_all_that_a_stage_is_seen_to_run_is_reached(changes: dict[str, Any]) -> None:
    recording = simulate(seed=21, temperature_degc=(20.0, 30.0))
    tables = {f"ingest.{name}": frame for name, frame in signals(recording).items()}
    chosen = settings(recording.experiment, **changes)
    beforehand = reach(installed("fieldcal"), [dotted_name(refused_beforehand)]).definitions
    for stage in PIPELINE:
        given = taken_from(chosen, stage.takes)
        with seen_code() as seen:
            inputs = {own: tables[name] for own, name in stage.reads.items() if name in tables}
            refusal = refused_beforehand(stage, inputs)
            result = stage.function(inputs, given) if refusal is None else refusal
        found = definitions_of(seen)
        assert refusal is not None or (stage.function.__module__, stage.function.__name__) in found
        assert found - beforehand - reached_by(stage.name) == set(), stage.name
        tables |= {f"{stage.name}.{name}": frame for name, frame in result.tables.items()}


@pytest.mark.parametrize("log_format", ["mcap", "csv", "ulog"])
def test_all_that_ingest_is_seen_to_run_is_reached(tmp_path: Path, log_format: str) -> None:
    write_flights(tmp_path, Experiment(seed=1, duration_s=10.0), log_format=log_format)
    (log,) = find_logs(tmp_path)
    vehicle = load(tmp_path / "fieldcal.toml").vehicle(log.vehicle_id)
    with seen_code() as seen:
        tidy = INGEST(log.path, vehicle)
        assert sum(len(frame) for _, frame in tidy.tables())
        tidy.facts()
    found = definitions_of(seen)
    assert {("fieldcal.logs.ingest", "TidyLog"), ("fieldcal.logs.tidy", "TidySignal")} <= found
    assert found - reached_by("ingest") == set()


def test_all_that_the_trends_are_seen_to_run_is_reached(tmp_path: Path) -> None:
    publish_fleet(tmp_path, 4)
    with seen_code() as seen:
        assert len(update_drift(tmp_path)) == 4
    assert ("fieldcal.trends.regression", "judge") in definitions_of(seen)
    assert definitions_of(seen) - reached_by("trends") == set()


# --- an edit concerns those that name what was edited, in the functions as the interpreter has them


def named_in(function: Callable[..., Any]) -> set[tuple[str, str]]:
    """(module, name) of what a function names, directly or not: found in bytecode and live objects, not in source."""
    found: set[tuple[str, str]] = set()
    waiting: list[Any] = [function]
    seen: list[Any] = []
    while waiting:
        thing = inspect.unwrap(waiting.pop()) if callable(waiting[-1]) else waiting.pop()
        if any(thing is other for other in seen):
            continue
        seen.append(thing)
        if isinstance(thing, dict | list | tuple | set | frozenset):
            waiting += [*thing, *(thing.values() if isinstance(thing, dict) else ())]
        elif isinstance(thing, type) and thing.__module__.startswith("fieldcal"):
            found.add((thing.__module__, thing.__qualname__))
            waiting += [*thing.__bases__, *vars(thing).values()]
        elif isinstance(thing, property | classmethod | staticmethod):
            waiting.append(thing.fget if isinstance(thing, property) else thing.__func__)
        elif isinstance(thing, FunctionType) and thing.__module__.startswith("fieldcal"):
            found.add((thing.__module__, thing.__qualname__.split(".")[0]))
            waiting += [*(thing.__defaults__ or ()), *(thing.__kwdefaults__ or {}).values()]
            for code in codes_of(thing.__code__):
                for name, value in loads_of(code, thing.__globals__):
                    found |= {(m, name) for m, known in modules() if name in known and known[name] is value}
                    waiting.append(value)
    return found


def codes_of(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes_of(constant)


def modules() -> Iterator[tuple[str, dict[str, Any]]]:
    yield from ((name, vars(module)) for name, module in list(sys.modules.items()) if name.startswith("fieldcal"))


def loads_of(code: CodeType, known: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Globals that code loads, what it imports, and attributes of modules: (name, value)."""
    source: Any = None
    for instruction in dis.get_instructions(code):
        name = instruction.argval
        if instruction.opname == "LOAD_GLOBAL":
            source = known.get(name)
            if not isinstance(source, ModuleType) and name in known:
                yield name, source
        elif instruction.opname == "IMPORT_NAME":
            source = sys.modules.get(name)
        elif instruction.opname in ("IMPORT_FROM", "LOAD_ATTR", "LOAD_METHOD") and isinstance(source, ModuleType):
            if source.__name__.startswith("fieldcal") and hasattr(source, name):
                yield name, getattr(source, name)
            if instruction.opname != "IMPORT_FROM":
                source = None
        else:
            source = None if instruction.opname != "STORE_FAST" else source


class Edited(SourceTree):
    """The installed source with another text for one module."""

    def __init__(self, module: ModuleSource) -> None:
        super().__init__("fieldcal", installed("fieldcal").folder)
        self.edited = module

    def module(self, name: str) -> ModuleSource | None:
        return self.edited if name == self.edited.name else installed("fieldcal").module(name)


def changed_by(module: str, text: str) -> set[str]:
    """Steps whose digest changes where a module has another text."""
    edited = Edited(parse_module(text, module, is_package=False))
    roots = {step: dotted_name(function) for step, function in FUNCTIONS.items()}
    return {step for step, root in roots.items() if reach_digest(edited, [root]) != original(root)}


@functools.cache
def original(root: str) -> str:
    return reach_digest(installed("fieldcal"), [root])


def source_of(module: str) -> str:
    return Path(str(importlib.import_module(module).__file__)).read_text()


@pytest.mark.parametrize(
    "module",
    [
        pytest.param(ROTATION, marks=outside_ci),
        pytest.param("fieldcal.geometry.sensor_model", marks=outside_ci),
        pytest.param("fieldcal.stages.tables", marks=outside_ci),
    ],
)
def test_each_definition_in_turn_concerns_those_that_name_it(module: str) -> None:
    named = {step: named_in(function) for step, function in FUNCTIONS.items()}
    text = source_of(module)
    edits = 0
    for node in ast.parse(text).body:
        lines = text.splitlines()
        if isinstance(node, ast.FunctionDef):
            lines.insert(node.body[-1].lineno - 1, " " * node.body[-1].col_offset + "edited = 1")
            name = node.name
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id != "Array":
            assert node.end_lineno is not None
            lines[node.end_lineno - 1] += "; edited = 1"
            name = node.targets[0].id
            lines[node.lineno - 1] = lines[node.lineno - 1].replace(f"{name} = ", f"{name} = 0 or ", 1)
        else:
            continue
        edits += 1
        expected = {step for step, names in named.items() if (module, name) in names}
        assert changed_by(module, "\n".join(lines)) == expected, name
    assert edits >= 5


@pytest.mark.parametrize("module", [ROTATION, "fieldcal.estimation.smoothing", "fieldcal.stages.pipeline"])
def test_comments_and_layout_concern_nobody(module: str) -> None:
    text = source_of(module)
    assert changed_by(module, re.sub(r"^(def|class|[A-Z])", r"# a comment\n\1", text, flags=re.MULTILINE)) == set()
    assert changed_by(module, ast.unparse(ast.parse(text))) == set()
    assert changed_by(module, re.sub(r'"""[A-Z]', '"""Once more: ', text)) == set()


@outside_ci
def test_in_a_copy_a_comment_concerns_nobody_and_a_constant_those_that_reach_it(tmp_path: Path) -> None:
    """What `benchmarks/what_reruns.py` shows of nights, by the digests alone."""
    package = what_reruns.copy_package(tmp_path)

    def digests() -> dict[str, str]:
        tree = SourceTree("fieldcal", package)
        return {step: reach_digest(tree, [dotted_name(function)]) for step, function in FUNCTIONS.items()}

    before = digests()
    assert before == {step: original(dotted_name(function)) for step, function in FUNCTIONS.items()}
    assert what_reruns.add_comments(package) > 100
    assert digests() == before
    what_reruns.change_constant(package)
    changed = {step for step, digest in digests().items() if digest != before[step]}
    assert changed == {"gyro_output", "joint", "vps_sync", "verify"} == set(what_reruns.reaching(package))
