"""Rules of tests and words, as a part of lint: `python -m tests.rules` names each line of a test that breaks one.

- A claim is never about wall-clock time: what waits is given a clock (`tests.clock`), and what other threads and
  processes do is awaited by `tests.waiting.eventually`, which alone compares times.
- Nobody sleeps longer than 0.2 s to let something happen. Who must hang waits for a signal or for his input.
- An error is known by its class, subject and status. Sentences are kept in one snapshot (`tests/messages`).
- Private attributes of what is tested are left alone.
- `limits.toml` limits bytes that git tracks, long sentences of pages, and docstrings without a subject.
"""

import ast
import math
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

from tests.house import python_files

HERE = Path(__file__).parent
CLOCKS = {"monotonic", "perf_counter", "time", "monotonic_ns", "perf_counter_ns", "time_ns", "process_time"}
OWN_CLOCK = {"clock.py", "waiting.py"}
LONGEST_SLEEP_S = 0.2
MOST_WORDS = 3
TEXTS = {"output", "stdout", "stderr", "message", "details", "text"}
"""Attributes that hold what a program tells people."""
LONGEST_SENTENCE = 25
_NO_SUBJECT = re.compile(
    r"(?i)(of|th(ose|at)|wh(at|o(m|se|ever)?|ere|ich|ether)|with|as|in|by|for|from|at|on|one|how|its?|to|another one|"
    r"all of it|the same(?=[.,;]| of| in| with| a| for))\b"
)
_ENTRY = re.compile(r"^ {4}[a-z_][\w, ]*: (?!whether)(.+)$", re.MULTILINE)  # what is true or false may begin so
_DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
_SLEEP_IN_A_SCRIPT = re.compile(r"\bsleep\((\d+(?:\.\d*)?)\)")


def broken(path: Path) -> Iterator[tuple[int, str]]:
    """Yield line number and rule of everything in a file that breaks one."""
    tree = ast.parse(path.read_text("utf-8"))
    for function in ast.walk(tree):
        if isinstance(function, ast.Module | ast.FunctionDef | ast.AsyncFunctionDef):
            yield from _of_times(function)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and _name(node.func) == "sleep" and node.args:
            if isinstance(seconds := node.args[0], ast.Constant) and seconds.value > LONGEST_SLEEP_S:
                yield node.lineno, f"sleeps {seconds.value} s"
        elif isinstance(node, ast.Call) and _name(node.func) == "setattr" and len(node.args) == 3:
            if isinstance(name := node.args[1], ast.Constant) and re.match("_[^_]", str(name.value)):
                yield node.lineno, f"replaces {name.value}"
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            if any(float(found) > LONGEST_SLEEP_S for found in _SLEEP_IN_A_SCRIPT.findall(node.value)):
                yield node.lineno, "sleeps, in a script"
        elif isinstance(node, ast.keyword) and node.arg == "match" and len(_text(node.value).split()) > MOST_WORDS:
            yield node.value.lineno, f"freezes a sentence: {_text(node.value)!r}"
        elif isinstance(node, ast.Compare) and _told(node.comparators[-1]) and isinstance(node.ops[0], ast.In | ast.Eq):
            if len(_text(node.left).split()) > MOST_WORDS:
                yield node.lineno, f"freezes a sentence: {_text(node.left)!r}"
        elif isinstance(node, ast.Attribute) and _private(node):
            yield node.lineno, f"reaches for {node.attr}"


def _of_times(function: ast.Module | ast.FunctionDef | ast.AsyncFunctionDef) -> Iterator[tuple[int, str]]:
    """Comparisons, in the body of a function, of what a clock says."""
    own = [node for statement in function.body for node in _without_functions(statement)]
    times = {
        target.id
        for node in own
        if isinstance(node, ast.Assign | ast.NamedExpr) and _reads_clock(node.value)
        for top in (node.targets if isinstance(node, ast.Assign) else [node.target])
        for target in ast.walk(top)
        if isinstance(target, ast.Name)
    }
    for node in own:
        if isinstance(node, ast.Compare) and any(
            _reads_clock(part) or (isinstance(part, ast.Name) and part.id in times) for part in ast.walk(node)
        ):
            yield node.lineno, "compares wall-clock time"


def _without_functions(node: ast.AST) -> Iterator[ast.AST]:
    if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        yield node
        for child in ast.iter_child_nodes(node):
            yield from _without_functions(child)


