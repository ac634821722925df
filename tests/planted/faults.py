"""The list of faults, and where each lies in today's sources."""

import ast
import json
import subprocess
import tomllib
from dataclasses import asdict, dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
LIST = Path(__file__).with_name("faults.toml")


@dataclass(frozen=True)
class Fault:
    """Fault: another line in place of one of a function or class (of the whole file if `within` is empty)."""

    area: str = field(compare=False)
    kind: str = field(compare=False)
    file: str
    within: str = ""
    line: str = ""
    new: str = ""
    nth: int = 0  # which of several equal lines there, from 1; 0 where it is the only one
    tests: tuple[str, ...] = field(default=(), compare=False)  # files, or FILE::TEST, that ought to see it
    reason: str = field(default="", compare=False)  # why it is struck out, where it is

    @property
    def id(self) -> str:
        return f"{self.area}-{self.kind}"

    def planted(self, root: Path = ROOT) -> str:
        """The file with the fault in it; the program ends where its line is not found, and where it is no Python."""
        source = (root / self.file).read_text() if (root / self.file).is_file() else ""
        lines = source.splitlines(keepends=True)
        blocks = dict([("", (1, len(lines))), *blocks_of(ast.parse(source))])
        first, last = blocks.get(self.within, (1, 0))
        found = [number for number in range(first - 1, last) if lines[number].strip() == self.line]
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


def blocks_of(tree: ast.AST, outer: str = "") -> list[tuple[str, tuple[int, int]]]:
    """First and last line of every function and class by its qualified name; the inner ones last."""
    found = []
    for node in ast.iter_child_nodes(tree):
        name = outer
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found.append((name := f"{outer}.{node.name}".lstrip("."), (node.lineno, node.end_lineno or 0)))
        found += blocks_of(node, name)
    return found


def load(kind: str) -> list[Fault]:
    """Load the list's entries of one kind: `fault`, or `struck`."""
    rows = tomllib.loads(LIST.read_text()).get(kind, [])
    return [Fault(**{**row, "tests": tuple(row.get("tests", ()))}) for row in rows]
