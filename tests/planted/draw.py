"""Draws faults of one line by a seed, spread over areas and kinds, and prints the list anew.

`python -m tests.planted.draw --seed 53 > list && mv list tests/planted/faults.toml`: faults that stay keep their tests.
"""

import argparse
import ast
import hashlib
import random
import re
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

from tests.planted.faults import ROOT, Fault, blocks_of, load

COUNT = 60
AREAS = {
    "page-code": {"lightpage/codec": "* ldpc/* compiled/* likelihood/*"},
    "decoder": {"lightpage": "page/* metrics/*", "runtime/model/decoding": "decoder page"},
    "tracking": {"runtime/model/decoding": "image_tracker following tracking image_drift"},
    "calibration": {"lightpage/calibration": "*", "train/fitting": "fit fitted"},
    "registry": {"runtime/service": "models/history models/loader models/models models/uploads pages/replays"},
    "store": {
        "runtime/service/models": "store store_health folder database audit",
        "runtime/service/monitoring": "flight_recorder",
        "runtime/service/jobs": "jobs",
    },
    "pairing": {"runtime/device/acquisition": "pairing camera_source camera_image beam_keeper page_store source"},
    "ledger": {
        "runtime/archives/run": "ledger totals shard task job driver volumes",
        "runtime/archives/workers": "work",
    },
    "failures": {"lightpage": "failures errors", "runtime": "client/wire/status service/server/dispatcher"},
    "limits": {
        "runtime/service": "admission limits settings server/message_gate display/uploads models/incoming",
        "runtime/service/frames": "frames frame_calls",
        "runtime/service/jobs": "sent_pages",
    },
    "wire": {"runtime/client/wire": "[!s]* s[!t]*", "runtime/client": "[!c]*", "runtime/service/frames": "tensors"},
}
"""Files of an area by their folder, without .py."""
KINDS = ("comparison", "bound", "sign", "constant", "condition", "swallowed", "exchanged", "unstored")
TURNED = {"<": ">=", ">=": "<", ">": "<=", "<=": ">", "==": "!=", "!=": "=="}
MOVED = {"<": "<=", "<=": "<", ">": ">=", ">=": ">"}
SIGNS = {"+": "-", "-": "+", "+=": "-=", "-=": "+="}
# Calls of which exchanged arguments fail at once, or change nothing.
PLAIN = {"isinstance", "issubclass", "getattr", "hasattr", "setattr", "cast", "min", "max", "minimum", "maximum"}
Edit = tuple[int, int, int, str]  # on a line, the bytes from one column to another become a text


def _put(node: ast.expr | ast.stmt, text: str) -> Iterator[Edit]:
    if node.lineno == node.end_lineno:
        yield node.lineno, node.col_offset, node.end_col_offset or 0, text


def _operator(left: ast.expr, right: ast.expr, names: dict[str, str], source: list[bytes]) -> Iterator[Edit]:
    if left.end_lineno == right.lineno and not isinstance(right, ast.JoinedStr | ast.List | ast.Tuple):
        between = source[right.lineno - 1][left.end_col_offset : right.col_offset].decode()
        if (sign := between.strip(" ()")) in names:
            yield right.lineno, left.end_col_offset or 0, right.col_offset, between.replace(sign, names[sign])


