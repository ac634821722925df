"""The operators of an execution provider as a file: versions and types that it has kernels for."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from lightpage.errors import InvalidInputError
from lightpage.files import replace_text
from lightpage.runtime.model.execution.providers import CUDA, TENSORRT

PROVIDERS = (CUDA, TENSORRT)
"""Providers whose lists lie beside this file."""
FLOATING = "*"
"""Stands for every type variable that ONNX lets be floating point, where a list gives an operator's types in one."""
_NUMPY = {"float": "float32", "double": "float64"}


def dtype_name(name: str) -> str:
    """numpy's name of an ONNX element type, e.g. float32 of float; those that numpy lacks keep their own."""
    return _NUMPY.get(name, name)


@dataclass(frozen=True)
class Kernel:
    """An implementation of an operator.

    Attributes:
        since, until: versions of the operator that it implements; without `until` it implements `since` alone.
        types: element types that it takes, by type variable or `FLOATING`.
    """

    since: int
    until: int | None
    types: Mapping[str, frozenset[str]]

    def implements(self, version: int) -> bool:
        """Return whether onnxruntime takes it for this version of the operator.

        A kernel that is registered for "20 and later" is taken for version 20 alone: whether it does what a later
        version wants is not known. Source: `VerifyVersion` in onnxruntime/core/framework/kernel_registry.cc.
        """
        return self.since == version or (self.until is not None and self.since <= version <= self.until)


@dataclass(frozen=True)
class Operator:
    """A provider's implementations of one operator.

    Attributes:
        kernels: implementations.
        inputs, outputs: type variable of each, in order; empty for operators that ONNX itself describes.
        constant: names of inputs that must be constants.
        rank: axes that the first input must have; any number where None.
    """

    kernels: tuple[Kernel, ...]
    inputs: tuple[str, ...] = ()
    outputs: tuple[str, ...] = ()
    constant: tuple[str, ...] = ()
    rank: int | None = None


@dataclass(frozen=True)
class OperatorList:
    """The operators that a provider can run.

    Attributes:
        provider: its name in onnxruntime.
        origin: project, file and commit that the list was made from.
        operators: operators by domain (empty for ONNX's own) and name.
        opsets: first and last version of ONNX's operators that it reads; any where None.
    """

    provider: str
    origin: str
    operators: Mapping[tuple[str, str], Operator] = field(default_factory=dict)
    opsets: tuple[int, int] | None = None

    @classmethod
    def load(cls, provider: str) -> OperatorList:
        """The list that lies beside this file.

        Args:
            provider: one of `PROVIDERS`.

        Raises:
            InvalidInputError: no such provider.
        """
        if provider not in PROVIDERS:
            raise InvalidInputError("execution provider", repr(provider), f"one of {', '.join(PROVIDERS)}")
        return cls.from_json(
            resources.files("lightpage.export.operators").joinpath(f"{provider}.json").read_text("utf-8")
        )

    @classmethod
    def from_json(cls, text: str) -> OperatorList:
        """The list of a file that `save` wrote."""
        data = json.loads(text)
        operators = {
            (domain, name): _operator(entry)
            for domain, named in data["operators"].items()
            for name, entry in named.items()
        }
        opsets = data.get("opsets")
        return cls(data["provider"], data["origin"], operators, None if opsets is None else (opsets[0], opsets[1]))

    def save(self, path: Path) -> None:
        """Write the list as JSON, an operator a line.

        Raises:
            InvalidInputError: the path cannot be written.
        """
        head = {"provider": self.provider, "origin": self.origin, **({"opsets": self.opsets} if self.opsets else {})}
        domains = []
        for domain in sorted({domain for domain, _ in self.operators}):
            lines = [
                f"{json.dumps(name)}: {json.dumps(_entry(operator))}"
                for (own, name), operator in sorted(self.operators.items())
                if own == domain
            ]
            domains.append(f"{json.dumps(domain)}: {{\n" + ",\n".join(lines) + "\n}")
        text = json.dumps(head)[:-1] + ', "operators": {\n' + ",\n".join(domains) + "\n}}\n"
        replace_text(path, text, "operator list")


def _operator(entry: Mapping[str, Any]) -> Operator:
    kernels = tuple(
        Kernel(since, until, {variable: frozenset(types.split()) for variable, types in by_variable.items()})
        for since, until, by_variable in entry["kernels"]
    )
    inputs, outputs, constant = (tuple(entry.get(key, "").split()) for key in ("inputs", "outputs", "constant"))
    return Operator(kernels, inputs, outputs, constant, entry.get("rank"))


def _entry(operator: Operator) -> dict[str, Any]:
    kernels = [
        [kernel.since, kernel.until, {variable: " ".join(sorted(types)) for variable, types in kernel.types.items()}]
        for kernel in operator.kernels
    ]
    words = {key: " ".join(getattr(operator, key)) for key in ("inputs", "outputs", "constant")}
    rank = {} if operator.rank is None else {"rank": operator.rank}
    return {"kernels": kernels, **{key: value for key, value in words.items() if value}, **rank}
