"""One module as its syntax tree has it: what each top-level statement binds and uses, and what importing it does.

A use is a dotted path as the source has it, from the root: `fieldcal.geometry.rotation.multiply`, `numpy.linalg.norm`,
and for a name of the module itself `fieldcal.stages.vps.BRIDGE_S`. `reached_code` finds out what stands behind it.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

from fieldcal.provenance.syntax import is_silent, meaning
from fieldcal.provenance.uses import FUNCTIONS, Paths, bound_names, import_bindings, uses_of

INITIALISERS = frozenset({"__init__", "__new__", "__post_init__", "__init_subclass__"})


@dataclass(frozen=True)
class Statement:
    """A top-level statement that is more than an import."""

    text: str
    """Its meaning (`syntax.meaning`)."""
    uses: Paths
    runs: Paths
    """What the imports within it name: modules, or names in them."""
    calls: Paths
    """What it calls while its module is imported."""
    only_binds: bool
    """Whether, but for what it calls, it binds names of its module and does nothing else."""


@dataclass
class ModuleSource:
    """A module; `reached_code` asks for its parts."""

    name: str
    statements: list[Statement] = field(default_factory=list)
    definitions: dict[str, list[Statement]] = field(default_factory=dict)
    """Statements by the names they bind."""
    imported: dict[str, Paths] = field(default_factory=dict)
    """Paths behind the names that imports bind."""
    runs: set[str] = field(default_factory=set)
    """What its imports name: modules, or names in them."""
    stars: set[str] = field(default_factory=set)
    """Modules of which it imports `*`."""
    plain_classes: set[str] = field(default_factory=set)
    """Classes whose call runs no code of their own."""


def parse_module(text: str, name: str, *, is_package: bool) -> ModuleSource:
    """Read a module's source.

    Parameters
    ----------
    text : str
        Its source.
    name : str
        Its dotted name.
    is_package : bool
        Whether it is a package's `__init__`, from which relative imports are counted otherwise.

    Raises
    ------
    SyntaxError
        It is not Python.
    """
    tree = ast.parse(text, filename=name)
    package = name if is_package else name.rpartition(".")[0]
    late = _annotations_are_late(tree)
    module = ModuleSource(name)
    body = list(_statements(tree.body))
    for imports in (
        item for node in body for item in _at_import(node) if isinstance(item, ast.Import | ast.ImportFrom)
    ):
        for bound, paths in import_bindings(imports, package).items():
            if bound == "*":
                module.stars |= {path.removesuffix(".*") for path in paths}
            else:
                module.imported[bound] = module.imported.get(bound, frozenset()) | paths
        module.runs |= _named_by(imports, package)
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            continue
        calls: set[str] = set()
        for part in _called(node):
            calls |= uses_of(part, name, module.imported, package, annotations_are_late=True)
        within = (item for item in ast.walk(node) if isinstance(item, ast.Import | ast.ImportFrom))
        statement = Statement(
            meaning(node, annotations_are_late=late),
            uses_of(node, name, module.imported, package, annotations_are_late=late),
            frozenset(path for item in within for path in _named_by(item, package)),
            frozenset(calls),
            _only_binds(node, module),
        )
        module.statements.append(statement)
        for bound in sorted({*bound_names([node]), *_made_global(node)}):
            module.definitions.setdefault(bound, []).append(statement)
        if isinstance(node, ast.ClassDef) and _is_plain(node):
            module.plain_classes.add(node.name)
    return module


def _annotations_are_late(tree: ast.Module) -> bool:
    futures = [node for node in tree.body if isinstance(node, ast.ImportFrom) and node.module == "__future__"]
    return any(alias.name == "annotations" for node in futures for alias in node.names)


def _statements(body: Sequence[ast.stmt]) -> Iterator[ast.stmt]:
    """Statements that do something, without what only a type checker sees."""
    for node in body:
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            yield from _statements(node.orelse)
        elif isinstance(node, ast.If) and ast.unparse(node.test) in ("not TYPE_CHECKING", "not typing.TYPE_CHECKING"):
            yield from _statements(node.body)
        elif not is_silent(node):
            yield node


def _at_import(node: ast.AST) -> Iterator[ast.AST]:
    """A statement and those of its parts that run while its module is imported: all but the bodies of functions."""
    yield node
    parts: Iterable[ast.AST] = ast.iter_child_nodes(node)
    if isinstance(node, (*FUNCTIONS, ast.Lambda)):
        decorators = [] if isinstance(node, ast.Lambda) else node.decorator_list
        parts = [*decorators, *node.args.defaults, *(item for item in node.args.kw_defaults if item is not None)]
    for part in parts:
        yield from _at_import(part)


def _called(node: ast.AST) -> Iterator[ast.expr]:
    """What a statement calls while its module is imported; decorators and metaclasses are called too."""
    for item in _at_import(node):
        if isinstance(item, ast.Call):
            yield item.func
        elif isinstance(item, (*FUNCTIONS, ast.ClassDef)):
            yield from item.decorator_list
        if isinstance(item, ast.ClassDef):
            yield from (keyword.value for keyword in item.keywords)


def _named_by(node: ast.Import | ast.ImportFrom, package: str) -> Paths:
    if isinstance(node, ast.Import):
        return frozenset(alias.name for alias in node.names)
    return frozenset(path.removesuffix(".*") for paths in import_bindings(node, package).values() for path in paths)


def _only_binds(node: ast.stmt, module: ModuleSource) -> bool:
    if isinstance(node, ast.AugAssign):  # of an imported name it might change the object that others have too
        return isinstance(node.target, ast.Name) and node.target.id not in module.imported
    if isinstance(node, ast.Assign):
        return all(_are_names(target) for target in node.targets)
    if isinstance(node, ast.AnnAssign):
        return isinstance(node.target, ast.Name)
    return isinstance(node, (*FUNCTIONS, ast.ClassDef))


def _are_names(target: ast.expr) -> bool:
    if isinstance(target, ast.Tuple | ast.List):
        return all(_are_names(item) for item in target.elts)
    return isinstance(target, ast.Name) or (isinstance(target, ast.Starred) and _are_names(target.value))


def _made_global(node: ast.stmt) -> set[str]:
    """Names of the module that functions bind by `global`."""
    return {name for item in ast.walk(node) if isinstance(item, ast.Global) for name in item.names}


def _is_plain(node: ast.ClassDef) -> bool:
    own = {item.name for item in node.body if isinstance(item, ast.FunctionDef)}
    return not (own & INITIALISERS or node.keywords or node.bases)