def edits(kind: str, node: ast.AST, source: list[bytes]) -> Iterator[Edit]:
    """Yield the edits by which a kind of fault changes a node."""
    match kind, node:
        case "comparison", ast.Compare(ops=[_]):
            yield from _operator(node.left, node.comparators[0], TURNED, source)
        case "bound", ast.Compare():
            for left, right in pairwise([node.left, *node.comparators]):
                yield from _operator(left, right, MOVED, source)
        case "bound", ast.Slice(lower, upper):
            for end in filter(None, (lower, upper)):
                yield from _put(end, f"{ast.unparse(end)} + 1")
        case "bound", ast.Call(ast.Name("range"), [end] | [_, end, *_]):
            yield from _put(end, f"{ast.unparse(end)} + 1")
        case "sign", ast.BinOp(left, _, right) | ast.AugAssign(left, _, right):
            yield from _operator(left, right, SIGNS, source)
        case "sign", ast.UnaryOp(ast.USub(), operand):
            yield from _put(node, ast.unparse(operand))
        case "constant", ast.Constant(int() | float() as value) if not isinstance(value, bool):
            small = isinstance(value, int) and value < 10
            yield from _put(node, repr(value + 1 if small else value * 2 or 1.0))
        case "condition", ast.BoolOp(ast.And(), values):
            for part in (values[:-1], values[1:]):
                yield from _put(node, " and ".join(map(ast.unparse, part)))
        case "condition", ast.If(test) | ast.IfExp(test):
            yield from _put(test, "True")
        case "swallowed", ast.Raise():
            yield from _put(node, "pass")
        case "exchanged", ast.Call(ast.Name(called) | ast.Attribute(_, called), args, words) if called not in PLAIN:
            places = args[:2] if called.endswith("Error") else args  # behind an error's subject are but words
            for one, other in [*pairwise(places), *pairwise([word.value for word in words if word.arg])]:
                line, plain = source[one.lineno - 1], not {type(one), type(other)} & {ast.Starred}
                if plain and one.lineno == one.end_lineno == other.lineno == other.end_lineno:
                    a, b, c, d = one.col_offset, one.end_col_offset or 0, other.col_offset, other.end_col_offset or 0
                    yield one.lineno, a, d, (line[c:d] + line[b:c] + line[a:b]).decode()
        case "unstored", ast.Assign([target], value) | ast.AugAssign(target, _, value):
            if isinstance(target, ast.Attribute | ast.Subscript):
                yield from _put(node, ast.unparse(value))


def reached(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all nodes that compute: no annotations, texts, logs, nor what a constructor stores."""
    yield node
    for name, value in ast.iter_fields(node):
        for child in value if isinstance(value, list) else [value]:
            log = isinstance(child, ast.Call) and re.match(r"_?log(ger)?\.", ast.unparse(child.func))
            guard = isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"
            made = getattr(node, "name", "") == "__init__" and isinstance(child, ast.Assign)
            skipped = name in ("annotation", "returns", "decorator_list") or isinstance(child, ast.JoinedStr)
            if isinstance(child, ast.AST) and not (log or guard or made or skipped):
                yield from reached(child)


def candidates(area: str, kind: str) -> Iterator[Fault]:
    """Every fault of one kind that an area has room for."""
    names = [f"{folder}/{name}.py" for folder, names in AREAS[area].items() for name in names.split()]
    for path in sorted({path for name in names for path in ROOT.glob(name)}):
        tree, source = ast.parse(path.read_text()), path.read_bytes().splitlines()
        blocks = [("", (1, len(source))), *blocks_of(tree)]
        for number, start, end, put in (edit for node in reached(tree) for edit in edits(kind, node, source)):
            within, (first, last) = next(b for b in reversed(blocks) if b[1][0] <= number <= b[1][1])
            line = source[number - 1]
            same = [n for n in range(first, last + 1) if source[n - 1].strip() == line.strip()]
            old, new = (text.decode().strip() for text in (line, line[:start] + put.encode() + line[end:]))
            nth = same.index(number) + 1 if len(same) > 1 else 0
            yield Fault(area, kind, str(path.relative_to(ROOT)), within, old, new, nth)


def draw(seed: int, struck: set[Fault]) -> Iterator[Fault]:
    """Yield one fault for each of the first pairs of an area and a kind, in an order that the seed makes."""
    areas, kinds = random.Random(seed).sample(list(AREAS), len(AREAS)), random.Random(seed).sample(KINDS, len(KINDS))
    taken = 0
    for turn in range(len(areas) * len(kinds)):  # numbers without a common divisor: every pair comes once
        found = candidates(areas[turn % len(areas)], kinds[turn % len(kinds)]) if taken < COUNT else ()
        if left := {(one.file, one.within, one.line, one.nth, one.new): one for one in found if one not in struck}:
            yield left[min(left, key=lambda parts: hashlib.sha256(repr((seed, parts)).encode()).digest())]
            taken += 1


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, required=True)
    struck, tests = load("struck"), {fault: fault.tests for fault in load("fault")}
    drawn = [replace(one, tests=tests.get(one, ())) for one in draw(parser.parse_args().seed, set(struck))]
    print("".join(fault.toml() for fault in [*drawn, *struck]), end="")
