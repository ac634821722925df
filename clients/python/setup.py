"""Builds the client's wheel from the very modules that the service has: each is copied with its imports renamed."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent / "repository"
"""Links to what is needed of the repository: a copy of this folder that follows them is whole."""
if not (ROOT / "pyproject.toml").is_file():
    raise SystemExit(f"{ROOT}: got links that lead nowhere, wanted a copy that follows them: cp -rL clients/python")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
DEPENDENCIES = ("googleapis-common-protos", "grpcio", "numpy", "protobuf")
PACKAGE = "lightpage_client"
START = ("lightpage.runtime.client.client",)
"""What a caller imports; whatever these modules import of the package comes along."""

_IMPORT = re.compile(r"^(\s*)(from|import) lightpage\b", re.MULTILINE)


def file_of(module: str) -> Path | None:
    """The file of a module of this repository; None where there is none, as of a package that is a plain folder."""
    path = ROOT.joinpath(*module.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None)


def imports(file: Path) -> set[str]:
    """The modules of the package that a file imports when it is itself imported."""
    found = set()
    for node in ast.parse(file.read_text("utf-8")).body:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= {node.module} | {name for name in inner if file_of(name)}
    return {name for name in found if name.startswith("lightpage.")}


def needed() -> list[str]:
    """All modules of the client; not the packages that they lie in, which may offer more than the client has."""
    found: set[str] = set()
    left = list(START)
    while left:
        module = left.pop()
        file = file_of(module)
        if module not in found and file is not None and file.name != "__init__.py":
            found.add(module)
            left += imports(file)
    return sorted(found)


class Build(build_py):
    """Adds the copied modules to what is built."""

    def run(self) -> None:
        """Build."""
        super().run()
        target = Path(self.build_lib) / PACKAGE
        for module in needed():
            source = file_of(module)
            assert source is not None  # `needed` has seen it
            for file in (source, source.with_suffix(".pyi")):
                if file.is_file():
                    copy = target / file.relative_to(ROOT / "lightpage")
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    copy.write_text(_IMPORT.sub(rf"\1\2 {PACKAGE}", file.read_text("utf-8")), "utf-8")
                    for folder in copy.relative_to(target).parents[:-1]:
                        (target / folder / "__init__.py").touch()
        (target / "py.typed").touch()


requirements = [one for one in PROJECT["dependencies"] if re.split("[<>=]", one, maxsplit=1)[0] in DEPENDENCIES]
setup(version=PROJECT["version"], install_requires=requirements, cmdclass={"build_py": Build})
