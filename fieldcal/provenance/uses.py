"""Which names of the project a piece of syntax uses, as dotted paths; local names are told from the module's."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping

Paths = frozenset[str]
LOCAL: Paths = frozenset()
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
UNSEEN = frozenset({"__subclasses__", "__init_subclass__"})
"""Attributes through which classes come into play that nothing names."""

COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


def uses_of(
    node: ast.AST, module: str, imported: Mapping[str, Paths], package: str, *, annotations_are_late: bool
) -> Paths:
    """Dotted paths of all names that `node` uses and does not bind itself, each with the attributes asked of it.

    A name of the module stands under the module's, so do built-in ones; an imported one under what it stands for.

    Parameters
    ----------
    node : ast.AST
        A top-level statement, or an expression outside functions.
    module, package : str
        Dotted names of its module and of the package from which relative imports are counted.
    imported : mapping
        Paths behind the names that the module's own imports bind.
    annotations_are_late : bool
        Whether annotations of functions are never evaluated. Those of classes count in any case.
    """
    visitor = _Uses(module, imported, package, late=annotations_are_late)
    visitor.visit(node)
    return frozenset(visitor.paths)


def import_bindings(node: ast.Import | ast.ImportFrom, package: str) -> dict[str, Paths]:
    """Names an import binds, with the path behind each; `*` for all of a module's."""
    if isinstance(node, ast.Import):
        return {
            alias.asname or alias.name.split(".")[0]: frozenset(
                [alias.name if alias.asname else alias.name.split(".")[0]]
            )
            for alias in node.names
        }
    base = node.module or ""
    if node.level:
        parents = package.split(".")
        base = ".".join([*parents[: len(parents) - node.level + 1], *([base] if base else [])])
    return {alias.asname or alias.name: frozenset([f"{base}.{alias.name}"]) for alias in node.names}


def bound_names(nodes: Iterable[ast.AST], package: str = "") -> dict[str, Paths]:
    """Names that statements bind in their own scope; paths behind those that imports bind."""
    found: dict[str, Paths] = {}
    foreign: set[str] = set()
    waiting = list(nodes)
    while waiting:
        node = waiting.pop()
        if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
            found.setdefault(node.name, LOCAL)
            continue
        if isinstance(node, ast.Import | ast.ImportFrom):
            for name, paths in import_bindings(node, package).items():
                found[name] = found.get(name, LOCAL) | paths
        elif isinstance(node, ast.Global | ast.Nonlocal):
            foreign |= set(node.names)
        elif isinstance(node, ast.Name) and not isinstance(node.ctx, ast.Load):
            found.setdefault(node.id, LOCAL)
        elif isinstance(node, ast.ExceptHandler | ast.MatchAs | ast.MatchStar) and node.name:
            found.setdefault(node.name, LOCAL)
        elif isinstance(node, ast.MatchMapping) and node.rest:
            found.setdefault(node.rest, LOCAL)
        if isinstance(node, COMPREHENSIONS):  # their targets are their own, `:=` within them is the function's
            waiting += [item.target for item in ast.walk(node) if isinstance(item, ast.NamedExpr)]
        elif not isinstance(node, ast.Lambda):
            waiting += ast.iter_child_nodes(node)
    return {name: paths for name, paths in found.items() if name not in foreign}


class _Uses(ast.NodeVisitor):
    def __init__(self, module: str, imported: Mapping[str, Paths], package: str, *, late: bool) -> None:
        self.paths: set[str] = set()
        self._module = module
        self._imported = imported
        self._package = package
        self._late = late
        self._scopes: list[Mapping[str, Paths]] = []
        """Of the functions around, what each name stands for; classes have none that their methods see."""
        self._in_class = False

    def visit_Name(self, node: ast.Name) -> None:
        self._use(node.id, [])

    def visit_Attribute(self, node: ast.Attribute) -> None:
        attributes: list[str] = []
        inner: ast.expr = node
        while isinstance(inner, ast.Attribute):
            attributes.insert(0, inner.attr)
            self._mention(inner.attr)
            inner = inner.value
        if isinstance(inner, ast.Name):
            self._use(inner.id, attributes)
        else:
            self.visit(inner)

    def visit_Call(self, node: ast.Call) -> None:
        if isinstance(node.func, ast.Name) and node.func.id in ("vars", "dir") and not (node.args or node.keywords):
            self._use("globals", [])  # what `vars()` gives outside functions
        self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef | ast.AsyncFunctionDef) -> None:
        self._mention(node.name)
        self._all(node.decorator_list)
        self._arguments(node.args)
        if node.returns is not None and not self._late:
            self.visit(node.returns)
        outer, self._in_class = self._in_class, False
        self._scopes.append({**_parameters(node.args), **bound_names(node.body, self._package)})
        self._all(node.body)
        self._scopes.pop()
        self._in_class = outer

    visit_AsyncFunctionDef = visit_FunctionDef

    def visit_Lambda(self, node: ast.Lambda) -> None:
        self._arguments(node.args)
        self._scopes.append(_parameters(node.args))
        self.visit(node.body)
        self._scopes.pop()

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self.visit(node.target)
        if node.value is not None:
            self.visit(node.value)
        if not self._late or self._in_class:
            self.visit(node.annotation)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._all([*node.decorator_list, *node.bases, *node.keywords])
        outer, self._in_class = self._in_class, True
        self._all(node.body)
        self._in_class = outer

    def _comprehension(self, node: ast.ListComp | ast.SetComp | ast.DictComp | ast.GeneratorExp) -> None:
        self.visit(node.generators[0].iter)  # which still sees the scope around
        self._scopes.append(bound_names([generator.target for generator in node.generators]))
        self.generic_visit(node)
        self._scopes.pop()

    visit_ListComp = visit_SetComp = visit_DictComp = visit_GeneratorExp = _comprehension

    def _all(self, nodes: Iterable[ast.AST]) -> None:
        for node in nodes:
            self.visit(node)

    def _arguments(self, arguments: ast.arguments) -> None:
        self._all([*arguments.defaults, *(default for default in arguments.kw_defaults if default is not None)])
        if not self._late:
            self._all([item.annotation for item in _listed(arguments) if item.annotation is not None])

    def _mention(self, name: str) -> None:
        if name in UNSEEN:
            self.paths.add(f"{self._module}.{name}")

    def _use(self, name: str, attributes: list[str]) -> None:
        for scope in reversed(self._scopes):
            if name in scope:
                paths = scope[name]
                break
        else:
            paths = self._imported.get(name, LOCAL) | {f"{self._module}.{name}"}
        self.paths |= {".".join([path, *attributes]) for path in paths}


def _listed(arguments: ast.arguments) -> list[ast.arg]:
    several = [arguments.vararg, arguments.kwarg]
    return [
        *arguments.posonlyargs,
        *arguments.args,
        *arguments.kwonlyargs,
        *(item for item in several if item is not None),
    ]


def _parameters(arguments: ast.arguments) -> dict[str, Paths]:
    return {item.arg: LOCAL for item in _listed(arguments)}
