"""What code a function reaches: top-level definitions of the project's modules, followed from name to name.

Of a module that is reached, there count

- of its definitions (functions, classes, constants) those that something reached names, a class as a whole;
- its statements that do more than bind names (`register(f)`, `REGISTRY["f"] = f`, a definition whose decorator or value
  calls code of the project), and those of the modules that it imports: they run for whoever comes;
- everything, where it cannot be told what is used of it: the module is passed around as an object, imported as `*`,
  its names are worked out (`globals()`), or a name is asked of it that its source does not bind.

The whole project counts for what runs text, imports by a computed name or asks for `__subclasses__`. A definition that
mentions `__file__` or `importlib.resources` may read data: all files beside its module that are not Python count by
their bytes, and so does a compiled module that is imported. Not seen: what code outside the project does to it.
"""

from __future__ import annotations

import builtins
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from fieldcal.provenance.module_source import ModuleSource, Statement
from fieldcal.provenance.source_tree import SourceTree
from fieldcal.provenance.uses import UNSEEN

BUILTINS = frozenset(dir(builtins))
OWN_NAMES = frozenset({"globals", "locals"})
"""Built-in functions that give the names of the module."""

ANY_CODE = frozenset({"__import__", "eval", "exec", *UNSEEN})
ANY_CODE_PATHS = ("importlib.import_module", "importlib.reload", "runpy", "pkgutil", "sys.modules")
DATA = frozenset({"__file__", "__path__", "__spec__"})
DATA_PATHS = ("importlib.resources", "importlib_resources", "pkgutil.get_data", "jinja2.PackageLoader")


@dataclass
class Reached:
    """What was reached. `definitions`: (module, name); `modules`: those whose import is part of it; `texts`: (module,
    meaning) of the statements that count; `files`: data and compiled modules."""

    definitions: set[tuple[str, str]] = field(default_factory=set)
    modules: set[str] = field(default_factory=set)
    texts: set[tuple[str, str]] = field(default_factory=set)
    files: set[Path] = field(default_factory=set)


def reach(tree: SourceTree, names: Iterable[str]) -> Reached:
    """What the definitions with these dotted names reach.

    Raises
    ------
    LookupError
        There is no such definition.
    """
    names = list(names)
    for name in names:
        module, _, own = name.rpartition(".")
        if (source := tree.module(module)) is None or own not in {*source.definitions, *source.imported}:
            raise LookupError(f"{name} is no definition of the source in {tree.folder}.")
    return _Walk(tree).follow(names)


def reach_digest(tree: SourceTree, names: Iterable[str]) -> str:
    """32 hex digits of what these definitions reach. Raises as `reach`."""
    names = sorted(names)
    reached = reach(tree, names)
    digest = hashlib.blake2b("\0".join(names).encode(), digest_size=16)
    for module, text in sorted(reached.texts):
        digest.update(f"\0{module}\0{text}".encode(errors="surrogatepass"))
    for path in sorted(reached.files):
        digest.update(f"\0{path.relative_to(tree.folder).as_posix()}\0".encode())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


class _Walk:
    """From paths to what they reach; nothing twice."""

    def __init__(self, tree: SourceTree) -> None:
        self._tree = tree
        self._found = Reached()
        self._whole: set[str] = set()
        self._followed: set[tuple[str, str]] = set()
        self._waiting: list[tuple[str, str]] = []
        """Paths to follow, each with the module that uses it."""

    def follow(self, names: Iterable[str]) -> Reached:
        self._waiting += [(name, "") for name in names]
        while self._waiting:
            use = self._waiting.pop()
            if use not in self._followed:
                self._followed.add(use)
                self._follow(*use)
        return self._found

    def _follow(self, path: str, user: str) -> None:
        if any(_is_within(path, way) for way in DATA_PATHS):
            self._found.files |= set(self._tree.data_beside(user))
        if any(_is_within(path, way) for way in ANY_CODE_PATHS):
            self._take_everything()
        for module, name, _ in self._tree.places(path):
            self._run(module.name)
            if name is None:
                self._take_whole(module)
            elif name in module.definitions:
                self._found.definitions.add((module.name, name))
                for statement in module.definitions[name]:
                    self._take(module, statement)
            elif name not in module.imported:
                self._unbound(module, name, user)

    def _unbound(self, module: ModuleSource, name: str, user: str) -> None:
        """A name that the module's source does not bind: built in, or bound in a way that is not seen."""
        if name in ANY_CODE:
            self._take_everything()
        if name in DATA:
            self._found.files |= set(self._tree.data_beside(module.name))
        elif name in OWN_NAMES or not (module.name == user or name in BUILTINS):
            self._take_whole(module)

    def _run(self, path: str) -> None:
        """What importing a module does, and the packages that it lies in; `path` may go on to a name in it."""
        parts = path.split(".")
        for end in range(1, len(parts) + 1):
            at = ".".join(parts[:end])
            module = self._tree.module(at)
            if module is None:
                return
            if at in self._found.modules:
                continue
            self._found.modules.add(at)
            self._found.files |= set(self._tree.compiled(at))
            for statement in module.statements:
                if not statement.only_binds or any(self._tree.runs_own_code(call) for call in statement.calls):
                    self._take(module, statement)
            self._waiting += [(star, at) for star in module.stars]
            for imported in module.runs:
                self._run(imported)

    def _take(self, module: ModuleSource, statement: Statement) -> None:
        self._found.texts.add((module.name, statement.text))
        self._waiting += [(path, module.name) for path in statement.uses]
        for path in statement.runs:
            self._run(path)

    def _take_whole(self, module: ModuleSource) -> None:
        if module.name in self._whole:
            return
        self._whole.add(module.name)
        self._found.definitions |= {(module.name, name) for name in module.definitions}
        for statement in module.statements:
            self._take(module, statement)
        self._waiting += [(path, module.name) for paths in module.imported.values() for path in paths]

    def _take_everything(self) -> None:
        self._waiting += [(name, "") for name in self._tree.modules()]


def _is_within(path: str, place: str) -> bool:
    return path == place or path.startswith(f"{place}.")