def _reads_clock(node: ast.AST) -> bool:
    calls = (part.func for part in ast.walk(node) if isinstance(part, ast.Call))
    return any(
        isinstance(call, ast.Attribute) and call.attr in CLOCKS and _name(call.value) == "time" for call in calls
    )


def _private(node: ast.Attribute) -> bool:
    """Return whether a node reads another object's attribute that its name calls private."""
    named = node.attr.startswith("_") and not node.attr.startswith("__")
    return named and _name(node.value) not in {"self", "cls", "os", "sys", "ctypes"}


def _told(node: ast.AST) -> bool:
    """Return whether a node is text that a program or an error shows people."""
    if isinstance(node, ast.Call):
        return _name(node.func) in {"str", "details"}
    return isinstance(node, ast.Attribute) and node.attr in TEXTS


def _text(node: ast.AST) -> str:
    """Return the literal parts of a string."""
    return " ".join(
        part.value for part in ast.walk(node) if isinstance(part, ast.Constant) and isinstance(part.value, str)
    )


def _name(node: ast.AST) -> str:
    return node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""


def without_subject(sources: Iterable[str]) -> dict[str, float]:
    """Return the percentages of docstrings, entries and help texts that begin with a preposition or a pronoun."""
    nodes = [node for source in sources for node in ast.walk(ast.parse(source))]
    docstrings = [*filter(None, (ast.get_docstring(node) for node in nodes if isinstance(node, _DOCUMENTED)))]
    entries = [text for docstring in docstrings for text in _ENTRY.findall(docstring)]
    told = (each for each in nodes if isinstance(each, ast.keyword) and each.arg in ("help", "description"))
    texts = {"": docstrings, "entries_": entries, "help_": [_text(each.value) for each in told]}
    counts = {of: len([*filter(_NO_SUBJECT.match, each)]) for of, each in texts.items()}
    return {f"{of}no_subject_percent": _percent(count, len(texts[of])) for of, count in counts.items()}


def prose(pages: Iterable[str]) -> dict[str, float]:
    """Return the percentage of long sentences of Markdown pages without their code."""
    texts = [re.sub(r"```.*?```", "", page, flags=re.DOTALL) for page in pages]
    plain = [re.sub(r"^\s*[|#>].*$", "", text, flags=re.MULTILINE) for text in texts]
    lengths = [len(each.split()) for text in plain for each in re.split(r"(?<=[.!?])\s+(?=[A-Z`*])", text)]
    long_percent = _percent(sum(n > LONGEST_SENTENCE for n in lengths), len(lengths))
    return {"long_sentences_percent": long_percent}


def _percent(part: int, whole: int) -> float:
    return math.ceil(1000 * part / max(whole, 1)) / 10


def main() -> int:
    """Print what breaks a rule, and return the exit status."""
    paths = sorted(HERE.rglob("*.py"))
    found = [
        f"{path.relative_to(HERE.parent)}:{line}: {what}"
        for path in paths
        if path.relative_to(HERE).as_posix() not in OWN_CLOCK
        for line, what in broken(path)
    ]
    limits = tomllib.loads((HERE / "limits.toml").read_text("utf-8"))
    root = HERE.parent
    pages = [root / "README.md", root / "CONTRIBUTING.md", *root.glob("docs/**/*.md")]
    sizes = {
        "bytes": tracked_bytes(root),
        **prose(path.read_text("utf-8") for path in pages),
        **without_subject(path.read_text("utf-8") for path in python_files(tests=True)),
    }
    for unit, size in sizes.items():
        if size > limits[unit]:
            found.append(f"{size:,.10g} {unit}, wanted {limits[unit]:,} or fewer (tests/limits.toml)")
    print(*found, sep="\n", end="\n" if found else "")
    told = [f"{size:,.10g} of {limits[unit]:,} {unit}" for unit, size in sizes.items()]
    print(*told, f"{len(found)} rules broken", sep="; ")
    return bool(found)


def tracked_bytes(root: Path) -> int:
    """The size of all files that git tracks, as they lie there; 0 of a tree that is no repository."""
    if not (root / ".git").exists():
        return 0
    listed = subprocess.run(["git", "-C", root, "ls-files", "-z"], check=True, stdout=subprocess.PIPE).stdout
    paths = (root / name for name in listed.decode().split("\0") if name)
    return sum(path.lstat().st_size for path in paths if path.is_file())


if __name__ == "__main__":
    sys.exit(main())
