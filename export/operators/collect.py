"""Operator lists from the documents of their projects: `python -m lightpage.export.operators.collect`.

The CUDA provider's is a section of docs/OperatorKernels.md of onnxruntime, that is made from its registered kernels.
TensorRT's is docs/operators.md of onnx-tensorrt, the parser that onnxruntime's provider is built with. Of the
restrictions there only two forms are kept: inputs that must be constants, and the number of axes of the first one.
"""

from __future__ import annotations

import re
from pathlib import Path

import click

from lightpage.errors import InvalidInputError
from lightpage.export.operators.operator_list import FLOATING, PROVIDERS, Kernel, Operator, OperatorList, dtype_name

DOMAINS = {"ai.onnx": "", "com.microsoft": "com.microsoft"}
"""Domains that are kept, by their name in the document; the others are onnxruntime's own or other kinds of models."""
_CUDA = "CUDAExecutionProvider"
_TENSORRT = "TensorrtExecutionProvider"
_TENSORRT_TYPES = {
    "FP32": "float32",
    "FP16": "float16",
    "BF16": "bfloat16",
    "FP8": "float8e4m3fn",
    "INT64": "int64",
    "INF64": "int64",  # a slip of the document
    "INT32": "int32",
    "INT8": "int8",
    "INT4": "int4",
    "UINT8": "uint8",
    "BOOL": "bool",
}


@click.command()
@click.argument("document", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--provider", required=True, type=click.Choice(PROVIDERS))
@click.option("--origin", required=True, help="Project, file, commit and version of the document.")
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="The list, JSON.")
def collect(document: Path, provider: str, origin: str, out: Path) -> None:
    """Make a provider's operator list from the document of its project."""
    text = document.read_text("utf-8")
    found = cuda_operators(text, origin) if provider == "cuda" else tensorrt_operators(text, origin)
    found.save(out)
    click.echo(f"{out}: {len(found.operators)} operators")


def cuda_operators(text: str, origin: str) -> OperatorList:
    """The CUDA provider's operators.

    Args:
        text: docs/OperatorKernels.md of onnxruntime.
        origin: origin of the text.

    Raises:
        InvalidInputError: the text has no such section, or a row of it cannot be read.
    """
    _, found, section = text.partition(f'<a name="{_CUDA.lower()}"/>')
    if not found:
        raise InvalidInputError("operator document", f"no section {_CUDA}", "docs/OperatorKernels.md of onnxruntime")
    operators: dict[tuple[str, str], Operator] = {}
    domain, name, parameters = None, "", ""
    for line in section.partition("<a name=")[0].splitlines():
        cells = [cell.strip() for cell in line.strip().removeprefix("|").split("|")]
        if heading := re.match(r"\*\*Operator Domain:\*\* \*(.+)\*", cells[0]):
            domain = DOMAINS.get(heading[1])
        elif domain is not None and len(cells) == 5:
            name, parameters = cells[0] or name, cells[1] or parameters
            known = operators.get((domain, name), Operator((), *_parameters(domain, parameters)))
            kernels = (*known.kernels, Kernel(*_versions(cells[2], name), _types(cells[3])))
            operators[domain, name] = Operator(kernels, known.inputs, known.outputs)
    return OperatorList(_CUDA, origin, operators)


def _parameters(domain: str, cell: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Type variables of inputs and outputs, where the onnx package does not know them."""
    if domain == "":
        return (), ()
    first = cell.partition("<br>or<br>")[0]
    inputs, outputs = (re.findall(rf"\*{way}\* \w+:\*\*(\S+?)\*\*", first) for way in ("in", "out"))
    return tuple(inputs), tuple(outputs)


def _versions(cell: str, name: str) -> tuple[int, int | None]:
    """First and last version of "22+", "13" or "[7, 12]"; a single one ends where it begins."""
    if found := re.fullmatch(r"(\d+)\+", cell):
        return int(found[1]), None
    numbers = [int(number) for number in re.findall(r"\d+", cell)]
    if not re.fullmatch(r"\d+|\[\d+, \d+\]", cell):
        raise InvalidInputError(f"operator document: versions of {name}", repr(cell), '"N+", "N" or "[N, N]"')
    return numbers[0], numbers[-1]


def _types(cell: str) -> dict[str, frozenset[str]]:
    """Types by variable of "**T** = tensor(float), tensor(float16)<br/> **U** = ..."."""
    found = {}
    for part in cell.split("<br/>"):
        if named := re.fullmatch(r"\s*\*\*(\w+)\*\* = (.+)", part):
            listed = (re.sub(r"tensor\((\w+)\)", lambda one: dtype_name(one[1]), word) for word in named[2].split(","))
            found[named[1]] = frozenset(word.strip() for word in listed)
    return found


def tensorrt_operators(text: str, origin: str) -> OperatorList:
    """TensorRT's operators.

    Args:
        text: docs/operators.md of onnx-tensorrt, from version 10 on.
        origin: origin of the text.

    Raises:
        InvalidInputError: the text says no range of opset versions, or names an unknown type.
    """
    opsets = re.search(r"opset (\d+) to opset (\d+)", text)
    if opsets is None:
        raise InvalidInputError("operator document", "no range of opsets", "docs/operators.md of onnx-tensorrt")
    first, last = int(opsets[1]), int(opsets[2])
    operators = {}
    for row in re.finditer(r"^\| *(\w+) *\| *Y *\|([^|\n]*)(?:\|(.*))?$", text, re.MULTILINE):
        name, types, restrictions = row[1], row[2], row[3] or ""
        words = [word.strip() for word in types.split(",") if word.strip()]
        if unknown := [word for word in words if word not in _TENSORRT_TYPES]:
            raise InvalidInputError(f"operator document: types of {name}", unknown[0], ", ".join(_TENSORRT_TYPES))
        # an operator keeps its version over many opsets: which ones are read is said of the opset, not of it
        kernel = Kernel(1, last, {FLOATING: frozenset(_TENSORRT_TYPES[word] for word in words)})
        constant = re.findall(r"`(\w+)` must be (?:an initializer|a constant|a build-time constant)", restrictions)
        axes = re.search(r"must be (\d)D", restrictions)
        operators["", name] = Operator((kernel,), constant=tuple(constant), rank=None if axes is None else int(axes[1]))
    return OperatorList(_TENSORRT, origin, operators, (first, last))


if __name__ == "__main__":
    collect()
