"""Stand-ins for packages with which a command is imported to show its help, or what may follow, and nothing else."""

from __future__ import annotations

import sys
from collections.abc import Iterator, MutableSequence, Set
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType
from typing import Any


class _Anything(type):
    """A class that has every attribute, may be a base, and as a decorator changes nothing."""

    def __new__(cls, name: str, bases: tuple[type, ...], members: dict[str, Any]) -> _Anything:
        return super().__new__(cls, name, bases, members)

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _StandIn

    def __call__(cls, *arguments: Any, **_: Any) -> Any:
        return arguments[0] if len(arguments) == 1 and callable(arguments[0]) else _StandIn

    def __getitem__(cls, _: Any) -> Any:
        return cls

    def __or__(cls, _: Any) -> Any:
        return cls

    def __iter__(cls) -> Iterator[Any]:
        return iter(())


class _StandIn(metaclass=_Anything):
    """An attribute of a package that is not installed."""


class _Module(ModuleType):
    __path__: MutableSequence[str] = []  # noqa: RUF012
    __version__ = "0"

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _StandIn


class _Finder:
    """Finds stand-ins for packages, and for all modules in them."""

    def __init__(self, packages: Set[str]) -> None:
        self._packages = packages

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """See `importlib.abc.MetaPathFinder`."""
        return ModuleSpec(name, self) if name.partition(".")[0] in self._packages else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """See `importlib.abc.Loader`."""
        return _Module(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """See `importlib.abc.Loader`."""


def _is_installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False


@contextmanager
def stand_ins(packages: Set[str], *, even_installed: bool = False) -> Iterator[None]:
    """Have packages replaced while the `with` statement lasts; what it imported is forgotten.

    Args:
        packages: names.
        even_installed: whether those too that are installed: torch takes seconds to import.
    """
    replaced = packages if even_installed else {package for package in packages if not _is_installed(package)}
    before, finder = set(sys.modules), _Finder(replaced)
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in set(sys.modules) - before:
            if name.partition(".")[0] in packages | {"lightpage"}:
                del sys.modules[name]
