"""Sizes of the house: `python -m tests.house` prints its figures beside their limits, those of `limits.toml`."""

import ast
import sys
import tomllib
from collections import Counter
from pathlib import Path

import grimp

ROOT = Path(__file__).resolve().parents[1]
_MADE = {"pb", "build", "dist", "runs", "out", "lightning_logs"}
"""Folders of what commands make, generated stubs among them."""
_LARGE = "# Large: "


def python_files(*, tests: bool = False) -> list[Path]:
    """Return all files of code, those of tests only where asked for."""
    tops = [path for path in ROOT.iterdir() if path.is_dir() and path.name[0] != "." and path.name not in _MADE]
    code = [path for top in tops for path in top.rglob("*.py") if not _MADE & {*path.parts}]  # links are not followed
    return [path for path in code if tests or path.relative_to(ROOT).parts[0] != "tests"]


def classes(path: Path) -> list[tuple[str, int, int, str]]:
    """Return name, lines and methods of each class of a file, and what a comment `# Large: ...` above it says."""
    lines, found = ["", *path.read_text().splitlines()], []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ClassDef):
            first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
            _, _, why = lines[first - 1].partition(_LARGE)
            methods = sum(isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef) for each in node.body)
            found.append((node.name, (node.end_lineno or 0) - node.lineno + 1, methods, why))
    return found


def figures() -> dict[str, float]:
    """Return each figure by its name in `limits.toml`."""
    code, product = python_files(tests=True), python_files()
    usual = [found for path in product for found in classes(path) if not found[3]]
    graph = grimp.build_graph("lightpage", cache_dir=None)
    rooms = graph.find_children("lightpage.runtime")
    arrows = {
        room: {
            other
            for other in rooms - {room}
            if graph.direct_import_exists(importer=room, imported=other, as_packages=True)
        }
        for room in rooms
    }
    return {
        "rooms": len(rooms),
        "floors": max(_floor(room, arrows) for room in rooms),
        "arrows": sum(map(len, arrows.values())),
        "imports": max(_imports(path) for path in product),
        "files": max(Counter(path.parent for path in code).values()),
        "class_lines": max(lines for _, lines, _, _ in usual),
        "methods": max(methods for *_, methods, _ in usual),
    }


def _floor(room: str, arrows: dict[str, set[str]]) -> int:
    """The floor of a room, one above the highest that it imports; import-linter sees to it that there is no circle."""
    return 1 + max((_floor(other, arrows) for other in arrows[room]), default=0)


def _imports(path: Path) -> int:
    return sum(isinstance(node, ast.Import | ast.ImportFrom) for node in ast.walk(ast.parse(path.read_text())))


def limits() -> dict[str, float]:
    """Return the limits, by the figures' names."""
    found: dict[str, float] = tomllib.loads((ROOT / "tests" / "limits.toml").read_text())["house"]
    return found


def main() -> int:
    """Print the figures, and return 1 where one is over its limit."""
    most, found = limits(), figures()
    for name, value in found.items():
        print(f"{name:<15} {value:>8,} of {most[name]:,}")
    for path in python_files():
        for name, lines, methods, why in classes(path):
            if lines > most["class_lines"] or methods > most["methods"]:
                told = f"{lines} lines, {methods} methods. {why or 'No reason is given.'}"
                print(f"{path.relative_to(ROOT)}: {name}: {told}")
    return int(any(value > most[name] for name, value in found.items()))


if __name__ == "__main__":
    sys.exit(main())
