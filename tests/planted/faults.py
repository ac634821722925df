"""The list of faults, and where each lies in today's sources."""

from __future__ import annotations

import ast
import json
import subprocess
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("faults.toml")


@dataclass(frozen=True)
class Fault:
    """One line of a file, in a function or class (the whole file if that is ""), that another takes the place of.

    Attributes:
        nth: which of several equal lines there, from 1; 0 where it is the only one.
        tests: files that ought to see it.
        reason: why it is struck out, where it is.
    """

    area: str
    kind: str
    file: str
    within: str = ""
    line: str = ""
    new: str = ""
    nth: int = 0
    tests: tuple[str, ...] = ()
    reason: str = ""

    @property
    def id(self) -> str:
        return f"{self.area}-{self.kind}"

    @property
    def key(self) -> tuple[str | int, ...]:
        return (self.file, self.within, self.line, self.nth, self.new)

    def planted(self) -> str:
        """Today's file with the fault in it; the program ends where its line is not found or is no Python."""
        source = (ROOT / self.file).read_text() if (ROOT / self.file).is_file() else ""
        lines = source.splitlines(keepends=True)
        blocks = {name: range(node.lineno - 1, node.end_lineno or 0) for name, node in blocks_of(ast.parse(source))}
        block = blocks.get(self.within, range(0)) if self.within else range(len(lines))
        found = [number for number in block if lines[number].strip() == self.line]
        if len(found) < max(self.nth, 1) or (not self.nth and len(found) > 1):
            grep = subprocess.run(["git", "grep", "-lF", self.line, "*.py"], cwd=ROOT, capture_output=True, text=True)
            raise SystemExit(
                f"{self.id}: {self.file}, {self.within or 'anywhere'}, has {len(found)} times:\n    {self.line}\n"
                f"It is in: {' '.join(grep.stdout.split()) or 'no file'}. Mend its entry in {LIST.relative_to(ROOT)}."
            )
        number = found[max(self.nth, 1) - 1]
        lines[number] = lines[number].replace(self.line, self.new)
        compile("".join(lines), self.file, "exec")
        return "".join(lines)

    def toml(self) -> str:
        rows = [f"{name} = {json.dumps(value, ensure_ascii=False)}\n" for name, value in asdict(self).items() if value]
        return f"[[{'struck' if self.reason else 'fault'}]]\n{''.join(rows)}\n"


def blocks_of(tree: ast.AST, outer: str = "") -> list[tuple[str, ast.FunctionDef | ast.ClassDef]]:
    """Every function and class with its qualified name; the inner ones last."""
    found = []
    for node in ast.iter_child_nodes(tree):
        named = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
        name = f"{outer}.{node.name}".lstrip(".") if named else outer
        found += [(name, node)] * named + blocks_of(node, name)
    return found


def load() -> tuple[list[Fault], list[Fault]]:
    """The faults of the list, and those that are struck out."""
    read = tomllib.loads(LIST.read_text())
    rows = [[{**row, "tests": tuple(row.get("tests", ()))} for row in read.get(of, ())] for of in ("fault", "struck")]
    return [Fault(**row) for row in rows[0]], [Fault(**row) for row in rows[1]]
