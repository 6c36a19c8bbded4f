"""`run_key`: the digest that says whether a stage need not run again.

It covers the stage's name, the parameters that change results, the content of the input tables, the versions of numpy,
scipy and polars, and the source that the stage reaches:

- of the function's own module only what the function names, directly or through other definitions of that module
  (functions, classes, constants), so that one stage's change does not re-run its neighbours in the same file;
- of every project module those name, and of all project modules that these import in turn, the whole file.

Imports are read from the source, not followed at run time; what is reached by a computed name is not seen. A package's
`__init__` counts where something is imported from it that is not one of its modules. Execution settings never enter.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.metadata
import importlib.util
import inspect
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fieldcal

PROJECT = ("fieldcal",)
LIBRARIES = ("numpy", "scipy", "polars")


def run_key(
    stage_name: str,
    source: str,
    params: Mapping[str, Any],
    input_hashes: Mapping[str, str],
    *,
    extra: Mapping[str, Any] | None = None,
) -> str:
    """Digest of one execution of a stage: 32 hex digits, the same in every process.

    Parameters
    ----------
    stage_name : str
        Name of the stage.
    source : str
        `source_digest` of what the stage runs, taken when that was imported: a file edited since is not what runs.
    params : mapping
        Parameters that change results; plain JSON without NaN.
    input_hashes : mapping
        Content hash of every input table, by its name.
    extra : mapping, optional
        Anything else that changes results; plain JSON.

    Raises
    ------
    TypeError, ValueError
        A parameter is not plain JSON (a numpy value, NaN).
    """
    content = {
        "stage": stage_name,
        "params": dict(params),
        "inputs": dict(input_hashes),
        "source": source,
        "versions": library_versions(),
        "extra": dict(extra or {}),
    }
    text = json.dumps(content, sort_keys=True, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


@functools.cache
def library_versions() -> dict[str, str]:
    """Versions of the libraries whose change may change results."""
    return {name: importlib.metadata.version(name) for name in LIBRARIES}


@functools.cache
def code_digest() -> str:
    """One digest of all code, by which the processes of a night tell that they run the same."""
    digest = hashlib.sha256()
    package = Path(str(fieldcal.__file__)).parent
    # In a checkout some rooms are links to folders beside the package.
    sources = (Path(folder, name) for folder, _, names in os.walk(package, followlinks=True) for name in names)
    for path in sorted(path for path in sources if path.suffix == ".py"):
        digest.update(f"{path.relative_to(package).as_posix()}\0".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def source_digest(function: Callable[..., Any]) -> str:
    """Digest of the source `function` reaches (see the top of this page)."""
    target = inspect.unwrap(function.func if isinstance(function, functools.partial) else function)
    home = _read(Path(inspect.getfile(target)), target.__module__)
    own, reached = _within(home, target.__qualname__.split(".")[0])
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(own):
        digest.update(f"{name}\0{own[name]}\0".encode())
    for module, source in sorted(_closure(reached).items()):
        digest.update(f"{module}\0{source.sha256}\0".encode())
    return digest.hexdigest()


def reached_modules(function: Callable[..., Any]) -> tuple[str, ...]:
    """Project modules whose whole source enters the digest of `function`."""
    target = inspect.unwrap(function.func if isinstance(function, functools.partial) else function)
    _, reached = _within(_read(Path(inspect.getfile(target)), target.__module__), target.__qualname__.split(".")[0])
    return tuple(sorted(_closure(reached)))


@dataclass(frozen=True)
class _Source:
    """One file: its digest, its top-level definitions, and which project modules each imported name stands for."""

    sha256: str
    definitions: dict[str, tuple[str, frozenset[str]]]
    """Text of every top-level definition, and the names it uses; under "" the statements that define nothing."""
    imports: dict[str, frozenset[str]]
    """Project modules behind every imported name."""


def _within(home: _Source, start: str) -> tuple[dict[str, str], set[str]]:
    """What `start` names in its own module, as text, and the modules behind the imported names among that.

    The whole module, where `start` (a lambda) is no definition of it.
    """
    own: dict[str, str] = {}
    modules: set[str] = set()
    waiting = [start, ""] if start in home.definitions else [*home.definitions, ""]
    while waiting:
        name = waiting.pop()
        modules |= home.imports.get(name, frozenset())
        if name in home.definitions and name not in own:
            own[name], used = home.definitions[name]
            waiting += used
    return own, modules


def _closure(modules: set[str]) -> dict[str, _Source]:
    """These modules and all project modules they import, directly or not."""
    found: dict[str, _Source] = {}
    waiting = sorted(modules)
    while waiting:
        module = waiting.pop()
        path = _path(module)
        if module not in found and path is not None:
            found[module] = _read(path, module)
            waiting += [other for others in found[module].imports.values() for other in others]
    return found


_remembered: dict[tuple[str, str, int, int], _Source] = {}


def _read(path: Path, module: str) -> _Source:
    stat = path.stat()
    key = (str(path), module, stat.st_size, stat.st_mtime_ns)
    if key not in _remembered:
        data = path.read_bytes()
        _remembered[key] = _parse(data, module, is_package=path.name == "__init__.py")
    return _remembered[key]


def _parse(data: bytes, module: str, *, is_package: bool) -> _Source:
    text = data.decode()
    tree = ast.parse(text)
    lines = text.splitlines()
    package = module if is_package else module.rpartition(".")[0]
    definitions: dict[str, tuple[str, frozenset[str]]] = {}
    for node in tree.body:
        if isinstance(node, ast.Import | ast.ImportFrom) or _is_docstring(node):
            continue
        source = "\n".join(lines[_first_line(node) - 1 : node.end_lineno])
        used = frozenset(item.id for item in ast.walk(node) if isinstance(item, ast.Name))
        used |= _imported_inside(node)
        for name in _defined(node) or [""]:
            before, names = definitions.get(name, ("", frozenset()))
            definitions[name] = (f"{before}{source}\n", names | used)
    imports: dict[str, frozenset[str]] = {}
    for item in ast.walk(tree):
        for bound, reached in _bindings(item, package):
            imports[bound] = imports.get(bound, frozenset()) | reached
    return _Source(hashlib.sha256(data).hexdigest(), definitions, imports)


def _is_docstring(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)


def _first_line(node: ast.stmt) -> int:
    decorators: list[ast.expr] = getattr(node, "decorator_list", [])
    return min([node.lineno, *(decorator.lineno for decorator in decorators)])


def _defined(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return [node.name]
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign):
        targets = node.targets
    elif isinstance(node, ast.AnnAssign):
        targets = [node.target]
    names = [item.id for target in targets for item in ast.walk(target) if isinstance(item, ast.Name)]
    plain = all(isinstance(target, ast.Name | ast.Tuple) for target in targets)
    return names if plain else []


def _imported_inside(node: ast.stmt) -> frozenset[str]:
    """Names that imports within a definition bind there."""
    inner = (item for item in ast.walk(node) if isinstance(item, ast.Import | ast.ImportFrom))
    return frozenset(alias.asname or alias.name.split(".")[0] for item in inner for alias in item.names)


def _bindings(node: ast.AST, package: str) -> list[tuple[str, frozenset[str]]]:
    """Names an import statement binds, with the project modules behind them; `*` counts as used by everything."""
    if isinstance(node, ast.Import):
        return [
            (alias.asname or alias.name.split(".")[0], frozenset([alias.name]))
            for alias in node.names
            if alias.name.split(".")[0] in PROJECT
        ]
    if not isinstance(node, ast.ImportFrom):
        return []
    base = node.module or ""
    if node.level:
        parents = package.split(".")
        base = ".".join([*parents[: len(parents) - node.level + 1], *([node.module] if node.module else [])])
    if base.split(".")[0] not in PROJECT:
        return []
    return [
        ("" if alias.name == "*" else alias.asname or alias.name, frozenset([_module_of(base, alias.name)]))
        for alias in node.names
    ]


def _module_of(base: str, name: str) -> str:
    """`from base import name` reaches the module `base.name` if there is one, else `base`."""
    return f"{base}.{name}" if name != "*" and _path(f"{base}.{name}") is not None else base


@functools.cache
def _path(module: str) -> Path | None:
    """File of a project module; found without importing it."""
    package, *rest = module.split(".")
    folder = _package_folder(package)
    if folder is None:
        return None
    inside = folder.joinpath(*rest)
    for path in (inside / "__init__.py", inside.with_suffix(".py") if rest else inside / "__init__.py"):
        if path.is_file():
            return path
    return None


@functools.cache
def _package_folder(package: str) -> Path | None:
    spec = importlib.util.find_spec(package)
    places = spec.submodule_search_locations if spec else None
    return Path(next(iter(places))) if places else None
