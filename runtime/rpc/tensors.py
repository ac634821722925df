"""Tensors and parameters of the Open Inference Protocol: requests to arrays, a decoded page to tensors."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from google.protobuf.descriptor import EnumDescriptor, FieldDescriptor
from numpy.typing import NDArray

from lightpage.errors import InvalidInputError
from runtime.pb.inference import open_inference_pb2 as oip

RAW_TYPES = {
    "BOOL": np.dtype(np.bool_),
    "UINT8": np.dtype(np.uint8),
    "UINT16": np.dtype("<u2"),
    "FP32": np.dtype("<f4"),
}
"""Of elements, row-major."""
_TYPED_FIELDS = {"BOOL": "bool_contents", "UINT8": "uint_contents", "UINT16": "uint_contents"}
_SLICE = 1 << 16
"""Typed elements that are taken at a time: the interpreter does nothing else meanwhile."""
_LARGEST_COUNT = (1 << 32) - 1
"""Of a parameter: the fields that parameters stand for have 32 bits."""
TYPED_BYTES = 4
"""Memory of a typed element, once parsed."""

Request = oip.ModelInferRequest
Input = oip.ModelInferRequest.InferInputTensor


@dataclass(frozen=True)
class Tensor:
    """An input of the model.

    Attributes:
        datatype: one of `RAW_TYPES`.
        shape: of it.
        wrong: class of the error where another one comes.
        optional: whether it may be left out.
    """

    datatype: str
    shape: tuple[int, ...]
    wrong: type[InvalidInputError]
    optional: bool = False

    def __str__(self) -> str:
        return _told(self.datatype, self.shape)


def inputs_of(request: Request, expected: Mapping[str, Tensor]) -> dict[str, NDArray[Any]]:
    """The input tensors by name; those with raw contents are views of the request's bytes, which cannot be written to.

    Args:
        request: that came.
        expected: what the model takes, by name.

    Raises:
        InvalidInputError: a tensor that is missing, unknown, or there twice, of another type, shape or size, or with
            contents in two forms; of the class `Tensor.wrong` where that is known.
    """
    raw = request.raw_input_contents
    if raw and len(raw) != len(request.inputs):
        raise InvalidInputError("raw_input_contents", f"{len(raw)} of them", f"{len(request.inputs)}, one an input")
    found: dict[str, NDArray[Any]] = {}
    for index, tensor in enumerate(request.inputs):
        subject, known = f"inputs.{tensor.name}", expected.get(tensor.name)
        if known is None:
            raise InvalidInputError("inputs", repr(tensor.name), f"one of {', '.join(expected)}")
        if tensor.name in found:
            raise InvalidInputError(subject, "this tensor twice", "once")
        if tensor.parameters:
            raise InvalidInputError(f"{subject}.parameters", ", ".join(sorted(tensor.parameters)), "none")
        if (tensor.datatype, tuple(tensor.shape)) != (known.datatype, known.shape):
            raise known.wrong(subject, _told(tensor.datatype, tensor.shape), known)
        if not raw:
            found[tensor.name] = _typed(tensor, known, subject)
        elif tensor.HasField("contents"):
            raise InvalidInputError(f"{subject}.contents", "typed contents beside raw_input_contents", "one of the two")
        else:
            found[tensor.name] = _raw(raw[index], known, subject)
    missing = [name for name, tensor in expected.items() if not tensor.optional and name not in found]
    if missing:
        raise InvalidInputError(f"inputs.{missing[0]}", "nothing", expected[missing[0]])
    return found


def _raw(content: bytes, known: Tensor, subject: str) -> NDArray[Any]:
    dtype, count = RAW_TYPES[known.datatype], int(np.prod(known.shape))
    if len(content) != count * dtype.itemsize:
        raise known.wrong(subject, f"{len(content)} bytes", f"{count * dtype.itemsize} bytes of {known}")
    if dtype == np.bool_:
        flags = np.frombuffer(content, np.uint8)
        if int(flags.max(initial=0)) > 1:
            raise known.wrong(subject, f"a flag of {flags.max()}", "flags of 0 or 1")
    native = dtype.newbyteorder("=")
    return np.frombuffer(content, dtype).astype(native, copy=False).reshape(known.shape)


def _typed(tensor: Input, known: Tensor, subject: str) -> NDArray[Any]:
    field, count = _TYPED_FIELDS[known.datatype], int(np.prod(known.shape))
    others = sorted(each.name for each, _ in tensor.contents.ListFields() if each.name != field)
    if others:
        raise known.wrong(f"{subject}.contents", ", ".join(others), f"{field} alone")
    values = getattr(tensor.contents, field)
    if len(values) != count:
        raise known.wrong(f"{subject}.contents.{field}", f"{len(values)} elements", f"{count} of {known}")
    array = np.empty(count, RAW_TYPES[known.datatype].newbyteorder("="))
    for start in range(0, count, _SLICE):
        part = np.array(values[start : start + _SLICE])
        if array.dtype != np.bool_ and int(part.max()) > (largest := np.iinfo(array.dtype).max):
            raise known.wrong(f"{subject}.contents.{field}", f"an element of {part.max()}", f"0..{largest}")
        array[start : start + _SLICE] = part
    return array.reshape(known.shape)


def typed_elements(request: Request) -> int:
    """Elements of all typed contents of a request."""
    lists = (values for tensor in request.inputs for _, values in tensor.contents.ListFields())
    return sum(len(values) for values in lists)


def parameters_of(request: Request, kinds: Mapping[str, type]) -> dict[str, Any]:
    """The parameters of a request by name.

    Args:
        request: that came.
        kinds: int, str or bool, by name.

    Raises:
        InvalidInputError: one that is not known, of another type, or a number that is no count.
    """
    found: dict[str, Any] = {}
    for name, parameter in request.parameters.items():
        if (kind := kinds.get(name)) is None:
            raise InvalidInputError("parameters", repr(name), f"one of {', '.join(kinds)}")
        choice = parameter.WhichOneof("parameter_choice")
        value: Any = None if choice is None else getattr(parameter, choice)
        if type(value) is not kind:
            fields = {int: "int64_param", str: "string_param", bool: "bool_param"}
            raise InvalidInputError(f"parameters.{name}", choice or "no value", fields[kind])
        found[name] = value
        if kind is int and not 0 <= found[name] <= _LARGEST_COUNT:
            raise InvalidInputError(f"parameters.{name}", value, f"0..{_LARGEST_COUNT}")
    return found


def outputs_of(request: Request, known: Collection[str], usual: Sequence[str]) -> Sequence[str]:
    """Names of the outputs that a request asks for, `usual` where it names none.

    Raises:
        InvalidInputError: one that is not known, there twice, or with parameters.
    """
    names = [output.name for output in request.outputs]
    for index, output in enumerate(request.outputs):
        if output.name not in known:
            raise InvalidInputError("outputs", repr(output.name), f"one of {', '.join(known)}")
        if output.name in names[:index]:
            raise InvalidInputError(f"outputs.{output.name}", "this tensor twice", "once")
        if output.parameters:
            got = ", ".join(sorted(output.parameters))
            raise InvalidInputError(f"outputs.{output.name}.parameters", got, "none")
    return names or usual


def parameters_message(message: Any, left_out: Collection[str] = (), prefix: str = "") -> dict[str, oip.InferParameter]:
    """All that a message says as parameters: `name`, or `outer.name` of a message in it.

    Bytes are left out, and so are messages that are not set. A name of an enum is without its prefix; names in a list
    are separated by commas.
    """
    found: dict[str, oip.InferParameter] = {}
    for field in message.DESCRIPTOR.fields:
        if field.name in left_out or field.type == FieldDescriptor.TYPE_BYTES:
            continue
        name, value = f"{prefix}{field.name}", getattr(message, field.name)
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            if message.HasField(field.name):
                found |= parameters_message(value, left_out, f"{name}.")
        elif field.enum_type is not None:
            names = [_enum_name(field.enum_type, each) for each in (value if field.is_repeated else [value])]
            found[name] = oip.InferParameter(string_param=",".join(names))
        else:
            found[name] = _parameter(value)
    return found


def _enum_name(enum: EnumDescriptor, number: int) -> str:
    values = enum.values_by_number
    prefix = values[0].name.removesuffix("UNSPECIFIED")
    name = values[number].name.removeprefix(prefix)
    return "" if name == "UNSPECIFIED" else name


def _parameter(value: Any) -> oip.InferParameter:
    match value:
        case bool():
            return oip.InferParameter(bool_param=value)
        case int():
            return oip.InferParameter(int64_param=value)
        case float():
            return oip.InferParameter(double_param=value)
        case _:
            return oip.InferParameter(string_param=value)


def _told(datatype: str, shape: Sequence[int]) -> str:
    return f"{datatype} [{', '.join(map(str, shape))}]"
