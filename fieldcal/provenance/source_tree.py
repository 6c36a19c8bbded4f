"""The source of a package, read as it is asked for: modules, dotted paths in them, other files."""

from __future__ import annotations

import functools
import importlib.machinery
import importlib.util
import os
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from fieldcal.provenance.module_source import ModuleSource, parse_module


class Place(NamedTuple):
    """Where a dotted path leads: a name in a module, or (None) the module itself; `beyond`: whether it goes on."""

    module: ModuleSource
    name: str | None
    beyond: bool


class SourceTree:
    """The source of a package as it was when each file was first asked for. Nothing is imported.

    Parameters
    ----------
    package : str
        The package's name.
    folder : Path
        Where it lies.
    """

    def __init__(self, package: str, folder: Path) -> None:
        self.package = package
        self.folder = folder
        self._modules: dict[str, ModuleSource | None] = {}

    def module(self, name: str) -> ModuleSource | None:
        """A module by its dotted name; without content where it is compiled or a mere folder; None: there is none."""
        if name not in self._modules:
            self._modules[name] = self._read(name)
        return self._modules[name]

    def modules(self) -> Iterator[str]:
        """Dotted names of all modules."""
        for path in files_below(self.folder):
            if path.suffix == ".py":
                parts = path.relative_to(self.folder).with_suffix("").parts
                yield ".".join([self.package, *(parts[:-1] if parts[-1] == "__init__" else parts)])

    def places(self, path: str) -> list[Place]:
        """Everything a dotted path may stand for; an imported name leads on to where it is defined. None outside."""
        found: list[Place] = []
        waiting, seen = [path], set()
        while waiting:
            path = waiting.pop()
            at, *rest = path.split(".")
            if path in seen or (module := self.module(at)) is None:
                continue
            seen.add(path)
            while rest:
                name, *rest = rest
                own = f"{module.name}.{name}."
                # `from package.name import name` in the package itself: what goes on from there goes on in the module.
                waiting += [
                    ".".join([behind, *rest])
                    for behind in module.imported.get(name, ())
                    if not (rest and f"{behind}.".startswith(own))
                ]
                inner = self.module(f"{module.name}.{name}")
                if inner is None or name in {*module.definitions, *module.imported}:
                    found.append(Place(module, name, bool(rest)))
                if inner is None:
                    break
                module = inner
            else:
                found.append(Place(module, None, False))
        return found

    def runs_own_code(self, call: str) -> bool:
        """Whether calling what a path stands for runs code of the package: all but classes without an initialiser."""
        return any(
            place.name is None or (place.name in place.module.definitions and not _is_plain_class(place))
            for place in self.places(call)
        )

    def compiled(self, name: str) -> list[Path]:
        """Files of a compiled module."""
        place = self._place(name)
        files = (place.with_name(place.name + suffix) for suffix in importlib.machinery.EXTENSION_SUFFIXES)
        return [path for path in files if path.is_file()]

    def data_beside(self, name: str) -> list[Path]:
        """Files that are not Python, in the folder of a module and below."""
        place = self._place(name)
        return [path for path in files_below(place if place.is_dir() else place.parent) if path.suffix != ".py"]

    def _place(self, name: str) -> Path:
        return self.folder.joinpath(*name.split(".")[1:])

    def _read(self, name: str) -> ModuleSource | None:
        if name.split(".")[0] != self.package:
            return None
        place = self._place(name)
        for path in (place / "__init__.py", place.with_name(place.name + ".py")):
            if path.is_file():
                return parse_module(path.read_text(encoding="utf-8"), name, is_package=path.name == "__init__.py")
        return ModuleSource(name) if place.is_dir() or self.compiled(name) else None


@functools.cache
def installed(package: str) -> SourceTree:
    """The source of an importable package, as it was when it was first asked for in this process.

    Raises
    ------
    LookupError
        There is no such package.
    """
    spec = importlib.util.find_spec(package)
    places = spec.submodule_search_locations if spec else None
    if not places:
        raise LookupError(f"There is no package {package}.")
    return SourceTree(package, Path(next(iter(places))))


def files_below(folder: Path) -> list[Path]:
    """All files of a package's folder in order, without bytecode and hidden ones."""
    found: list[Path] = []
    for at, folders, names in os.walk(folder, followlinks=True):  # in a checkout some rooms are links
        folders[:] = [name for name in folders if name != "__pycache__" and not name.startswith(".")]
        found += [Path(at, name) for name in names if not name.startswith(".")]
    return sorted(found)


def _is_plain_class(place: Place) -> bool:
    return place.name in place.module.plain_classes and not place.beyond
